"""A corrected run, and how it is written: JSON lines, Parquet or a track for the viewer, with where it comes from."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon import __version__
from gripmon.analyse.smoother import changes, correction, smoother
from gripmon.analyse.smoother.correction import SOURCES, ChangePoint, Correction, correct
from gripmon.analyse.smoother.sampling import sample
from gripmon.model.errors import NoResultError
from gripmon.model.records import Origin, Transform
from gripmon.record.read import FrameTable, Recording

BETWEEN = "between"
"""Source of an instant that is no frame's."""


@dataclass(frozen=True)
class CorrectedRun:
    """One run of a monitor and its correction; ``wanted_ns`` (n,): the instants to write instead of its frames."""

    recording: Recording
    correction: Correction
    wanted_ns: NDArray[np.int64] | None = None

    @property
    def name(self) -> str:
        """See :func:`name_of`."""
        return name_of(self.recording)


def name_of(recording: Recording) -> str:
    """The first files of a run."""
    return ", ".join(path.name for path in recording.files[:3]) + (", …" if len(recording.files) > 3 else "")


def correct_table(frames: FrameTable, step: Callable[[], None]) -> Correction:
    """Correct the frames of a table; ``step`` is called after each stage.  ValueError where too little was measured."""
    held = frames.ORIGINS.index(Origin.HELD.value)
    length = np.linalg.norm(frames.cam_T_grip[:, 3:], axis=1)
    measured = np.isfinite(frames.cam_T_grip).all(axis=1) & (frames.source != held) & ~frames.refused & (length > 0.0)
    poses = np.full((len(frames), 4, 4), np.nan)
    good = frames.cam_T_grip[measured]
    poses[measured] = np.eye(4)
    if len(good):
        poses[measured, :3, :3] = Rotation.from_quat(good[:, 3:]).as_matrix()
    poses[measured, :3, 3] = good[:, :3]
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
    """A run of a monitor; ``learnt`` by the six whitened axes, in units of the reported variance."""

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
    """One instant.  ``run`` counts the runs; ``seq`` is -1 for an instant that is no frame's; ``segment`` counts the
    change points before; ``sigma_tcp_m`` is the standard deviation of the TCP's position, all axes together.
    """

    run: int
    seq: int
    stamp_ns: int
    cam_T_grip: Transform
    covariance: tuple[float, ...]
    segment: int
    source: str
    sigma_tcp_m: float


def provenance(runs: Sequence[CorrectedRun], inputs: Sequence[tuple[str, str]]) -> Provenance:
    """What a file says about where it comes from."""
    settings = {
        "false_alarms_per_hour": changes.FALSE_ALARMS_PER_HOUR,
        "block_s": correction.BLOCK_S,
        "slow_error_s": smoother.SLOW_S,
        "mid_error_s": smoother.MID_S,
    }
    return Provenance(__version__, tuple(inputs), settings, tuple(_run(each) for each in runs))


def _run(each: CorrectedRun) -> WrittenRun:
    recording, made = each.recording, each.correction
    seqs = recording.frames.seq
    learnt = {name: getattr(made.learnt, name) for name in ("white", "mid", "slow", "frame", "unseen")}
    learnt |= {"wander_per_s": made.dynamics.wander, "turn_per_s3": made.dynamics.turn}
    return WrittenRun(
        recording.recording_id,
        recording.robot,
        recording.camera,
        tuple(path.name for path in recording.files),
        len(seqs),
        tuple(_change(point, int(seqs[point.index])) for point in made.change_points),
        {name: tuple(values.tolist()) for name, values in learnt.items()},
        (*recording.faults, *made.faults),
    )


def _change(point: ChangePoint, seq: int) -> WrittenChangePoint:
    return WrittenChangePoint(
        seq,
        point.stamp_ns,
        point.earliest_ns,
        point.latest_ns,
        tuple(point.size.tolist()),
        tuple(point.size_covariance.ravel().tolist()),
    )


class _Rows:
    """Columns of one run."""

    def __init__(self, each: CorrectedRun):
        made, frames = each.correction, each.recording.frames
        if each.wanted_ns is None:
            self.stamp_ns, self.seq, self.segment = made.stamp_ns, frames.seq, made.segment
            self.poses, self.covariance = made.cam_T_grip, made.covariance
            self.source = [SOURCES[code] for code in made.source.tolist()]
        else:
            self.stamp_ns = each.wanted_ns
            self.poses, self.covariance, self.segment = sample(made, each.wanted_ns)
            at = np.minimum(np.searchsorted(made.stamp_ns, self.stamp_ns), len(made.stamp_ns) - 1)
            own = made.stamp_ns[at] == self.stamp_ns
            self.seq = np.where(own, frames.seq[at], -1)
            codes = made.source[at].tolist()
            self.source = [SOURCES[c] if mine else BETWEEN for c, mine in zip(codes, own.tolist(), strict=True)]
        self.rotation_xyzw = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat(canonical=True)
        self.sigma_tcp_m = np.sqrt(np.einsum("nii->ni", self.covariance)[:, :3].sum(axis=1))


def _frames(number: int, rows: _Rows) -> Iterator[CorrectedFrame]:
    for k in range(len(rows.stamp_ns)):
        yield CorrectedFrame(
            number,
            int(rows.seq[k]),
            int(rows.stamp_ns[k]),
            Transform(tuple(rows.poses[k, :3, 3].tolist()), tuple(rows.rotation_xyzw[k].tolist())),
            tuple(rows.covariance[k].ravel().tolist()),
            int(rows.segment[k]),
            rows.source[k],
            float(rows.sigma_tcp_m[k]),
        )


def write(path: Path, runs: Sequence[CorrectedRun], inputs: Sequence[tuple[str, str]], number: int = 0) -> None:
    """A file, whole or not at all, of the kind that its suffix names; a track (.rrd) is of run ``number`` alone.

    ``inputs`` are SHA-256 by file name.  Raises :class:`gripmon.model.errors.NoResultError`.
    """
    part = path.with_name(f".{path.name}.part")
    about = provenance(runs, inputs)
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
            for frame in _frames(number, _Rows(each)):
                file.write(encode(frame) + b"\n")


def _write_parquet(path: Path, runs: Sequence[CorrectedRun], about: Provenance) -> None:
    """The same as a table, the covariance as a list of 36 (m², m rad, rad²), :class:`Provenance` as metadata."""
    whole = pa.concat_tables([_table(number, each) for number, each in enumerate(runs)])
    pq.write_table(whole.replace_schema_metadata({b"gripmon": msgspec.json.encode(about)}), path, compression="zstd")


def _table(number: int, each: CorrectedRun) -> pa.Table:
    rows, recording = _Rows(each), each.recording
    count = len(rows.stamp_ns)
    flat = pa.array(np.ascontiguousarray(rows.covariance).ravel())
    return pa.table(
        {
            "run": pa.array(np.full(count, number, np.int32)),
            "robot": pa.array([recording.robot] * count),
            "camera": pa.array([recording.camera] * count),
            "seq": rows.seq,
            "stamp_ns": rows.stamp_ns,
            "segment": rows.segment,
            "source": pa.array(rows.source, pa.string()),
            "sigma_tcp_m": rows.sigma_tcp_m,
            **{f"translation_{axis}_m": np.ascontiguousarray(rows.poses[:, k, 3]) for k, axis in enumerate("xyz")},
            **{f"rotation_{axis}": np.ascontiguousarray(rows.rotation_xyzw[:, k]) for k, axis in enumerate("xyzw")},
            "covariance": pa.FixedSizeListArray.from_arrays(flat, 36),
        }
    )
