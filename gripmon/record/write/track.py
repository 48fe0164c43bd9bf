"""A corrected track of transforms as a recording of its own, with the original's recording id: a viewer that is given
both files shows them as one, on the same timelines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from gripmon.record.write import palette
from gripmon.record.write.files import APPLICATION_ID

TRACK = "rig/corrected"
SHIFT = "corrected/tcp_shift_mm"
LIVE = "corrected/raw_shift_mm"
SMOOTHED = "corrected/smoothed_shift_mm"
SIGMA = "corrected/tcp_sigma_mm"
EVENTS = "corrected/events"
PROVENANCE = "corrected/provenance"
_ROWS = 65536


def write_track(path: Path, recording_id: str, frames: Any, correction: Any, about: msgspec.Struct) -> None:
    """Write a run's frame table and correction into a file; ``about`` is kept as JSON.

    Shifts of the TCP are against the first corrected frame, mm, camera axes; raw and smoothed are the live ones.
    Raises OSError where the file can't be written.
    """
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id)
    memory = stream.memory_recording()  # rerun's files don't say that the disk is full
    _static(stream, about)
    for begin in range(0, len(correction.stamp_ns), _ROWS):
        _columns(stream, frames, correction, slice(begin, begin + _ROWS))
    _events(stream, frames, correction)
    path.write_bytes(memory.drain_as_bytes())
    stream.disconnect()


def _static(stream: rr.RecordingStream, about: msgspec.Struct) -> None:
    names = ["x", "y", "z"]
    styles = ((SHIFT, 255, 3.0, "corrected"), (LIVE, 90, 0.7, "raw"), (SMOOTHED, 150, 1.2, "smoothed"))
    for entity, alpha, width, what in styles:
        colours = [palette.faded(colour, alpha) for colour in palette.AXES]
        lines = rr.SeriesLines(names=[f"{what} {n}" for n in names], colors=colours, widths=[width] * 3)
        stream.log(entity, lines, static=True)
    stream.log(TRACK, rr.TransformAxes3D(0.02), static=True)
    stream.log(PROVENANCE, rr.AnyValues(json=msgspec.json.encode(about).decode()), static=True)


def _times(frames: Any, rows: Any) -> list[rr.TimeColumn]:
    stamps = np.asarray(frames.stamp_ns[rows], np.int64).astype("datetime64[ns]")
    return [
        rr.TimeColumn("capture_time", timestamp=stamps),
        rr.TimeColumn("frame", sequence=np.asarray(frames.seq[rows], np.int64)),
    ]


def _columns(stream: rr.RecordingStream, frames: Any, correction: Any, rows: slice) -> None:
    times = _times(frames, rows)
    poses = correction.cam_T_grip[rows]
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternions)
    stream.send_columns(TRACK, times, columns)
    start_m = correction.cam_T_grip[0, :3, 3]
    shifts = {
        SHIFT: poses[:, :3, 3],
        LIVE: frames.cam_T_grip[rows, :3],
        SMOOTHED: frames.smoothed[rows, :3],
        SIGMA: np.sqrt(np.einsum("nii->ni", correction.covariance[rows])[:, :3]) + start_m,
    }
    for entity, positions_m in shifts.items():
        values = 1e3 * (positions_m - start_m)
        known = np.isfinite(values).all(axis=1)
        lengths = np.where(known, 3, 0)
        stream.send_columns(entity, times, rr.Scalars.columns(scalars=values[known].ravel()).partition(lengths))


def _events(stream: rr.RecordingStream, frames: Any, correction: Any) -> None:
    points = correction.change_points
    if not points:
        return
    rows = np.array([point.index for point in points])
    texts = []
    for point in points:
        size_mm, turn_deg = 1e3 * np.linalg.norm(point.size[:3]), np.degrees(np.linalg.norm(point.size[3:]))
        within_ms = 1e-6 * (point.latest_ns - point.earliest_ns)
        texts.append(f"the pose changed by {size_mm:.3f} mm, {turn_deg:.3f}° (known to {within_ms:.0f} ms)")
    stream.send_columns(EVENTS, _times(frames, rows), rr.TextLog.columns(text=texts, level=["WARN"] * len(texts)))
