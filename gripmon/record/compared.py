"""A recorded run drawn beside its replay, and the corrected track of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import rerun as rr

from gripmon.record.columns import APPLICATION_ID, RECORDED, REPLAYED, EventWriter, Palette, Sender, faded
from gripmon.record.curves import CurveWriter
from gripmon.record.recorder import Row, Then

_LOOKS = (
    (REPLAYED, "", 255, 1.5),
    (RECORDED, f"{RECORDED}/", 110, 5.0),
)  # run, root of its paths, opacity, width of its lines

_TRACK = "rig/corrected"
_TRACK_ROWS_A_CHUNK = 65536


class ThenWriter:
    """Writes what a run recorded of the frames of its replay: the usual names, below ``recorded``."""

    def __init__(self, stream: rr.RecordingStream, then: Then, corner_ids: tuple[str, ...]) -> None:
        send = Sender(stream, f"{RECORDED}/")
        self._curves, self._status = CurveWriter(send, corner_ids), EventWriter(send, RECORDED)
        _name_both(stream)
        self._limits, self._commands = then.limits, list(then.commands)

    def write(self, rows: Sequence[Row]) -> None:
        """The same frames, and the commands until then."""
        known = [(row.then, row.jaw_reported_m) for row in rows if row.then is not None]
        then = [Row(record, jaw_reported_m=jaw_m, limits=self._limits) for record, jaw_m in known]
        self._curves.write(then)
        newest = rows[-1].record.seq
        commands = [command for command in self._commands if command.seq <= newest]
        self._commands = [command for command in self._commands if command.seq > newest]
        self._status.write(then, commands)

    def finish(self) -> None:
        """Called when nothing more is written."""
        self._curves.finish()


def _name_both(stream: rr.RecordingStream) -> None:
    """Both runs in the same colours: the recorded one wide and pale, the replayed one thin."""
    for whose, root, alpha, width in _LOOKS:
        send = Sender(stream, root)
        for path, names, colours in (
            ("drift/tcp_shift_mm", ("x", "y", "z", "length"), (*Palette.AXES, Palette.WHOLE)),
            ("drift/limits_mm", ("warning", "limit"), (Palette.DOUBTFUL, Palette.BAD)),
            ("protection/level_mm", ("protection level",), (Palette.WHOLE,)),
            ("protection/limit_mm", ("alert limit",), (Palette.BAD,)),
        ):
            pale = [faded(colour, alpha) for colour in colours]
            send.lines(path, [f"{whose} {name}" for name in names], pale, width)


def track(recording_id: str, frames: Any, correction: Any, about: Any) -> bytes:
    """A run's frame table and its correction as a file's bytes; ``about`` is kept as JSON.

    It has the recording id of the original, so that a viewer shows both files as one, on the same timelines.  Shifts of
    the TCP are relative to the first corrected frame, mm, camera axes; raw and smoothed are the live estimates.
    """
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id)
    memory = stream.memory_recording()  # rerun's file sink doesn't report a full disk
    send = Sender(stream)
    for name, alpha, width, what in (
        ("tcp_shift_mm", 255, 3.0, "corrected"), ("raw_shift_mm", 90, 0.7, "raw"),
        ("smoothed_shift_mm", 150, 1.2, "smoothed"),
    ):  # fmt: skip
        colours = [faded(colour, alpha) for colour in Palette.AXES]
        send.lines(f"corrected/{name}", [f"{what} {axis}" for axis in "xyz"], colours, width)
    send.static(_TRACK, rr.TransformAxes3D(0.02))
    send.static("corrected/provenance", rr.AnyValues(json=msgspec.json.encode(about).decode()))
    for begin in range(0, len(correction.stamp_ns), _TRACK_ROWS_A_CHUNK):
        _track_columns(send, frames, correction, slice(begin, begin + _TRACK_ROWS_A_CHUNK))
    _track_events(send, frames, correction)
    whole = memory.drain_as_bytes()
    stream.disconnect()
    return whole


def _track_columns(send: Sender, frames: Any, correction: Any, rows: slice) -> None:
    from scipy.spatial.transform import Rotation

    stamps_ns, seqs = frames.stamp_ns[rows].tolist(), frames.seq[rows].tolist()
    poses = correction.cam_T_grip[rows]
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternions)
    send.columns(_TRACK, stamps_ns, seqs, columns)
    start_m = correction.cam_T_grip[0, :3, 3]
    for name, values_m in (
        ("tcp_shift_mm", poses[:, :3, 3] - start_m),
        ("raw_shift_mm", frames.cam_T_grip[rows, :3] - start_m),
        ("smoothed_shift_mm", frames.smoothed[rows, :3] - start_m),
        ("tcp_sigma_mm", np.sqrt(np.einsum("nii->ni", correction.covariance[rows])[:, :3])),
    ):
        known = np.isfinite(values_m).all(axis=1)
        columns = rr.Scalars.columns(scalars=1e3 * values_m[known].ravel()).partition(np.where(known, 3, 0))
        send.columns(f"corrected/{name}", stamps_ns, seqs, columns)


def _track_events(send: Sender, frames: Any, correction: Any) -> None:
    points = correction.change_points
    if not points:
        return
    rows = np.array([point.index for point in points])
    texts = []
    for point in points:
        size_mm, turn_deg = 1e3 * np.linalg.norm(point.size[:3]), np.degrees(np.linalg.norm(point.size[3:]))
        within_ms = 1e-6 * (point.latest_ns - point.earliest_ns)
        texts.append(f"the pose changed by {size_mm:.3f} mm, {turn_deg:.3f}° (known to {within_ms:.0f} ms)")
    columns = rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
    send.columns("corrected/events", frames.stamp_ns[rows].tolist(), frames.seq[rows].tolist(), columns)
