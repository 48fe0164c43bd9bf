"""``gripmon calibrate verify``: are two calibrations the same, or does a calibration still hold?"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.verify import Calibrated, CameraDifference, HandEyeDifference, Verdict

DEFAULT_LEVEL = 0.01

_DESCRIPTION = """\
Compare two hand/eye calibrations (difference at the TCP, mm and degrees along the camera's axes), two
cameras (by what they do: the largest difference in the image), or a hand/eye calibration with fresh
images of the gripper: on the calibration plate (--target), or anywhere, measured as the monitor does;
then three or more before different backgrounds, since one that contradicts the others is left out.
Each may also be a configuration, a monitor's state file (its reference in force) or estimates.jsonl
(the last valid one).  How much of a difference is chance follows from both covariances; what they
share, such as the camera, makes differences look less significant than they are."""

_EXAMPLES = """\
  gripmon calibrate verify hand_eye.yaml new/hand_eye.yaml
  gripmon calibrate verify camera.yaml imported.yaml --tolerance-px 0.2
  gripmon calibrate verify hand_eye.yaml today/*.png --config mine/arm1.yaml
  gripmon calibrate verify hand_eye.yaml plate/*.png --config mine/arm1.yaml --target charuco:14x12:0.006:0.0044

exit codes: 0 the same; 2 wrong usage or files; 3 different, or the images can't be measured (then
nothing is printed but the reason)"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "verify", run, "are two calibrations the same, does one still hold", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("first", metavar="A", help="calibration")
    parser.add_argument("second", nargs="+", metavar="B", help="the other calibration, or images (files, folders)")
    parser.add_argument("--config", metavar="CONFIG", help="with images: the configuration with gripper and monitor")
    parser.add_argument("--target", metavar="TARGET", help="with images: the plate that the gripper stands on")
    parser.add_argument(
        "--jaw-opening",
        type=common.positive_number,
        metavar="M",
        help="in the images (m); default: the calibration's, else the configuration's",
    )
    parser.add_argument(
        "--level",
        type=_share,
        default=DEFAULT_LEVEL,
        metavar="P",
        help=f"say 'different' of equal ones so often (default: {DEFAULT_LEVEL:g})",
    )
    for unit, what in (("mm", "shift of the TCP"), ("deg", "turn"), ("px", "of two cameras anywhere in the image")):
        parser.add_argument(
            f"--tolerance-{unit}",
            type=common.positive_number,
            metavar=unit.upper(),
            help=f"{what} that doesn't matter, however significant"
            + ("; with --tolerance-mm" if unit == "deg" else ""),
        )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 0.5:
        raise argparse.ArgumentTypeError(f"'{text}' is no probability of a false alarm; between 0 and 0.5, e.g. 0.01")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate verify``."""
    from gripmon.calibrate.api import verify
    from gripmon.daemon.calibrations import measure_again, read_calibrated

    mm, deg = arguments.tolerance_mm, arguments.tolerance_deg
    if (mm is None) is not (deg is None):
        raise InputError("--tolerance-mm and --tolerance-deg: one without the other; both or none")
    first = read_calibrated(Path(arguments.first))
    doubts: tuple[str, ...] = ()
    if _are_images(arguments.second):
        target = None if arguments.target is None else files.target_of(arguments.target)
        with files.errors_of("verify"):
            second, doubts = measure_again(
                first, arguments.second, arguments.config, target, jaw_opening_m=arguments.jaw_opening
            )
    else:
        second = _other(arguments)
    found = verify(
        first,
        second,
        level=arguments.level,
        tolerance_m=None if mm is None else 1e-3 * mm,
        tolerance_rad=None if deg is None else math.radians(deg),
        tolerance_px=arguments.tolerance_px,
    )
    found = replace(found, warnings=(*doubts, *found.warnings))
    given = mm is not None or arguments.tolerance_px is not None
    if arguments.json:
        print(json.dumps(_values(found, given=given)))
    else:
        print("\n".join([*_lines(found), *(f"warning: {w}" for w in found.warnings), _verdict(found, given=given)]))
    return common.EXIT_DONE if found.same else common.EXIT_FAILED


def _are_images(names: list[str]) -> bool:
    from gripmon.model.images import IMAGE_SUFFIXES

    return any(Path(n).is_dir() or Path(n).suffix.lower() in IMAGE_SUFFIXES for n in names)


def _other(arguments: argparse.Namespace) -> Calibrated:
    from gripmon.daemon.calibrations import read_calibrated

    for option in ("config", "target", "jaw_opening"):
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option.replace('_', '-')}: has a meaning only with images; leave it out")
    if len(arguments.second) > 1:
        raise InputError(f"{arguments.second[1]}: a third calibration; two of them, or images")
    return read_calibrated(Path(arguments.second[0]))


def _values(found: Verdict, *, given: bool) -> dict[str, Any]:
    from gripmon.calibrate.verify import HandEyeDifference

    difference: Any = found.difference
    said = {
        "within_tolerance": found.within if given else None,
        "same": found.same,
        "level": found.level,
        "warnings": list(found.warnings),
    }
    if isinstance(difference, HandEyeDifference):
        return {
            "kind": "hand_eye",
            "position_m": difference.position_m.tolist(),
            "position_sigma_m": difference.position_sigma_m.tolist(),
            "rotation_rad": difference.rotation_rad.tolist(),
            "rotation_sigma_rad": difference.rotation_sigma_rad.tolist(),
            "chi2": difference.chi2,
            "degrees_of_freedom": 6,
            "p_value": difference.p_value,
            "position_p_value": difference.position_p,
            "rotation_p_value": difference.rotation_p,
            **said,
        }
    return {
        "kind": "camera",
        "largest_px": difference.largest_px,
        "largest_sigma_px": difference.largest_sigma_px if difference.p_value is not None else None,
        "at_px": difference.at_px.tolist(),
        "rms_px": difference.rms_px,
        "turn_rad": difference.turn_rad.tolist(),
        "largest_turned_px": difference.largest_turned_px,
        "p_value": difference.p_value,
        "compared": difference.compared,
        **said,
    }


def _lines(found: Verdict) -> list[str]:
    from gripmon.calibrate.verify import HandEyeDifference

    difference = found.difference
    return _hand_eye_lines(difference) if isinstance(difference, HandEyeDifference) else _camera_lines(difference)


def _verdict(found: Verdict, *, given: bool) -> str:
    if found.same and found.within:
        return "same: within the tolerance" if given else "same: the difference is negligible"
    if not found.same and found.difference.p_value is None:
        return "different: beyond the tolerance"
    return (
        f"same (not told apart at a level of {found.level:g})"
        if found.same
        else (f"different (at a level of {found.level:g})")
    )


def _hand_eye_lines(found: HandEyeDifference) -> list[str]:
    shift_mm = 1e3 * math.hypot(*found.position_m.tolist())
    turn_deg = math.degrees(math.hypot(*found.rotation_rad.tolist()))
    lines = ["second less first, camera axes    " + "".join(f"{axis:<19}" for axis in "xyz").rstrip()]
    rows = (
        ("TCP (mm)", 1e3 * found.position_m, 1e3 * found.position_sigma_m),
        ("rotation (deg)", found.rotation_rad * 180.0 / math.pi, found.rotation_sigma_rad * 180.0 / math.pi),
    )
    for name, values, sigmas in rows:
        cells = "".join(f"{v:+9.4f} ± {s:<7.4f}" for v, s in zip(values.tolist(), sigmas.tolist(), strict=True))
        lines.append(f"{name:<28}{cells}".rstrip())
    lines.append(
        f"together {shift_mm:.4f} mm at the TCP ({_chance(found.position_p)}), {turn_deg:.4f} degrees "
        f"({_chance(found.rotation_p)})"
    )
    lines.append(f"chi-square {found.chi2:.2f} of 6 degrees of freedom: {_chance(found.p_value)} by chance")
    return lines


def _chance(probability: float) -> str:
    return "probability below 1e-9" if probability < 1e-9 else f"probability {probability:.2g}"


def _camera_lines(found: CameraDifference) -> list[str]:
    u, v = found.at_px.tolist()
    sigma = "" if found.p_value is None else f" ± {found.largest_sigma_px:.3f}"
    degrees = ", ".join(f"{math.degrees(turn):+.4f}" for turn in found.turn_rad.tolist())
    lines = [
        f"largest difference {found.largest_px:.3f}{sigma} px, at ({u:.0f}, {v:.0f}); rms {found.rms_px:.3f} px",
        f"a hand/eye calibration absorbs a turn by ({degrees}) degrees: {found.largest_turned_px:.3f} px are left",
    ]
    if found.p_value is not None:
        lines.append(f"{_chance(found.p_value)} by chance")
    if found.compared < 1.0:
        lines.append(f"compared where both lenses map the image: {100.0 * found.compared:.0f} %")
    return lines
