"""``gripmon calibrate verify``: are two calibrations the same, or does a calibration still hold?"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.verify import CameraDifference, HandEyeDifference
    from gripmon.cli.calibration_sources import Calibrated

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
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.cli.calibration_sources import read_calibrated

    if (arguments.tolerance_mm is None) is not (arguments.tolerance_deg is None):
        raise common.CommandFailedError(
            "--tolerance-mm and --tolerance-deg: one without the other; both or none", common.EXIT_USAGE
        )
    first = read_calibrated(Path(arguments.first))
    warnings: list[str] = []
    if _are_images(arguments.second):
        from gripmon.cli.verifying import measured

        second = measured(first, arguments, warnings)
    else:
        _check_no_image_options(arguments)
        if len(arguments.second) > 1:
            raise common.CommandFailedError(
                f"{arguments.second[1]}: a third calibration; two of them, or images", common.EXIT_USAGE
            )
        second = read_calibrated(Path(arguments.second[0]))
    try:
        result = _compared(first, second, arguments, warnings)
    except CalibrationError as error:
        raise common.CommandFailedError(
            f"calibrate verify: {first.path} and {second.path}: {error}", common.EXIT_USAGE
        ) from None
    if arguments.json:
        print(json.dumps({**result["values"], "same": result["same"], "level": arguments.level, "warnings": warnings}))
    else:
        print("\n".join([*result["lines"], *(f"warning: {w}" for w in warnings), result["verdict"]]))
    return common.EXIT_DONE if result["same"] else common.EXIT_FAILED


def _are_images(names: list[str]) -> bool:
    from gripmon.io.sources.folder import IMAGE_SUFFIXES

    return any(Path(n).is_dir() or Path(n).suffix.lower() in IMAGE_SUFFIXES for n in names)


def _check_no_image_options(arguments: argparse.Namespace) -> None:
    for option in ("config", "target", "jaw_opening"):
        if getattr(arguments, option) is not None:
            raise common.CommandFailedError(
                f"--{option.replace('_', '-')}: has a meaning only with images; leave it out", common.EXIT_USAGE
            )


def _compared(
    first: Calibrated, second: Calibrated, arguments: argparse.Namespace, warnings: list[str]
) -> dict[str, Any]:
    if first.cam_T_grip is not None and second.cam_T_grip is not None:
        return _hand_eyes(first, second, arguments, warnings)
    if first.lens is not None and second.lens is not None:
        return _cameras(first, second, arguments)
    raise common.CommandFailedError(
        f"{first.path} is {first.kind}, {second.path} is {second.kind}; two of one kind", common.EXIT_USAGE
    )


def _hand_eyes(
    first: Calibrated, second: Calibrated, arguments: argparse.Namespace, warnings: list[str]
) -> dict[str, Any]:
    import numpy as np

    from gripmon.calibrate.verify import compare_hand_eye
    from gripmon.model.geometry import from_record

    if arguments.tolerance_px is not None:
        raise common.CommandFailedError("--tolerance-px: is for two cameras; leave it out", common.EXIT_USAGE)
    if first.lens is not None and second.lens is not None and first.lens != second.lens:
        warnings.append("made with different camera calibrations, which may explain a difference")
    if first.gripper is not None and second.gripper is not None and first.gripper != second.gripper:
        warnings.append(f"made with different gripper files ({first.gripper.name}, {second.gripper.name})")
    assert first.cam_T_grip is not None and second.cam_T_grip is not None
    found = compare_hand_eye(
        from_record(first.cam_T_grip),
        np.reshape(first.covariance, (6, 6)),
        from_record(second.cam_T_grip),
        np.reshape(second.covariance, (6, 6)),
    )
    shift_mm = 1e3 * float(np.linalg.norm(found.position_m))
    turn_deg = math.degrees(float(np.linalg.norm(found.rotation_rad)))
    within = (
        arguments.tolerance_mm is not None
        and shift_mm <= arguments.tolerance_mm
        and turn_deg <= arguments.tolerance_deg
    )
    same = found.p_value >= arguments.level or within
    values = {
        "kind": "hand_eye",
        "position_m": found.position_m.tolist(),
        "position_sigma_m": found.position_sigma_m.tolist(),
        "rotation_rad": found.rotation_rad.tolist(),
        "rotation_sigma_rad": found.rotation_sigma_rad.tolist(),
        "chi2": found.chi2,
        "degrees_of_freedom": 6,
        "p_value": found.p_value,
        "position_p_value": found.position_p,
        "rotation_p_value": found.rotation_p,
        "within_tolerance": within if arguments.tolerance_mm is not None else None,
    }
    lines = _hand_eye_lines(found, shift_mm, turn_deg)
    return {"values": values, "lines": lines, "same": same, "verdict": _verdict(same, within, arguments.level)}


def _hand_eye_lines(found: HandEyeDifference, shift_mm: float, turn_deg: float) -> list[str]:
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


def _verdict(same: bool, within: bool, level: float, *, given: bool = True) -> str:
    if same and within:
        return "same: within the tolerance" if given else "same: the difference is negligible"
    return f"same (not told apart at a level of {level:g})" if same else f"different (at a level of {level:g})"


def _cameras(first: Calibrated, second: Calibrated, arguments: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from gripmon.calibrate.verify import NEGLIGIBLE_PX, CalibratedCamera, compare_cameras

    if arguments.tolerance_mm is not None:
        raise common.CommandFailedError("--tolerance-mm: is for hand/eye calibrations; leave it out", common.EXIT_USAGE)
    calibrated = []
    for one in (first, second):
        assert one.lens is not None
        count = len(one.parameters)
        calibrated.append(CalibratedCamera(one.lens, one.parameters, np.reshape(one.lens_covariance, (count, count))))
    found = compare_cameras(*calibrated)
    within = arguments.tolerance_px is not None and found.largest_px <= arguments.tolerance_px
    within = within or found.largest_px <= NEGLIGIBLE_PX
    if found.p_value is None and arguments.tolerance_px is None and not within:
        raise common.CommandFailedError(
            f"{first.path} and {second.path}: up to {found.largest_px:.3g} px apart, and neither says how certain it "
            "is; --tolerance-px PX for a difference that doesn't matter",
            common.EXIT_USAGE,
        )
    same = within or (found.p_value is not None and found.p_value >= arguments.level)
    values = {
        "kind": "camera",
        "largest_px": found.largest_px,
        "largest_sigma_px": found.largest_sigma_px if found.p_value is not None else None,
        "at_px": found.at_px.tolist(),
        "rms_px": found.rms_px,
        "turn_rad": found.turn_rad.tolist(),
        "largest_turned_px": found.largest_turned_px,
        "p_value": found.p_value,
        "compared": found.compared,
        "within_tolerance": within if arguments.tolerance_px is not None else None,
    }
    lines = _camera_lines(found)
    verdict = _verdict(same, within, arguments.level, given=arguments.tolerance_px is not None)
    if not same and found.p_value is None:
        verdict = "different: beyond the tolerance"
    return {"values": values, "lines": lines, "same": same, "verdict": verdict}


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
