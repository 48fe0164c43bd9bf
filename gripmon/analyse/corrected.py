"""A corrected run, written as JSON lines, Parquet or a track for the viewer, with its provenance."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon import __version__
from gripmon.analyse.change_points import FALSE_ALARMS_PER_HOUR, FEWEST_FOR_MEANS
from gripmon.analyse.correction import SOURCES, Correction, correct, sample
from gripmon.analyse.smoothing import BLOCK_S, SLOW_S
from gripmon.analyse.words import clock_time, count, millimetres
from gripmon.model.atomic import opened_atomically
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable

_MAX_SHOWN = 5
_POSE = {
    "translation_m": [f"translation_{axis}_m" for axis in "xyz"],
    "rotation_xyzw": [f"rotation_{axis}" for axis in "xyzw"],
}
"""Columns of a pose, by its fields."""
BETWEEN = "between"
"""Source of an instant that is not a frame's."""


@dataclass(frozen=True)
class CorrectedRun:
    """One run of a monitor and its correction; ``wanted_ns`` (n,): instants to write instead of its frames."""

    recording: Recording
    correction: Correction
    wanted_ns: NDArray[np.int64] | None = None

    @property
    def name(self) -> str:
        """See :func:`name_of`."""
        return name_of(self.recording)

    def summary(self) -> str:
        """For people: number of frames, uncertainty, one line per change point, and what may be missing among them."""
        made = self.correction
        sigma_um = 1e6 * float(np.median(_tcp_sigma_m(made.covariance)))
        points = count(len(made.change_points), "change point")
        lines = [f"{self.name}: {len(made.stamp_ns)} frames, {points}, TCP to {sigma_um:.1f} µm (1σ)"]
        for point in made.change_points:
            size_mm = 1e3 * float(np.linalg.norm(point.size[:3]))
            turn_deg = np.degrees(float(np.linalg.norm(point.size[3:])))
            spread_ms = 1e-6 * (point.latest_ns - point.earliest_ns)
            seq = int(self.recording.frames.seq[point.index])
            when = f"{clock_time(point.stamp_ns, 3)} UTC, within {spread_ms:.0f} ms"
            lines.append(f"  frame {seq} ({when}): {size_mm:.3f} mm, {turn_deg:.3f}°")
        if made.undecided_ns and len(made.stamp_ns) < FEWEST_FOR_MEANS:
            lines.append("  too few frames to tell a motion of the camera from another background (σ includes both)")
        elif made.undecided_ns:
            when = ", ".join(clock_time(stamp_ns, 3) for stamp_ns in made.undecided_ns[:_MAX_SHOWN])
            more = ", …" if len(made.undecided_ns) > _MAX_SHOWN else ""
            lines.append(f"  at {when}{more}: the camera moved, or the background changed (σ includes both)")
        missable = millimetres(made.missable_m)
        lines.append(f"  steps of up to {missable} may be missing, since another background might explain them")
        return "\n".join(lines)


def _tcp_sigma_m(covariance: Array) -> Array:
    """(n,) standard deviation of the TCP's position, all directions together, from (n, 6, 6)."""
    return np.asarray(np.sqrt(np.einsum("nii->ni", covariance)[:, :3].sum(axis=1)))


def name_of(recording: Recording) -> str:
    """The first files of a run."""
    return ", ".join(path.name for path in recording.files[:3]) + (", …" if len(recording.files) > 3 else "")


def correct_table(frames: FrameTable, step: Callable[[], None] = lambda: None) -> Correction:
    """Correct the frames of a table; ``step`` is called after each stage.  ValueError if too little was measured."""
    measured = frames.measured
    poses = np.full((len(frames), 4, 4), np.nan)
    poses[measured] = frames.take(measured).matrices()
    return correct(frames.stamp_ns, poses, frames.covariance, measured, step)


def _about(runs: Sequence[CorrectedRun], inputs: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Where the transforms come from; of each run its change points, and what was learnt of its errors."""
    about = {
        "schema": "gripmon.correction/1",
        "version": __version__,
        "inputs": inputs,
        "settings": {"false_alarms_per_hour": FALSE_ALARMS_PER_HOUR, "block_s": BLOCK_S, "slow_error_s": SLOW_S},
        "runs": [
            {
                "recording_id": each.recording.recording_id,
                "robot": each.recording.robot,
                "camera": each.recording.camera,
                "files": [path.name for path in each.recording.files],
                "frames": len(each.recording.frames),
                "change_points": [
                    {"seq": int(each.recording.frames.seq[point.index]), **dataclasses.asdict(point)}
                    for point in each.correction.change_points
                ],
                "undecided_ns": each.correction.undecided_ns,
                "missable_m": each.correction.missable_m,
                "learnt": each.correction.learnt,
                "faults": [*each.recording.faults, *each.correction.faults],
            }
            for each in runs
        ],
    }
    plain: dict[str, Any] = msgspec.to_builtins(about, enc_hook=lambda values: np.ravel(values).tolist())
    return plain


def _table(number: int, each: CorrectedRun) -> pa.Table:
    """One run's instants.  ``seq`` is -1 if one is not a frame's; ``segment``: number of change points before;
    ``sigma_tcp_m``: standard deviation of the TCP's position, all axes together; ``covariance`` by rows, 36 (m², m rad,
    rad²).
    """
    made, frames = each.correction, each.recording.frames
    if each.wanted_ns is None:
        stamp_ns, seq, segment = made.stamp_ns, frames.seq, made.segment
        poses, covariance = made.cam_T_grip, made.covariance
        source = np.array(SOURCES, object)[made.source]
    else:
        stamp_ns = each.wanted_ns
        poses, covariance, segment = sample(made, stamp_ns)
        at = np.minimum(np.searchsorted(made.stamp_ns, stamp_ns), len(made.stamp_ns) - 1)
        own = made.stamp_ns[at] == stamp_ns
        seq = np.where(own, frames.seq[at], -1)
        source = np.where(own, np.array(SOURCES, object)[made.source[at]], BETWEEN)
    turn = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    return pa.table(
        {
            "run": np.full(len(seq), number, np.int32),
            "robot": pa.array([each.recording.robot] * len(seq), pa.string()),
            "camera": pa.array([each.recording.camera] * len(seq), pa.string()),
            "seq": seq,
            "stamp_ns": stamp_ns,
            "segment": segment,
            "source": pa.array(source.tolist(), pa.string()),
            "sigma_tcp_m": _tcp_sigma_m(covariance),
            **dict(zip(_POSE["translation_m"], np.ascontiguousarray(poses[:, :3, 3].T), strict=True)),
            **dict(zip(_POSE["rotation_xyzw"], np.ascontiguousarray(turn.T), strict=True)),
            "covariance": pa.FixedSizeListArray.from_arrays(pa.array(covariance.reshape(-1)), 36),
        }
    )


def write(path: Path, runs: Sequence[CorrectedRun], inputs: Sequence[tuple[str, str]], number: int = 0) -> None:
    """Write a file, whole or not at all, of the type given by its suffix; a track (.rrd) has only run ``number``.

    ``inputs`` are SHA-256 by file name.  Raises :class:`gripmon.model.errors.NoResultError`.
    """
    about = _about(runs, inputs)
    try:
        with opened_atomically(path) as file:
            if path.suffix.lower() == ".rrd":
                from gripmon.record.compared import track

                recording = runs[number].recording
                file.write(track(recording.recording_id, recording.frames, runs[number].correction, about))
            elif path.suffix.lower() == ".parquet":
                whole = pa.concat_tables([_table(k, each) for k, each in enumerate(runs)])
                whole = whole.replace_schema_metadata({b"gripmon": msgspec.json.encode(about)})
                pq.write_table(whole, file, compression="zstd")
            else:
                file.writelines(msgspec.json.encode(line) + b"\n" for line in (about, *_lines(runs)))
    except OSError as error:
        raise NoResultError(f"--out {path}: writing failed ({error.strerror or error})") from None


def _lines(runs: Sequence[CorrectedRun]) -> Iterator[dict[str, Any]]:
    """The rows of the runs' tables, one for an instant, with the pose as messages have it."""
    for number, each in enumerate(runs):
        for batch in _table(number, each).drop_columns(["robot", "camera"]).to_batches(4096):
            for row in batch.to_pylist():
                pose = {name: [row.pop(column) for column in columns] for name, columns in _POSE.items()}
                yield {"schema": "gripmon.corrected/1", **row, "cam_T_grip": pose}
