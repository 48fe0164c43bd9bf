"""``gripmon check CONFIG --sweep``: what would other camera mounts see?"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gripmon.cli.common import Arguments, progress_bar, two_numbers
from gripmon.model.errors import InputError
from gripmon.model.stopping import EXIT_DONE

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.daemon.sweeping import Sweep
    from gripmon.teach.mounts import Trial

ABOUT = """\
RANGE is FIRST:LAST:COUNT, or single values with commas; write --roll=-90:90:3 where it begins with a minus. \
Defaults are the configuration's values, except for distance (0.6 to 1.8 times) and tilt (0 to 75°)."""

OPTIONS = """
--sweep           evaluate other camera mounts and lenses; the source is not used
--distance RANGE  from the camera's centre to the TCP (m)
--tilt RANGE      of the optical axis against the gripper's z axis (degrees, 0 along the fingers)
--side RANGE      direction of the camera about the gripper's z axis (degrees; 0 at -y, 90 at +x)
--roll RANGE      about the optical axis: clockwise rotation of the picture (degrees)
--focal RANGE     focal length, same sensor (px); any but the calibrated one without distortion
| --fov RANGE     the same by the image's width (degrees)
| --lens FILE...  a calibrated one, by gripmon calibrate intrinsics; may be repeated
--at U,V          position of the TCP in the present camera's image (px; default: as now)
--jaw MIN:MAX     openings at which the mount has to work (m; default: all)
"""
_RANGES = ("distance", "tilt", "side", "roll", "focal", "fov")
NAMES = (*_RANGES, "lens", "at", "jaw")


def run(arguments: Arguments) -> int:
    """Evaluate the mounts, print the table."""
    import msgspec

    from gripmon.daemon.config import load_config
    from gripmon.daemon.sweeping import sweep, values_in

    config = load_config(arguments.config[0], check_source=False)
    typed = {name: getattr(arguments, name) for name in _RANGES}
    ranges = {name: values_in(name, text) for name, text in typed.items() if text is not None}
    at_px = two_numbers(arguments.at or "", ",")
    if at_px is None and arguments.at is not None:
        width_px, height_px = config.camera.width_px, config.camera.height_px
        right = f"two numbers inside {width_px} x {height_px} px, such as --at {width_px // 2},{height_px // 2}"
        raise InputError(f"--at {arguments.at}: isn't a point of the image; {right}")
    travel, travel_m = f"{config.gripper.jaw_min_m:g}:{config.gripper.jaw_max_m:g}", two_numbers(arguments.jaw or "")
    if travel_m is None and arguments.jaw is not None:
        raise InputError(f"--jaw {arguments.jaw}: isn't a range; MIN:MAX in metres, within {travel}")
    swept = sweep(config, ranges, arguments.lens or (), at_px, travel_m, progress_bar)
    arguments.answer(msgspec.to_builtins(swept), _as_text(config, swept))
    return EXIT_DONE


_SHOWN, _REASONS_SHOWN = 8, 4
_COLUMNS = (
    ("distance", "mm", 9), ("tilt", "°", 7), ("side", "°", 7), ("roll", "°", 7), ("focal", "px", 7), ("corners", "", 9),
    ("edges", "", 7), ("travel", "%", 8), ("sigma x", "mm", 9), ("y", "mm", 7), ("z", "mm", 7), ("worst", "mm", 8),
    ("bound", "mm", 8), ("detects", "mm", 9), ("in", "frames", 8), ("margin", "px", 8), ("shift", "mm", 7),
)  # fmt: skip


def _as_text(config: Config, swept: Sweep) -> list[str]:
    """A table for a person: mm, degrees."""
    at_px, present, ranked = swept.tcp_at_px, swept.present, swept.mounts
    working = sum(trial.works for trial in ranked)
    lines = [
        f"{config.path}: {len(ranked)} mounts tried, {working} would work",
        f"TCP        at ({at_px[0]:.1f}, {at_px[1]:.1f}) px in all of them",
        *_looked_at(config, present),
        " " * 10 + "".join(title.rjust(width) for title, _, width in _COLUMNS),
        " " * 10 + "".join(unit.rjust(width) for _, unit, width in _COLUMNS),
    ]
    lines += [
        f"{'best' if k == 0 and trial.works else '':<10}{_row(trial)}"
        for k, trial in enumerate(ranked[:_SHOWN])
    ]
    place = sum(trial.rank < present.rank for trial in ranked)
    lines.append(f"{'present':<10}{_row(present)}")
    better = f"{place} of those tried are" if place else "none of those tried is"
    lines.append(f"           {better} better than the present one")
    lines += [f"           present: {fault.text}" for fault in present.faults]
    lines += _failing(ranked)
    lines += [
        "columns    corners, edges: the fewest over the jaw's travel; travel: part of it in which enough is visible;",
        "           sigma: one frame's TCP at the usual opening; worst: along its least certain direction, at the",
        "           worst opening; bound: on its error at the worst opening, compared with alert_limit_m;",
        "           detects: the smallest step detected along every axis; in: frames until",
        f"           one of {1e3 * swept.warn_m:g} mm is; margin: corners to the image's border; shift: of the camera",
        "           sideways until too little is in view.  Not included: focus, light, obstacles, and what hides the",
        "           fingers without being in the gripper file.",
    ]
    if not config.gripper.faces:
        lines += [
            "no faces   The gripper file has none, like an inferred one: every edge counts as visible from everywhere,",
            "           even if the finger itself hides it. Trust only mounts near the present one.",
        ]
    if ranked[0].works:
        lines += _to_copy(ranked[0])
    return lines


def _looked_at(config: Config, present: Trial) -> list[str]:
    """Which openings count, and how taught edges are used."""
    lines = []
    low_mm, high_mm = 1e3 * present.jaw.opening_m[0], 1e3 * present.jaw.opening_m[-1]
    if high_mm > low_mm:
        usual = f"usual {1e3 * (config.jaw_opening_m or config.gripper.jaw_nominal_m):.1f} mm"
        lines.append(f"jaw        {low_mm:.1f} to {high_mm:.1f} mm of opening, {usual}; --jaw MIN:MAX for a part of it")
    if config.taught is not None:
        lines.append("taught     at the present mount; teaching again at another mount is more accurate there")
    elif config.gripper.edge_bevel_m[~config.gripper.edge_curved].any():
        lines.append("taught     not yet: the gripper file's bevels count as taught; until they are, bounds are wider")
    return lines


def _row(trial: Trial) -> str:
    angles = (math.degrees(v) for v in (trial.tilt_rad, trial.side_rad, trial.roll_rad))
    cells = [f"{1e3 * trial.distance_m:.1f}", *(f"{round(v, 1) + 0.0:.1f}" for v in angles), f"{trial.focal_px:.0f}"]
    cells += [str(min(trial.jaw.corners)), str(min(trial.jaw.edges)), f"{100.0 * trial.jaw.share:.0f}"]
    frame, promises = trial.accuracy, trial.promises
    if frame is not None and frame.expected is not None and promises is not None:
        cells += [_number(v, 1e3, 3) for v in frame.expected.tcp_m]
        cells += [_number(v, 1e3, 3) for v in (trial.worst_sigma_m, promises.sizes.median_m, trial.noticed_m)]
        cells += ["never" if trial.delay_frames is None else str(trial.delay_frames)]
        cells += [_number(trial.margin_px, 1.0, 0), _number(trial.shift_m, 1e3, 1)]
    row = "".join(cell.rjust(width) for cell, (_, _, width) in zip(cells, _COLUMNS, strict=False))
    return row if trial.works else f"{row}  NO: {trial.faults[0].text}"


def _number(value: float | None, factor: float, digits: int) -> str:
    scaled = math.inf if value is None else factor * value
    return f"{scaled:.{digits if abs(scaled) < 10.0 or digits < 2 else 1}f}"


def _failing(ranked: Sequence[Trial]) -> list[str]:
    """The most common first reasons."""
    kinds = Counter(trial.faults[0].kind for trial in ranked if trial.faults).most_common(_REASONS_SHOWN)
    return [f"{'' if k else 'others':<10} {count} would not work: {kind}" for k, (kind, count) in enumerate(kinds)]


def _to_copy(best: Trial) -> list[str]:
    transform = best.cam_T_grip
    return [
        "best as    reference:",
        "             cam_T_grip:",
        f"               translation_m: [{', '.join(f'{v:.6f}' for v in transform.translation_m)}]",
        f"               rotation_xyzw: [{', '.join(f'{v:.6f}' for v in transform.rotation_xyzw)}]",
    ]
