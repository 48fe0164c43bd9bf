"""What a sweep of camera mounts says, as a table."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.daemon.sweeping import Sweep
    from gripmon.model.camera import Camera
    from gripmon.teach.mounts import Trial

_SHOWN = 8
_REASONS_SHOWN = 4


_COLUMNS = (
    ("distance", "mm", 9), ("tilt", "°", 7), ("side", "°", 7), ("roll", "°", 7), ("focal", "px", 7), ("corners", "", 9),
    ("edges", "", 7), ("travel", "%", 8), ("sigma x", "mm", 9), ("y", "mm", 7), ("z", "mm", 7), ("worst", "mm", 8),
    ("bound", "mm", 8), ("notices", "mm", 9), ("in", "frames", 8), ("margin", "px", 8), ("shift", "mm", 7),
)  # fmt: skip


def as_text(swept: Sweep) -> list[str]:
    """A table for a person: mm, degrees."""
    config, grid, at_px, present, ranked = swept.config, swept.grid, swept.at_px, swept.present, swept.ranked
    working = sum(trial.works for trial in ranked)
    warn_mm = 1e3 * config.settings.monitor.policy.warn_m
    lines = [
        f"{config.path}: {len(ranked)} mounts tried, {working} would work",
        f"TCP        at ({at_px[0]:.1f}, {at_px[1]:.1f}) px in all of them",
        *_looked_at(config, present),
        " " * 10 + "".join(title.rjust(width) for title, _, width in _COLUMNS),
        " " * 10 + "".join(unit.rjust(width) for _, unit, width in _COLUMNS),
    ]
    lines += [
        f"{'best' if k == 0 and trial.works else '':<10}{_row(grid.rigs[trial.lens].camera, trial)}"
        for k, trial in enumerate(ranked[:_SHOWN])
    ]
    place = sum(trial.rank < present.rank for trial in ranked)
    lines.append(f"{'present':<10}{_row(config.camera, present)}")
    better = f"{place} of those tried are" if place else "none of those tried is"
    lines.append(f"           {better} better than the present one")
    lines += [f"           present: {fault.text}" for fault in present.faults]
    lines += _failing(ranked)
    lines += [
        "columns    corners, edges: the fewest over the jaw's travel; travel: part of it in which enough is visible;",
        "           sigma: one frame's TCP at the usual opening; worst: along its least certain direction, at the",
        "           worst opening; bound: on its error at the worst opening, which alert_limit_m is held against;",
        "           notices: the smallest step that is noticed along every axis; in: frames until",
        f"           one of {warn_mm:g} mm is; margin: corners to the image's border; shift: of the camera sideways",
        "           until too little is in view.  Not known here: focus, light, what is in the camera's way, and what",
        "           hides the fingers without being in the gripper file.",
    ]
    if not config.gripper.faces:
        lines += [
            "no faces   The gripper file has none, as an inferred one: every edge counts as seen from everywhere, also",
            "           where the finger itself hides it. Trust mounts near the present one only.",
        ]
    if ranked[0].works:
        lines += _to_copy(ranked[0])
    return lines


def _looked_at(config: Config, present: Trial) -> list[str]:
    """Which openings count, and how taught edges do."""
    lines = []
    low_mm, high_mm = 1e3 * present.openings_m[0], 1e3 * present.openings_m[-1]
    if high_mm > low_mm:
        usual = f"usual {1e3 * (config.jaw_opening_m or config.gripper.jaw_nominal_m):.1f} mm"
        lines.append(f"jaw        {low_mm:.1f} to {high_mm:.1f} mm of opening, {usual}; --jaw MIN:MAX for a part of it")
    if config.taught is not None:
        lines.append("taught     as seen from the present mount; taught again at another one it gets more exact there")
    return lines


def _row(camera: Camera, trial: Trial) -> str:
    mount, found = trial.mount, trial.measurable
    angles = (math.degrees(v) for v in (mount.tilt_rad, mount.side_rad, mount.roll_rad))
    cells = [f"{1e3 * mount.distance_m:.1f}", *(f"{round(v, 1) + 0.0:.1f}" for v in angles), f"{camera.fx_px:.0f}"]
    cells += [str(trial.corners.min()), str(trial.edges.min()), f"{100.0 * trial.share:.0f}"]
    if found is not None:
        cells += [_number(v, 1e3, 3) for v in found.frame.sigma[:3].tolist()]
        bound_m = found.promise.protection.position_m
        cells += [_number(found.worst_sigma_m, 1e3, 3), _number(bound_m, 1e3, 3), _number(trial.noticed_m, 1e3, 3)]
        cells += ["never" if found.delay_frames is None else str(found.delay_frames)]
        cells += [_number(found.margin_px, 1.0, 0), _number(found.shift_m, 1e3, 1)]
    row = "".join(cell.rjust(width) for cell, (_, _, width) in zip(cells, _COLUMNS, strict=False))
    return row if trial.works else f"{row}  NO: {trial.faults[0].text}"


def _number(value: float, factor: float, digits: int) -> str:
    scaled = factor * value
    return f"{scaled:.{digits if abs(scaled) < 10.0 or digits < 2 else 1}f}"


def _failing(ranked: list[Trial]) -> list[str]:
    """The commonest first reasons."""
    counts: dict[str, int] = {}
    for trial in ranked:
        if trial.faults:
            counts[trial.faults[0].kind] = counts.get(trial.faults[0].kind, 0) + 1
    commonest = sorted(counts.items(), key=lambda item: -item[1])[:_REASONS_SHOWN]
    return [
        f"{'others' if k == 0 else '':<10} {count} would not work: {kind}" for k, (kind, count) in enumerate(commonest)
    ]


def _to_copy(best: Trial) -> list[str]:
    from gripmon.model.geometry import to_record

    transform = to_record(best.cam_T_grip)
    return [
        "best as    reference:",
        "             cam_T_grip:",
        f"               translation_m: [{', '.join(f'{v:.6f}' for v in transform.translation_m)}]",
        f"               rotation_xyzw: [{', '.join(f'{v:.6f}' for v in transform.rotation_xyzw)}]",
    ]
