"""The rows of ``tools/bench accuracy``: conditions on the project's simulator, then the rendered sequences."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from benchmarks import rendered
from benchmarks.accuracy_runs import WAYS, Track, run
from benchmarks.accuracy_stats import against_peers, figures, peer_figures
from benchmarks.bound import BOUND_ROW, pose_bound, repeatability
from benchmarks.conditions import CONDITIONS, FPS, Condition, Limit
from benchmarks.peers import PEERS, missing_peers
from benchmarks.scenes import Scene, Sequence, make_scene

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


def is_simulated(name: str) -> bool:
    """Whether a row is a condition on the project's own simulator."""
    return name in _CONDITIONS


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
        _Scenes(condition, scenes or condition.scenes, frames or condition.frames, seed),
        FPS,
        condition.limit_um,
        condition.always_seen,
        condition.standing,
    )


@dataclass(frozen=True)
class _Scenes:
    """Made one after the other, whenever asked for: their textures together are large."""

    condition: Condition
    count: int
    frames: int
    seed: int

    def __iter__(self) -> Iterator[Sequence]:
        return (make_scene(self.condition, self.seed, number, self.frames) for number in range(self.count))


def measure_row(
    name: str, *, scenes: int | None, frames: int | None, seed: int, peers: bool
) -> tuple[dict[str, Any], dict[str, Track]]:
    """All figures of a row, plain values, and the tracks that they come from."""
    row = plan_row(name, scenes=scenes, frames=frames, seed=seed)
    out: dict[str, Any] = {"what": row.what, "limit_um": row.limit_um, "skipped": row.skipped}
    if row.skipped:
        return out, {}
    missing = out["missing_peers"] = missing_peers() if peers else {}
    tracks = run(row.sequences, tuple(p for p in PEERS if peers and p not in missing))
    out["peers"] = {p: peer_figures(tracks[p]) for p in PEERS if p in tracks}
    out["ours"] = {}
    for way in WAYS:
        own = figures(tracks[way], row.fps, row.limit_um, always_seen=row.always_seen, standing=row.standing)
        out["ours"][way] = own | against_peers(own, out["peers"]) | {"limit_um": row.limit_um}
    if name == BOUND_ROW:
        bounds = [pose_bound(scene) for scene in row.sequences if isinstance(scene, Scene)]
        out["repeatability"] = {way: repeatability(tracks[way], bounds) for way in WAYS}
    return out, tracks


def warm_up() -> None:
    """A short scene, so that no row pays for imports and first calls."""
    run([make_scene(_CONDITIONS["ordinary"], 0, 0, 8)], tuple(p for p in PEERS if p not in missing_peers()))
