"""A recorded run and its replay overlaid in one recording, and the corrected track of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr

from gripmon.model.outputs import Event, Notes, Trace
from gripmon.model.records import Frame, FrameRecord, Limits
from gripmon.record.columns import APPLICATION_ID, EventWriter, Palette, Sender, faded
from gripmon.record.curves import CurveWriter
from gripmon.record.layout import layout_file, layout_of_both
from gripmon.record.pictures import measured_picture
from gripmon.record.read import RecordedFrames
from gripmon.record.recorder import Events, Picture, Recorder, Row, Scene, pack_trace
from gripmon.record.written_file import WrittenFile, open_stream

RECORDED, REPLAYED = "recorded", "replayed"
_ROOT = f"{RECORDED}/"
_BATCH_ROWS = 32
_LOOKS = (
    (REPLAYED, "", 255, 1.5),
    (RECORDED, _ROOT, 110, 5.0),
)  # run, root of its paths, opacity, width of its lines

_TRACK = "rig/corrected"
_TRACK_ROWS_A_CHUNK = 65536


class ComparedRecorder(Recorder):
    """Records a replay: each frame as it is judged now, together with what ``source`` recorded about it then.

    The replay has the usual entities; what was recorded has the same names below ``recorded``.  It writes in the
    caller's thread, since a replay can wait.  The daemon's own alerts and state messages are not included.
    """

    failure: str | None = None

    def __init__(self, path: Path, scene: Scene, source: RecordedFrames, recorded_limits: Limits | None) -> None:
        """``recorded_limits`` are drawn beside the replay's; None: unknown.  Raises OSError if ``path`` can't be
        written.
        """
        path.unlink(missing_ok=True)
        self._source, self._recorded_limits = source, recorded_limits
        stream, layout = open_stream(scene), layout_of_both(scene, RECORDED, REPLAYED)
        self._file = WrittenFile(path, stream, scene, 1, layout_file(layout), contextlib.nullcontext)
        stream.send_recording_name(f"{scene.name}: {RECORDED} and {REPLAYED}")
        send = Sender(stream, _ROOT)
        self._curves, self._status = CurveWriter(send, self._file.writer.corner_ids), EventWriter(send, RECORDED)
        _name_both(stream)
        self._rows: list[Row] = []
        self._rows_then: list[Row] = []
        self._events = Events(references=[scene.reference])
        self._commands_then = list(source.commands)

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """One frame with its new record; the recorded one comes from the source."""
        then, shot = self._source.record, self._source.shot
        assert then is not None, "every replayed frame has a record"
        picture: Picture | None = None
        if shot is not None and frame.image is not None:
            picture = measured_picture(shot.blob, shot.media_type, frame.image)
        newest, noted = trace(), None if notes is None else notes()
        opening_m = frame.jaw_opening_m
        share, limits = (None, None) if noted is None else (noted.statistic_share, noted.limits)
        packed = None if newest is None else pack_trace(newest)
        self._rows.append(Row(record, picture, packed, None, opening_m, share, limits))
        self._rows_then.append(Row(then, jaw_reported_m=opening_m, limits=self._recorded_limits))
        if len(self._rows) >= _BATCH_ROWS:
            self._write()

    def event(self, event: Event) -> None:
        self._events += Events.of(event)

    def close(self, timeout_s: float = 2.0) -> None:
        self._write()
        with self._failing():
            if self.failure is None:
                self._curves.finish()
                self._file.finish()
        with self._failing():
            self._file.close()

    def _write(self) -> None:
        rows, then, events = self._rows, self._rows_then, self._events
        self._rows, self._rows_then, self._events = [], [], Events()
        if not rows or self.failure is not None:
            return
        self._file.writer.write(rows, events)
        self._curves.write(then)
        newest = rows[-1].record.seq
        commands = [command for command in self._commands_then if command.seq <= newest]
        self._commands_then = [command for command in self._commands_then if command.seq > newest]
        self._status.write(then, Events(commands=commands))
        with self._failing():
            self._file.flush()

    @contextlib.contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = self.failure or f"can't write {self._file.path}: {error.strerror or error}"


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


def write_track(path: Path, recording_id: str, frames: Any, correction: Any, about: Any) -> None:
    """Write a run's frame table and its correction into a file; ``about`` is kept as JSON.

    It has the recording id of the original, so that a viewer shows both files as one, on the same timelines.  Shifts of
    the TCP are relative to the first corrected frame, mm, camera axes; raw and smoothed are the live estimates.
    Raises OSError if the file can't be written.
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
    path.write_bytes(memory.drain_as_bytes())
    stream.disconnect()


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
