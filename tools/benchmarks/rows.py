"""The rows of ``tools/bench accuracy``: conditions on the project's simulator, then the rendered sequences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from benchmarks import rendered
from benchmarks.accuracy_runs import run_ours
from benchmarks.accuracy_stats import figures
from benchmarks.conditions import CONDITIONS, FPS, Condition, Limit
from benchmarks.scenes import Sequence, make_scene

_CONDITIONS = {condition.name: condition for condition in CONDITIONS}


@dataclass(frozen=True)
class RowPlan:
    """What a row consists of and is held against."""

    what: str
    sequences: Iterable[Sequence]
    fps: float
    limit_um: Limit | None
    always_seen: bool = True
    standing: bool = False
    skipped: str | None = None


def row_names() -> list[str]:
    """Names of all rows, in the table's order."""
    return [*_CONDITIONS, *rendered.row_names()]


def plan_row(name: str, *, scenes: int | None, frames: int | None, seed: int) -> RowPlan:
    """A row by name; ``scenes`` and ``frames`` replace what a condition says."""
    condition = _CONDITIONS.get(name)
    if condition is None:
        parts = rendered.sequences(name)
        skipped = None if parts else f"no {rendered.FOLDER}"
        fps = parts[0].fps if parts else FPS
        return RowPlan("independent renderer", parts, fps, rendered.limit_um(name), skipped=skipped)
    return RowPlan(
        condition.what,
        _scenes(condition, scenes or condition.scenes, frames or condition.frames, seed),
        FPS,
        condition.limit_um,
        condition.always_seen,
        condition.standing,
    )


def _scenes(condition: Condition, scenes: int, frames: int, seed: int) -> Iterable[Sequence]:
    """One after the other: pictures of many scenes would not fit into memory."""
    for number in range(scenes):
        yield make_scene(condition, seed, number, frames)


def measure_row(name: str, *, scenes: int | None, frames: int | None, seed: int, peers: bool) -> dict[str, Any]:
    """All figures of a row, plain values."""
    row = plan_row(name, scenes=scenes, frames=frames, seed=seed)
    out: dict[str, Any] = {"what": row.what, "limit_um": row.limit_um, "skipped": row.skipped}
    if row.skipped:
        return out
    tracks = run_ours(row.sequences)
    out["ours"] = {
        way: figures(track, row.fps, row.limit_um, always_seen=row.always_seen, standing=row.standing)
        for way, track in tracks.items()
    }
    return out


def warm_up() -> None:
    """A short scene, so that no row pays for imports and first calls."""
    run_ours([make_scene(_CONDITIONS["ordinary"], 0, 0, 8)])
