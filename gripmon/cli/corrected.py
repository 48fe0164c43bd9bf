"""What ``gripmon correct`` writes: JSON lines and Parquet, with where it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from gripmon import __version__
from gripmon.analyse.smoother import SOURCES, ChangePoint, changes, correction, sample, smoother
from gripmon.model.records import Transform

if TYPE_CHECKING:
    from gripmon.cli.correct import CorrectedRun

BETWEEN = "between"
"""Source of an instant that is no frame's."""


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


def provenance(runs: list[CorrectedRun], inputs: list[tuple[str, str]]) -> Provenance:
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


def write_jsonl(path: Path, runs: list[CorrectedRun], inputs: list[tuple[str, str]]) -> None:
    """A :class:`Provenance`, then a :class:`CorrectedFrame` a line."""
    encode = msgspec.json.Encoder().encode
    with path.open("wb") as file:
        file.write(encode(provenance(runs, inputs)) + b"\n")
        for number, each in enumerate(runs):
            for frame in _frames(number, _Rows(each)):
                file.write(encode(frame) + b"\n")


def write_parquet(path: Path, runs: list[CorrectedRun], inputs: list[tuple[str, str]]) -> None:
    """The same as a table, the covariance as a list of 36 (m², m rad, rad²), :class:`Provenance` as metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = msgspec.json.encode(provenance(runs, inputs))
    tables = [_table(number, each, pa) for number, each in enumerate(runs)]
    whole = pa.concat_tables(tables).replace_schema_metadata({b"gripmon": about})
    pq.write_table(whole, path, compression="zstd")


def _table(number: int, each: CorrectedRun, pa: Any) -> Any:
    rows, recording = _Rows(each), each.recording
    count = len(rows.stamp_ns)
    columns: dict[str, Any] = {
        "run": pa.array(np.full(count, number, np.int32)),
        "robot": pa.array([recording.robot] * count),
        "camera": pa.array([recording.camera] * count),
        "seq": pa.array(rows.seq),
        "stamp_ns": pa.array(rows.stamp_ns),
        "segment": pa.array(rows.segment),
        "source": pa.array(rows.source, pa.string()),
        "sigma_tcp_m": pa.array(rows.sigma_tcp_m),
    }
    for k, axis in enumerate("xyz"):
        columns[f"translation_{axis}_m"] = pa.array(np.ascontiguousarray(rows.poses[:, k, 3]))
    for k, axis in enumerate("xyzw"):
        columns[f"rotation_{axis}"] = pa.array(np.ascontiguousarray(rows.rotation_xyzw[:, k]))
    flat = pa.array(np.ascontiguousarray(rows.covariance).ravel())
    columns["covariance"] = pa.FixedSizeListArray.from_arrays(flat, 36)
    return pa.table(columns)
