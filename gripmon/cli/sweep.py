"""``gripmon check CONFIG --sweep``: what would other camera mounts see?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gripmon.cli import render
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
_ABOUT = """\
corners, edges: the fewest over the jaw's travel; travel: part of it in which enough is visible; sigma: one frame's
TCP at the usual opening; worst: along its least certain direction, at the worst opening; bound: on its error at the
usual opening, compared with alert_limit_m; detects: the smallest step detected along every axis; frames: until one of
warn_m is; margin: corners to the image's border; shift: of the camera sideways until too little is in view.  Not
included: focus, light, obstacles, and what hides the fingers without being in the gripper file."""
_NO_FACES = """\
The gripper file has none, like an inferred one: every edge counts as visible from everywhere, even if the finger \
itself hides it.  Trust only mounts near the present one."""


def _as_text(config: Config, swept: Sweep) -> list[str]:
    """The best mounts and the present one as a table."""
    present, ranked = swept.present, swept.mounts
    better = sum(trial.rank < present.rank for trial in ranked)
    notes: dict[str, Any] = {"tcp_at_px": swept.tcp_at_px, **_looked_at(config, present.jaw.opening_m)}
    notes["present"] = f"{better or 'none'} of those tried {'are' if better > 1 else 'is'} better"
    if not config.gripper.faces:
        notes["no_faces"] = _NO_FACES
    if len(present.faults) > 1:
        notes["present_too"] = [fault.text for fault in present.faults[1:]]
    reasons = Counter(trial.faults[0].kind for trial in ranked if trial.faults).most_common(_REASONS_SHOWN)
    if reasons:
        notes["others"] = [f"{count} would not work: {kind}" for kind, count in reasons]
    rows = [_row("present", present), *(_row(str(k + 1), trial) for k, trial in enumerate(ranked[:_SHOWN]))]
    head = f"{config.path}: {len(ranked)} mounts tried, {sum(trial.works for trial in ranked)} would work"
    best = _to_copy(ranked[0]) if ranked[0].works else ()
    return [head, *render.table(rows), *_ABOUT.splitlines(), *render.lines(notes), *best]


def _looked_at(config: Config, openings_m: Sequence[float]) -> dict[str, str]:
    """Which openings count, and how taught edges are used."""
    notes = {}
    if openings_m[-1] > openings_m[0]:
        usual = f"usual {1e3 * (config.jaw_opening_m or config.gripper.jaw_nominal_m):.1f} mm"
        span = f"{1e3 * openings_m[0]:.1f} to {1e3 * openings_m[-1]:.1f} mm of opening"
        notes["jaw"] = f"{span}, {usual}; --jaw MIN:MAX for a part of it"
    if config.taught is not None:
        notes["taught"] = "at the present mount; teaching again at another mount is more accurate there"
    elif config.gripper.edge_bevel_m[~config.gripper.edge_curved].any():
        notes["taught"] = "not yet: the gripper file's bevels count as taught; until they are, bounds are wider"
    return notes


def _row(rank: str, trial: Trial) -> dict[str, Any]:
    frame, promises = trial.accuracy, trial.promises
    row = {"rank": rank, **{key: getattr(trial, key) for key in _OF_MOUNT}}
    row |= {"corners": min(trial.jaw.corners), "edges": min(trial.jaw.edges), "travel %": 100.0 * trial.jaw.share}
    found: dict[str, Any] = dict.fromkeys(
        ("sigma_m", "worst_m", "bound_m", "detects_m", "frames", "margin_px", "shift_m")
    )
    if frame is not None and frame.expected is not None and promises is not None:
        values = (
            frame.expected.tcp_m, trial.worst_sigma_m, promises.sizes.median_m, trial.noticed_m,
            "never" if trial.delay_frames is None else trial.delay_frames, trial.margin_px, trial.shift_m,
        )  # fmt: skip
        found = dict(zip(found, values, strict=True))
    return {**row, **found, "works": trial.works or f"NO: {trial.faults[0].text}"}


_OF_MOUNT = ("distance_m", "tilt_rad", "side_rad", "roll_rad", "focal_px")


def _to_copy(best: Trial) -> list[str]:
    turn = {key: ", ".join(f"{v:.6f}" for v in getattr(best.cam_T_grip, key)) for key in _TRANSFORM}
    return ["best as", "  reference:", "    cam_T_grip:", *(f"      {key}: [{text}]" for key, text in turn.items())]


_TRANSFORM = ("translation_m", "rotation_xyzw")
