"""``gripmon calibrate plane``: hand/eye calibration from images of the gripper standing on a calibration plate."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.bundle import GivenCamera
    from gripmon.calibrate.plane import Coincidence
    from gripmon.calibrate.plane_average import PlaneCalibration
    from gripmon.daemon.config import Config
    from gripmon.model.gripper import Gripper
    from gripmon.model.provenance import Provenance
    from gripmon.teach.hand_eye import HandEyeOnPlate
    from gripmon.teach.onboarding import Look

_DESCRIPTION = """\
Where the gripper is in the camera's frame, from one image of it standing on a calibration plate (the
Plane Coincidence Constraint of the self-viewing method): the contact plane of its fingertips is the
plate.  The fingers may hide part of the pattern.  Several images, the gripper put down again for each,
are averaged.

The gripper is known (--gripper), or it is inferred from the same images (--infer): the four innermost
corners of two parallel fingertips form a rectangle about the TCP.

--corners names a file with rough positions, several pixels off is fine:
  corners:
    L_in_near: [241, 240]      # name: [u, v] in px
Names are those of the gripper file (two at least; those that are given are used), or with --infer
  left_inner_near, left_inner_far, right_inner_near, right_inner_far
where near is the upper one in an image that shows the left finger on the left, and, on the next edge of
each, one or two of
  left_outer_near   the contact face's outer corner
  left_end_near     any point on an edge in the contact plane, whose end is out of view
  left_rise_near    any point on an edge that rises from the contact plane
With --config, the configuration's calibration tells where the corners are expected, good to some pixels."""

_EXAMPLES = """\
  gripmon calibrate plane on_plate.png --camera camera.yaml --target circles:8x8:0.008:0.004 \\
      --gripper gripper.yaml --jaw-opening 0.034 --corners rough.yaml --out hand_eye.yaml
  gripmon calibrate plane plate/ --camera camera.yaml --target chequerboard:14x12:0.006 --infer \\
      --corners rough.yaml --jaw-range 0:0.06 --gripper-out gripper.yaml --out hand_eye.yaml
  gripmon calibrate plane plate/*.png --config arm1.yaml --target charuco:14x12:0.006:0.0044 \\
      --out hand_eye.yaml --picture hand_eye.png

exit codes: 0 written; 2 wrong usage or files; 3 the images can't be calibrated from, and why:
nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "plane", run, "camera to gripper, from images of it on a plate", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="image file, or folder with images")
    parser.add_argument("--target", required=True, metavar="TARGET", help="the plate; see gripmon calibrate intrinsics")
    parser.add_argument("--camera", metavar="FILE.yaml", help="file of gripmon calibrate intrinsics")
    parser.add_argument(
        "--config", metavar="CONFIG", help="configuration (YAML) whose camera, gripper, and rough calibration are used"
    )
    gripper = parser.add_mutually_exclusive_group()
    gripper.add_argument("--gripper", metavar="FILE.yaml", help="gripper file")
    gripper.add_argument("--infer", action="store_true", help="the gripper isn't known: infer it, see --gripper-out")
    parser.add_argument(
        "--corners",
        action="append",
        metavar="FILE.yaml",
        help="rough corners: one file for all images, or one for each, in their order",
    )
    parser.add_argument(
        "--jaw-opening", type=_opening, metavar="M", help="jaw opening in the images, as the robot reports it (m)"
    )
    parser.add_argument("--gripper-out", metavar="FILE.yaml", help="with --infer: gripper file to write")
    parser.add_argument(
        "--jaw-range", type=_range, metavar="MIN:MAX", help="with --infer: the jaws move in this range (m)"
    )
    parser.add_argument("--name", default="gripper", help="with --infer: the gripper's name (default: gripper)")
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument("--picture", metavar="FILE.png", help="also draw the first image with residuals, enlarged")
    parser.add_argument("--force", action="store_true", help="replace files that are there")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text; m, rad, px")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate plane``."""
    import cv2

    from gripmon.daemon.calibrations import read_rough_corners
    from gripmon.model.images import image_paths
    from gripmon.teach.hand_eye import calibrate_plane, gripper_values

    _check_options(arguments)
    cv2.setNumThreads(1)
    config = None if arguments.config is None else common.load(arguments.config, check_source=False, with_taught=False)
    target = files.target_of(arguments.target)
    camera, inputs = _camera(arguments, config)
    gripper = None if arguments.infer else _gripper(arguments, config)
    paths = image_paths(arguments.images)
    rough = [read_rough_corners(Path(name), gripper) for name in arguments.corners or []]
    if len(rough) not in (0, 1, len(paths)):
        _refuse(f"--corners: {len(rough)} files for {len(paths)} images; one for all, or one for each")
    opening_m, notes = _jaw_opening(arguments, gripper, config)
    with files.errors_of("plane"):
        found = calibrate_plane(
            paths, camera, gripper, target, corners=rough or None, jaw_opening_m=opening_m,
            cam_T_grip=None if config is None or arguments.infer else config.cam_T_grip, progress=common.progress_bar,
        )  # fmt: skip
        for reason in found.not_used:
            print(f"not used: {reason}", file=sys.stderr)
        provenance = _provenance(arguments, [*paths, *inputs], target)
        made = found.gripper(arguments.name, arguments.jaw_range, arguments.jaw_opening, provenance)
    if arguments.infer:
        files.write_document(gripper_values(made.model), Path(arguments.gripper_out), "--gripper-out")
    files.write_document(found.document(made, provenance), Path(arguments.out))
    _report(found, [*notes, *found.notes], arguments)
    if arguments.picture is not None:
        files.write_picture(found.picture(), Path(arguments.picture))
    return common.EXIT_DONE


def _check_options(arguments: argparse.Namespace) -> None:
    """Refuse, before any work, options that don't go together and files that can't be written."""
    outputs = {"--out": arguments.out, "--gripper-out": arguments.gripper_out, "--picture": arguments.picture}
    if arguments.infer and arguments.gripper_out is None:
        _refuse("--infer: where to write the gripper isn't said; --gripper-out FILE.yaml")
    if arguments.infer and not arguments.corners:
        _refuse("--infer: needs rough corners; --corners FILE.yaml")
    for option, value in (("--gripper-out", arguments.gripper_out), ("--jaw-range", arguments.jaw_range)):
        if value is not None and not arguments.infer:
            _refuse(f"{option}: has no effect with a gripper that is known; --infer, or leave it out")
    if not arguments.infer and arguments.gripper is None and arguments.config is None:
        _refuse("the gripper isn't said; --gripper FILE.yaml, --config CONFIG, or --infer")
    if arguments.camera is None and arguments.config is None:
        _refuse("the camera isn't said; --camera FILE.yaml (of gripmon calibrate intrinsics), or --config CONFIG")
    if not arguments.corners and arguments.config is None:
        _refuse("nothing says where the gripper is in the image; --corners FILE.yaml, or --config CONFIG")
    given = {option: Path(value) for option, value in outputs.items() if value is not None}
    if len({path.resolve() for path in given.values()}) < len(given):
        _refuse(f"{', '.join(given)}: name the same file twice; different files")
    for option, path in given.items():
        check = files.check_picture if option == "--picture" else files.check_output
        check(path, force=arguments.force, option=option)


def _camera(arguments: argparse.Namespace, config: Config | None) -> tuple[GivenCamera, list[Path]]:
    """The camera, and all files beside the images that the provenance names."""
    from gripmon.calibrate.bundle import GivenCamera
    from gripmon.daemon.calibrations import read_given_camera

    named = [arguments.camera, arguments.config, arguments.gripper, *(arguments.corners or [])]
    inputs = [Path(name) for name in named if name is not None]
    path = None if arguments.camera is None else Path(arguments.camera)
    if config is not None:
        inputs += [config.gripper_path, *config.calibrated.paths.values()]
        path = path or config.calibrated.paths.get("camera")
        if path is None:
            return GivenCamera(config.settings.camera), inputs
    assert path is not None, "_check_options asks for a camera"
    return read_given_camera(path), inputs


def _gripper(arguments: argparse.Namespace, config: Config | None) -> Gripper:
    from gripmon.daemon.config import read_gripper

    if arguments.gripper is not None:
        return read_gripper(Path(arguments.gripper))
    assert config is not None, "_check_options asks for a gripper"
    return config.gripper


def _jaw_opening(
    arguments: argparse.Namespace, gripper: Gripper | None, config: Config | None
) -> tuple[float | None, list[str]]:
    """The configuration's where none is given, and what is to be said of that."""
    opening_m = arguments.jaw_opening
    if opening_m is not None or gripper is None or config is None or not gripper.has_jaw:
        return opening_m if gripper is not None else None, []
    opening_m = config.jaw_opening_m
    return opening_m, [f"jaw opening taken as {opening_m:g} m; --jaw-opening M if it was another"]


def _provenance(arguments: argparse.Namespace, inputs: list[Path], target: Any) -> Provenance:
    from gripmon.daemon.calibrations import is_target_file
    from gripmon.model.provenance import provenance_of
    from gripmon.model.targets import name_of

    # As itself where a file named it: the hand/eye calibration holds its target nowhere else.
    options: dict[str, Any] = {"--target": name_of(target) if is_target_file(arguments.target) else arguments.target}
    options |= files.options_of(arguments, "camera", "config", "gripper", "infer", "jaw-opening")
    if arguments.jaw_range is not None:
        options["--jaw-range"] = ":".join(f"{end:g}" for end in arguments.jaw_range)
    if arguments.infer:
        options |= files.options_of(arguments, "name", "gripper-out")
    options["--out"] = arguments.out
    words = [*arguments.images, *(word for name in arguments.corners or [] for word in ("--corners", name))]
    return provenance_of(files.command_line("plane", words, options), list(dict.fromkeys(inputs)))


def _report(found: HandEyeOnPlate, notes: list[str], arguments: argparse.Namespace) -> None:
    """What a person should know; warnings go to stderr."""
    fit = found.fit
    for warning in fit.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(_values(found, notes, arguments), indent=2))
        return
    width = max(len(image.sighting.name) for image in fit.images)
    compared = any(image.tilt_rad is not None for image in fit.images)
    apart = "  tilt about x, y          gap" if compared else ""
    print(f"{'image':<{width}}  plate points     rms  corners  residual{apart}")
    for image in fit.images:
        print(_image_line(image, width))
    for note in notes:
        print(f"note: {note}")
    for look in found.looks:
        for name, reason in look.missing.items():
            print(f"note: {look.coincidence.sighting.name}: {name} not measured: {reason}")
    if fit.consistency_p is not None:
        print(f"the images agree with each other: probability {fit.consistency_p:.2g} of differing as much")
    sigma = (fit.covariance.diagonal() ** 0.5).tolist()
    x, y, z = (1e3 * fit.cam_T_grip[:3, 3]).tolist()
    sx, sy, sz = (1e3 * value for value in sigma[:3])
    print(f"TCP in the camera frame  {x:.3f} {y:.3f} {z:.3f} mm  +- {sx:.4f} {sy:.4f} {sz:.4f} mm")
    rx, ry, rz = (math.degrees(value) for value in sigma[3:])
    print(f"rotation about x, y, z   +- {rx:.4f} {ry:.4f} {rz:.4f} degrees")
    if found.inferred:
        print(_lengths_line(fit))
        print(f"written: {arguments.gripper_out}")
    print(f"written: {arguments.out}")


def _values(found: HandEyeOnPlate, notes: list[str], arguments: argparse.Namespace) -> dict[str, Any]:
    from gripmon.model.geometry import to_record

    fit, transform = found.fit, to_record(found.cam_T_grip)
    out: dict[str, Any] = {
        "cam_T_grip": {"translation_m": transform.translation_m, "rotation_xyzw": transform.rotation_xyzw},
        "covariance": fit.covariance.ravel().tolist(),
        "rms_m": fit.rms_m,
        "rms_px": fit.rms_px,
        "consistency_p": fit.consistency_p,
        "warnings": fit.warnings,
        "notes": notes,
        "images": [_image_values(look) for look in found.looks],
        "written": [arguments.gripper_out, arguments.out] if found.inferred else [arguments.out],
    }
    if found.inferred:
        out["sides_m"] = (2.0 * fit.corners_m[3, :2]).tolist()
        out["sides_sigma_m"] = (fit.lengths_covariance.diagonal()[:2] ** 0.5).tolist()
    return out


def _image_values(look: Look) -> dict[str, Any]:
    image = look.coincidence
    sigma_px = (image.corners.covariance_px.diagonal() ** 0.5).reshape(-1, 2)
    rows = zip(image.corners.names, image.corners.uv_px, sigma_px, image.residuals_m, strict=True)
    return {
        "image": image.sighting.name,
        "plate_points": int(image.plate.used[0].sum()),
        "plate_points_left_out": int((~image.plate.used[0]).sum()),
        "plate_rms_px": image.plate.rms_px,
        "corners": {
            name: {"uv_px": uv.tolist(), "sigma_px": sigma.tolist(), "residual_m": residual.tolist()}
            for name, uv, sigma, residual in rows
        },
        "missing": look.missing,
        "residuals_p": image.p_value,
        "tilt_rad": None if image.tilt_rad is None else image.tilt_rad.tolist(),
        "gap_m": image.gap_m,
        "tilt_gap_sigma": None if image.apart_sigma is None else image.apart_sigma.tolist(),
        "tilt_gap_p": image.apart_p,
    }


def _image_line(image: Coincidence, width: int) -> str:
    used, left_out = int(image.plate.used[0].sum()), int((~image.plate.used[0]).sum())
    points = f"{used}" + (f" (-{left_out})" if left_out else "")
    residual_mm = 1e3 * float((image.residuals_m**2).mean() ** 0.5)
    apart = ""
    if image.tilt_rad is not None and image.gap_m is not None:
        tilt = [math.degrees(angle) for angle in image.tilt_rad.tolist()]
        apart = f"  {tilt[0]:+.3f} {tilt[1]:+.3f} degrees   {1e3 * image.gap_m:+.4f} mm"
    rms_px, corners = image.plate.rms_px, len(image.corners.names)
    return f"{image.sighting.name:<{width}}  {points:>12} {rms_px:4.2f} px  {corners:7d} {residual_mm:6.4f} mm{apart}"


def _lengths_line(result: PlaneCalibration) -> str:
    sides = 2e3 * result.corners_m[3, :2]
    sigma = 1e3 * result.lengths_covariance.diagonal()[:2] ** 0.5
    apart, along = (f"{side:.3f} +- {error:.4f} mm" for side, error in zip(sides, sigma, strict=True))
    return f"fingertips {apart} apart, innermost edges {along} long"


def _refuse(text: str) -> NoReturn:
    raise InputError(f"calibrate plane: {text}")


def _opening(text: str) -> float:
    value = 0.0 if text.strip() in ("0", "0.0") else common.positive_number(text)
    if value > 0.5:
        raise argparse.ArgumentTypeError(f"{text} m is no jaw opening (millimetres?); metres, 0 to 0.5")
    return value


def _range(text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"'{text}' is no range; MIN:MAX in metres, e.g. 0:0.06")
    ends = _opening(low), _opening(high)
    if not ends[0] < ends[1]:
        raise argparse.ArgumentTypeError(f"'{text}' doesn't ascend; MIN:MAX in metres, e.g. 0:0.06")
    return ends
