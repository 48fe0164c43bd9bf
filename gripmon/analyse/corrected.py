"""A corrected run, written as JSON lines, Parquet or a track for the viewer, with its provenance."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon import __version__
from gripmon.analyse.change_points import FALSE_ALARMS_PER_HOUR
from gripmon.analyse.content import clock_time, count
from gripmon.analyse.correction import SOURCES, Correction, correct, sample
from gripmon.analyse.smoothing import BLOCK_S, SLOW_S
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array, Origin, Transform
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable

_POSE = [f"translation_{axis}_m" for axis in "xyz"], [f"rotation_{axis}" for axis in "xyzw"]
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
        """For people: number of frames, uncertainty, and one line per change point."""
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
        return "\n".join(lines)


def _tcp_sigma_m(covariance: Array) -> Array:
    """(n,) standard deviation of the TCP's position, all directions together, from (n, 6, 6)."""
    return np.asarray(np.sqrt(np.einsum("nii->ni", covariance)[:, :3].sum(axis=1)))


def name_of(recording: Recording) -> str:
    """The first files of a run."""
    return ", ".join(path.name for path in recording.files[:3]) + (", …" if len(recording.files) > 3 else "")


def correct_table(frames: FrameTable, step: Callable[[], None]) -> Correction:
    """Correct the frames of a table; ``step`` is called after each stage.  ValueError if too little was measured."""
    held = frames.ORIGINS.index(Origin.HELD.value)
    length = np.linalg.norm(frames.cam_T_grip[:, 3:], axis=1)
    measured = np.isfinite(frames.cam_T_grip).all(axis=1) & (frames.source != held) & ~frames.refused & (length > 0.0)
    poses = np.full((len(frames), 4, 4), np.nan)
    poses[measured] = frames.take(measured).matrices()
    return correct(frames.stamp_ns, poses, frames.covariance, measured, step)


class WrittenChangePoint(msgspec.Struct, frozen=True):
    """``size``: x, y, z of the TCP (m) and rotation vector (rad) from before to after, camera axes."""

    seq: int
    stamp_ns: int
    earliest_ns: int
    latest_ns: int
    size: tuple[float, ...]
    size_covariance: tuple[float, ...]


class WrittenRun(msgspec.Struct, frozen=True):
    """A run of a monitor; ``learnt``: variances per whitened axis, in units of the reported variance."""

    recording_id: str
    robot: str
    camera: str
    files: tuple[str, ...]
    frames: int
    change_points: tuple[WrittenChangePoint, ...]
    learnt: dict[str, tuple[float, ...]]
    faults: tuple[str, ...]


class Provenance(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.correction/1"):
    """First line of the file, or metadata ``gripmon`` of the table: ``inputs`` are SHA-256 by file name."""

    version: str
    inputs: tuple[tuple[str, str], ...]
    settings: dict[str, float]
    runs: tuple[WrittenRun, ...]


class CorrectedFrame(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.corrected/1"):
    """One instant.  ``run``: number of the run; ``seq``: -1 if the instant is not a frame's; ``segment``: number of
    change points before; ``sigma_tcp_m``: standard deviation of the TCP's position, all axes together.
    """

    run: int
    seq: int
    stamp_ns: int
    cam_T_grip: Transform
    covariance: tuple[float, ...]
    segment: int
    source: str
    sigma_tcp_m: float


def _run(each: CorrectedRun) -> WrittenRun:
    recording, made = each.recording, each.correction
    seqs = recording.frames.seq
    return WrittenRun(
        recording.recording_id,
        recording.robot,
        recording.camera,
        tuple(path.name for path in recording.files),
        len(seqs),
        tuple(
            WrittenChangePoint(
                int(seqs[point.index]),
                point.stamp_ns,
                point.earliest_ns,
                point.latest_ns,
                tuple(point.size.tolist()),
                tuple(point.size_covariance.ravel().tolist()),
            )
            for point in made.change_points
        ),
        {name: tuple(values.tolist()) for name, values in made.learnt.items()},
        (*recording.faults, *made.faults),
    )


def _table(number: int, each: CorrectedRun) -> pa.Table:
    """One run's instants."""
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
            **{f"translation_{axis}_m": np.ascontiguousarray(poses[:, k, 3]) for k, axis in enumerate("xyz")},
            **{f"rotation_{axis}": np.ascontiguousarray(turn[:, k]) for k, axis in enumerate("xyzw")},
            "covariance": pa.FixedSizeListArray.from_arrays(pa.array(covariance.reshape(-1)), 36),
        }
    )


def write(path: Path, runs: Sequence[CorrectedRun], inputs: Sequence[tuple[str, str]], number: int = 0) -> None:
    """Write a file, whole or not at all, of the type given by its suffix; a track (.rrd) has only run ``number``.

    ``inputs`` are SHA-256 by file name.  Raises :class:`gripmon.model.errors.NoResultError`.
    """
    part = path.with_name(f".{path.name}.part")
    settings = {"false_alarms_per_hour": FALSE_ALARMS_PER_HOUR, "block_s": BLOCK_S, "slow_error_s": SLOW_S}
    about = Provenance(__version__, tuple(inputs), settings, tuple(_run(each) for each in runs))
    try:
        if path.suffix.lower() == ".jsonl":
            _write_jsonl(part, runs, about)
        elif path.suffix.lower() == ".parquet":
            _write_parquet(part, runs, about)
        else:
            from gripmon.record.compared import write_track

            recording = runs[number].recording
            write_track(part, recording.recording_id, recording.frames, runs[number].correction, about)
        part.replace(path)
    except OSError as error:
        raise NoResultError(f"--out {path}: writing failed ({error.strerror or error})") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _write_jsonl(path: Path, runs: Sequence[CorrectedRun], about: Provenance) -> None:
    """A :class:`Provenance`, then a :class:`CorrectedFrame` a line."""
    encode = msgspec.json.Encoder().encode
    with path.open("wb") as file:
        file.write(encode(about) + b"\n")
        for number, each in enumerate(runs):
            for batch in _table(number, each).to_batches(4096):
                for row in batch.to_pylist():
                    shift, turn = ([row.pop(name) for name in names] for names in _POSE)
                    row |= {"cam_T_grip": Transform(tuple(shift), tuple(turn)), "covariance": tuple(row["covariance"])}
                    del row["robot"], row["camera"]
                    file.write(encode(CorrectedFrame(**row)) + b"\n")


def _write_parquet(path: Path, runs: Sequence[CorrectedRun], about: Provenance) -> None:
    """The same as a table, the covariance as a list of 36 (m², m rad, rad²), :class:`Provenance` as metadata."""
    whole = pa.concat_tables([_table(number, each) for number, each in enumerate(runs)])
    pq.write_table(whole.replace_schema_metadata({b"gripmon": msgspec.json.encode(about)}), path, compression="zstd")
