"""Errors, honesty and time of the transform in every condition, one table.

Runs the monitor, by edges and by corners, over simulated scenes of every condition (clutter, occlusion, blur, noise,
light, jaws, bumps …) and over the rendered sequences beside the checkout, if they are there; compares with the truth:
errors of the TCP in camera x, y, z (µm) and of the rotation, how often the transform is given, valid, and
misleading (valid, yet farther off than the alert limit or its own bound), its squared normalised error (NEES, 6 where
the covariance is true) and the time a frame takes.  The paper's two series are a benchmark of their own.

Systematic errors stay the same within a scene, so each has another pose, jaw opening, gripper (two box fingers, tapered
fingers, adaptive fingers that move on arcs), light, background and seed.  It starts from a reference that is wrong by
0.1 mm and 1 mrad on each axis (standard deviations), which the monitor is given as covariance; its first frame doesn't
count.  The rendered sequences come from another renderer; their jaw opening is as reported (rounded to 0.1 mm; the
default `jaw_sigma_m`), then the true one.

The peers get the same frames: `cv2.cornerSubPix` from where their last pose puts the corners, then `cv2.solvePnP`;
`cv2.rapid` on a mesh of the fingers; two AprilTags printed onto the fingers of the same scene, found by `cv2.aruco`
(sub-pixel corners) and by `pyapriltags`, then `solvePnP`.  A frame in which a peer is off by more than 2 mm counts as
not given, not as an error.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from benchmarks import accuracy_runs, kit, rendered
from benchmarks.accuracy_runs import WAYS, Figures, against_peers, figures, peer_figures, together
from benchmarks.bound import BOUND_ROW, pose_bound, repeatability
from benchmarks.conditions import CONDITIONS, FPS, Condition
from benchmarks.kit import Report
from benchmarks.peers import PEERS, missing_peers
from benchmarks.scenes import Scene, Sequence, make_scene

_CONDITIONS = {condition.name: condition for condition in CONDITIONS}
_QUICK_SCENES = 3
LEGEND = """\
- mean, 95 %, max: error of the TCP in camera x / y / z, µm; rot: mean error of the rotation, millidegrees
- given: frames with a new transform, %; valid: verdict valid, %
- misleading: valid, yet farther off than the alert limit of 1 mm, or than its own bound, %
- NEES: squared normalised error of valid frames, 6 if the covariance is true; gate: share below 22.46 (99.9 %), %
- ms, 99 %: median and 99th percentile of the processor time that a frame takes, one thread
- peer: mean error over that of the best markerless peer, worst axis, at most 0.33
- times: median time of the ArUco detector on the same frames over ours, at least 15
- limit: mean error to reach; the verdict tells by which factor the worst axis misses it, and other faults"""
_HEAD = (
    "condition", "limit", "mean x / y / z", "95 %", "max", "rot", "given", "valid", "misleading", "NEES", "gate", "ms",
    "99 %", "peer", "times", "verdict",
)  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK_SCENES} scenes of each condition")
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="rows with these names")
    parser.add_argument("--list", action="store_true", help="print the names of all rows and end")
    kit.numbers(
        parser,
        scenes=(None, "scenes of each condition"),
        frames=(None, "frames of each scene"),
        jobs=(2, "rows at the same time"),
    )
    parser.add_argument("--no-peers", action="store_true", help="only our own monitor")


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    if arguments.list:
        print("\n".join(row_names()))
        return 0
    names = kit.chosen(arguments.only, row_names())
    scenes = arguments.scenes or (_QUICK_SCENES if arguments.quick else None)
    report.say(f"seed {arguments.seed}; {arguments.jobs} rows at the same time, one thread each", LEGEND)
    tasks = [(name, scenes, arguments.frames, arguments.seed, not arguments.no_peers) for name in names]
    done = {task[0]: row for task, row in kit.in_processes(measure_row, tasks, arguments.jobs, "row", prepare=warm_up)}
    rows = {name: done[name] for name in names}
    whole = {way: together([rows[name]["ours"][way] for name in names if name in _CONDITIONS]) for way in WAYS}
    report.values |= {"seed": arguments.seed, "rows": rows, "together": whole}
    report.say(kit.table(_HEAD, [line for name, row in rows.items() for line in lines(name, row)]))
    report.say("\n".join(f"- {line}" for line in _summary(rows, whole)))
    return None


def row_names() -> list[str]:
    """Names of all rows, in the table's order: conditions on the project's simulator, then the rendered sequences."""
    return [*_CONDITIONS, *rendered.row_names()]


@dataclass(frozen=True)
class _Scenes:
    """Made one after the other, whenever asked for: their textures together are large."""

    condition: Condition
    count: int
    frames: int
    seed: int

    def __iter__(self) -> Iterator[Sequence]:
        return (make_scene(self.condition, self.seed, number, self.frames) for number in range(self.count))


def measure_row(name: str, scenes: int | None, frames: int | None, seed: int, peers: bool) -> Figures:
    """All figures of a row, plain values; ``scenes`` and ``frames`` replace what a condition says."""
    condition = _CONDITIONS.get(name)
    sequences: Iterable[Sequence]
    if condition is None:
        sequences = parts = rendered.sequences(name)
        out: Figures = {"what": "independent renderer", "limit_um": rendered.limit_um(name)}
        if not parts:
            return out | {"skipped": f"no {rendered.FOLDER}"}
        fps, always_seen, standing = parts[0].fps, True, False
    else:
        sequences = _Scenes(condition, scenes or condition.scenes, frames or condition.frames, seed)
        out = {"what": condition.what, "limit_um": condition.limit_um}
        fps, always_seen, standing = FPS, condition.always_seen, condition.standing
    missing = missing_peers() if peers else {}
    tracks = accuracy_runs.run(sequences, tuple(p for p in PEERS if peers and p not in missing))
    out |= {"missing_peers": missing, "peers": {p: peer_figures(tracks[p]) for p in PEERS if p in tracks}, "ours": {}}
    for way in WAYS:
        own = figures(tracks[way], fps, out["limit_um"], always_seen=always_seen, standing=standing)
        out["ours"][way] = own | against_peers(own, out["peers"]) | {"limit_um": out["limit_um"]}
    if name == BOUND_ROW:
        bounds = [pose_bound(scene) for scene in sequences if isinstance(scene, Scene)]
        out["repeatability"] = {way: repeatability(tracks[way], bounds) for way in WAYS}
    return out


def warm_up() -> None:
    """A short scene, so that no row pays for imports and first calls."""
    scene = make_scene(_CONDITIONS["ordinary"], 0, 0, 8)
    accuracy_runs.run([scene], tuple(p for p in PEERS if p not in missing_peers()))


def lines(name: str, row: Figures) -> Iterator[list[str]]:
    """A condition by edges, by corners, smoothed, and by the peers."""
    if "skipped" in row:
        yield [name, f"skipped: {row['skipped']}"]
        return
    for way, f in row["ours"].items():
        yield [name if way == "edges" else f"{name}, by {way}", *_cells(f, row["limit_um"]), str(f["verdict"])]
        if f["smoothed_um"] is not None:
            cells = ["", triple(f["smoothed_um"]), *[""] * (len(_HEAD) - 4)]
            yield [f"{name}, by {way}, smoothed, after 1 s", *cells, f["smoothed_verdict"]]
    for peer, f in row["peers"].items():
        yield [f"{name}, {peer}", *_cells(f, None)]
    for peer, why in row["missing_peers"].items():
        yield [f"{name}, {peer}", why]


def _cells(f: Figures, limit_um: Any) -> list[str]:
    """A dash where an estimator has no such figure."""
    return [
        "" if limit_um is None else " / ".join(f"{v:g}" for v in limit_um),
        *(triple(f[key]) for key in ("mean_um", "p95_um", "max_um")),
        number(f.get("rotation_mdeg"), 1),
        *(kit.percent(f.get(key)) for key in ("measured", "valid", "misleading")),
        number(f.get("nees"), 1),
        kit.percent(f.get("in_gate")),
        *(number(f[key], 2) for key in ("median_ms", "p99_ms")),
        number(f.get("of_best_peer"), 2),
        number(f.get("times_faster"), 1),
    ]


def _summary(rows: dict[str, Figures], whole: dict[str, Figures]) -> Iterator[str]:
    """All rows together, and repeatability."""
    for way, f in whole.items():
        yield (
            f"all simulated conditions, by {way}: NEES mean {number(f['nees'], 2)} (4.5 to 7.5 to be reached), "
            f"{kit.percent(f['in_gate'])} % inside the 99.9 % gate (99 %), over {f['sure']} valid frames; "
            f"rows that meet their limit: {f['met']} of {f['limited']}"
        )
    for row in rows.values():
        for way, f in row.get("repeatability", {}).items():
            yield (
                f"repeatability by {way}: spread {triple(f['spread_um'])} µm, Cramér-Rao bound "
                f"{triple(f['bound_um'])} µm (jaw unknown: {triple(f['bound_jaw_unknown_um'])}), "
                f"ratio {triple(f['ratio'])} (at most 2)"
            )


def triple(values: list[float] | None) -> str:
    """Three lengths."""
    if values is None:
        return "–"
    return " / ".join(f"{v:.2f}" if v < 1.0 else f"{v:.1f}" if v < 10.0 else f"{v:.0f}" for v in values)


def number(value: float | None, digits: int) -> str:
    return "–" if value is None or value != value else f"{value:.{digits}f}"
