"""``gripmon calibrate plane``: hand/eye calibration from images of the gripper standing on a calibration plate."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.cli.plane_inputs import Inputs, Rough
    from gripmon.model.records import Image
    from gripmon.teach.onboarding import KnownGripper, Look, UnknownGripper

_DESCRIPTION = """\
Where the gripper is in the camera's frame, from one image of it standing on a calibration plate (the
Plane Coincidence Constraint of the self-viewing method): the contact plane of its fingertips is the
plate.  The fingers may hide part of the pattern.  Several images, the gripper put down anew for each,
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

    from gripmon.calibrate.plane_average import average
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.cli import plane_inputs, plane_outputs

    plane_inputs.check_options(arguments)
    cv2.setNumThreads(1)
    inputs = plane_inputs.read(arguments)
    looks, shown = _looks(inputs)
    try:
        result = average([look.coincidence for look in looks], inputs.inferred)
        model = plane_outputs.inferred_gripper(inputs, looks, result, arguments)
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate plane: {error}") from None
    plane_outputs.write(inputs, result, model, arguments)
    plane_outputs.report(inputs, looks, result, arguments)
    if arguments.picture is not None:
        from gripmon.teach.onboarding.picture import draw

        picture = draw(shown, inputs.camera.lens, looks[0].coincidence)
        files.write_picture(picture, Path(arguments.picture))
    return common.EXIT_DONE


def _looks(inputs: Inputs) -> tuple[list[Look], Image]:
    """What each image gives, and the first one that gives something; images that give nothing are said."""
    import sys

    from gripmon.calibrate.sighting import CalibrationError

    looks: list[Look] = []
    shown: Image | None = None
    reasons = []
    with common.progress_bar(len(inputs.paths), "image") as step:
        for path, image, rough in zip(inputs.paths, inputs.images, inputs.rough, strict=True):
            try:
                looks.append(_look(inputs.method, inputs.target, path, image, rough))
                shown = image if shown is None else shown
            except CalibrationError as error:
                reasons.append(f"{path}: {error}")
            step()
    if shown is None:
        more = f" (and {len(reasons) - 1} more images)" if len(reasons) > 1 else ""
        raise common.CommandFailedError(f"calibrate plane: {reasons[0]}{more}")
    for reason in reasons:
        print(f"not used: {reason}", file=sys.stderr)
    return looks, shown


def _look(method: KnownGripper | UnknownGripper, target: Any, path: Path, image: Image, rough: Rough | None) -> Look:
    from gripmon.calibrate.detection import detect
    from gripmon.calibrate.sighting import CalibrationError, NotFound
    from gripmon.teach.onboarding import KnownGripper

    try:
        sight = detect(image, target, str(path))
    except ValueError as error:
        raise common.CommandFailedError(f"--target: {error}", common.EXIT_USAGE) from None
    if isinstance(sight, NotFound):
        if sight.larger:
            raise common.CommandFailedError(f"--target: {path}: {sight.reason}; its full size", common.EXIT_USAGE)
        raise CalibrationError(sight.reason)
    if isinstance(method, KnownGripper):
        return method.look(image, sight, rough)
    assert rough is not None, "an inferred gripper has rough corners"
    return method.look(image, sight, rough)


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
