"""``gripmon calibrate intrinsics`` and ``plane``: from images of a flat target, and of a gripper that stands on it."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    REQUIRED,
    RESPONSE,
    RESPONSE_OPTION,
    Arguments,
    Command,
    jaw_opening,
    jaw_range,
    note,
    progress_bar,
)
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.api import CameraFromViews
    from gripmon.teach.hand_eye import HandEyeOnPlate

MODELS = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")

_INTRINSICS_OPTIONS = """
IMAGE...               image file, or folder with images
--target TARGET        chequerboard:COLUMNSxROWS:SQUARE (inner corners, m),
                       charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] (squares, m),
                       circles:COLUMNSxROWS:SPACING:DIAMETER (discs, m), acircles:… (staggered; SPACING in a row),
                       or FILE.yaml of a calibration with it
--model                lens model; auto: the one with the smallest information criterion
                       (default: brown_conrady; for a single image paper)
--fix NAME[=VALUE]...  hold a parameter, e.g. cx_px (at the image's centre), coefficients.2 (at 0), aspect (square
                       pixels) or fx_px=870.5 (at this value); may be repeated
--out FILE.yaml        file to write
--report FILE.html     also write a page: the residuals over the image, how each image fits, the parameters
--force                replace existing files
--json                 one JSON object instead of text; px, the lens's own units
"""

_INTRINSICS_EXAMPLES = """\
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate intrinsics plate/ --target charuco:8x6:0.03:0.022:DICT_4X4_250 --model auto \\
      --out camera.yaml --report camera.html
  gripmon calibrate intrinsics one.png --target circles:8x8:0.008:0.004 --out camera.yaml

exit codes: 0 written; 2 wrong usage or files; 3 no calibration from these images, with the reason:
nothing is written then"""


@Command(
    _INTRINSICS_OPTIONS, _INTRINSICS_EXAMPLES, target=REQUIRED,
    model={"choices": (*MODELS, "auto")}, fix={"default": []}, out=REQUIRED,
)  # fmt: skip
def intrinsics(arguments: Arguments) -> None:
    """Calibrate a camera from images of a flat target, each of which may show a part of it: focal lengths,
    principal point and lens with their standard deviations.  Best are ten to thirty images that fill the
    view, corners included, the target tilted by 20 to 45 degrees to different sides.  A single image
    gives a calibration with the principal point at the image's centre and square pixels, as in the
    self-viewing method.
    """
    import cv2

    from gripmon.calibrate.api import calibrate_intrinsics
    from gripmon.daemon.targets import target_of
    from gripmon.model.images import image_paths
    from gripmon.model.provenance import provenance_of

    cv2.setNumThreads(1)
    arguments.check_outputs("out", "report")
    target, fixed, paths = target_of(arguments.target), _fixed(arguments), image_paths(arguments.image)
    found = calibrate_intrinsics(paths, target, model=arguments.model, fixed=fixed, progress=progress_bar)
    note(f"{name}: {reason}" for name, reason in found.not_found.items())
    document = found.document(provenance_of(arguments.command_line(), paths))
    arguments.save("report", lambda: _page(found, arguments.out.name))
    arguments.save("out", document)
    if arguments.json:
        print(json.dumps({"out": str(arguments.out), **found.values()}, indent=2))
    else:
        print("\n".join([*_summary(found, fixed), f"written: {arguments.out}"]))


def _page(found: CameraFromViews, title: str) -> bytes:
    from gripmon.analyse.lens_page import lens_page  # which takes long to import

    return lens_page(found, title)


def _fixed(arguments: Arguments) -> dict[str, float | None]:
    """The held parameters and their values."""
    from gripmon.calibrate.api import check_fixed

    fixed: dict[str, float | None] = {}
    for text in arguments.fix:
        name, equals, number = text.partition("=")
        if name in fixed:
            raise InputError(f"--fix {text}: is held already; each parameter once")
        try:
            fixed[name] = float(number) if equals else None
        except ValueError:
            fixed[name] = math.nan
        try:
            check_fixed({name: fixed[name]}, arguments.model)
            check_fixed(fixed, arguments.model)
        except InputError as error:
            raise InputError(f"--fix {text}:{str(error).partition(':')[2]}") from None
    return fixed


def _summary(found: CameraFromViews, fixed: dict[str, float | None]) -> list[str]:
    fit, views = found.fit, len(found.sightings)
    lines = [f"{'parameter':<15} {'value':>14} {'±':>11}"]
    for name, value in fit.values.items():
        sigma = found.sigmas[name]
        # A tied parameter has no deviation of its own: fy_px is fx_px with square pixels.
        lines.append(f"{name:<15} {value:>14.6g} {'held' if sigma is None else f'{sigma:.2g}':>11}")
    images = f"{views} of {views + len(found.not_found)} images"
    line = f"{images}, {found.points} points, {found.outliers} left out; rms {fit.rms_px:.3f} px"
    if fit.cross_validated_rms_px is not None:
        line += f", {fit.cross_validated_rms_px:.3f} px in images that had no part in the fit"
    lines.append(line)
    if views == 1:
        given = any(fixed.get(name) is not None for name in ("cx_px", "cy_px"))
        centre = "as held" if given else "at the image's centre"
        lines.append(f"from a single image: principal point {centre}, square pixels, one lens coefficient")
    if fit.criterion is not None and len(fit.criterion) > 1:
        least = min(fit.criterion.values())
        lines.append("model            information criterion above the best")
        ranked = sorted(fit.criterion.items(), key=lambda item: item[1])
        lines += [f"{name:<16} {value - least:>8.1f}" for name, value in ranked]
    return [*lines, *(f"warning: {warning}" for warning in fit.warnings)]


_PLANE_OPTIONS = f"""
IMAGE...                image file, or folder with images
--target TARGET         the plate; see gripmon calibrate intrinsics
--other-target          the plate is another one than the camera's, of the same pattern in another size
--camera FILE.yaml      file of gripmon calibrate intrinsics
--config CONFIG         configuration (YAML) whose camera, gripper, and rough calibration are used
--gripper FILE.yaml     gripper file
| --infer               infer the gripper from the images, see --gripper-out
--corners FILE.yaml...  rough corners: one file for all images, or one per image, in their order
--jaw-opening M         jaw opening in the images, as the robot reports it (m)
--gripper-out FILE.yaml
                        with --infer: gripper file to write
--jaw-range MIN:MAX     with --infer: range of the jaw opening (m)
{RESPONSE_OPTION.strip()}
--name NAME             with --infer: the gripper's name (default: gripper)
--out FILE.yaml         file to write
--picture FILE.png      also draw the first image with residuals, enlarged
--force                 replace existing files
--json                  one JSON object instead of text; m, rad, px
"""

_PLANE_EXAMPLES = """\
  gripmon calibrate plane on_plate.png --camera camera.yaml --target circles:8x8:0.008:0.004 \\
      --gripper gripper.yaml --jaw-opening 0.034 --corners rough.yaml --out hand_eye.yaml
  gripmon calibrate plane plate/ --camera camera.yaml --target circles:12x10:0.008:0.004 --infer \\
      --corners rough.yaml --jaw-range 0:0.06 --gripper-out gripper.yaml --out hand_eye.yaml
  gripmon calibrate plane plate/*.png --config arm1.yaml --target charuco:14x12:0.006:0.0044 \\
      --out hand_eye.yaml --picture hand_eye.png

exit codes: 0 written; 2 wrong usage or files; 3 no calibration from these images, with the reason:
nothing is written then"""


@Command(
    _PLANE_OPTIONS, _PLANE_EXAMPLES, target=REQUIRED,
    jaw_opening=jaw_opening, jaw_range=jaw_range, name={"default": "gripper"}, out=REQUIRED, response=RESPONSE,
)  # fmt: skip
def plane(arguments: Arguments) -> None:
    """Measure the gripper's pose in the camera frame from an image of it standing on a calibration plate (the
    Plane Coincidence Constraint of the self-viewing method): the contact plane of its fingertips is the
    plate.  The fingers may hide part of the pattern.  Several images, with the gripper put down again for
    each, are averaged.

    The gripper is given (--gripper), or inferred from the same images (--infer): the four innermost
    corners of two parallel fingertips form a rectangle about the TCP.  This needs a plate of discs.

    --corners names a file with rough positions, several pixels off is fine:
      corners:
        L_in_near: [241, 240]      # name: [u, v] in px
    Names are those of the gripper file (at least two; all that are given are used), or with --infer
      left_inner_near, left_inner_far, right_inner_near, right_inner_far
    where near is the upper one in an image that shows the left finger on the left, and, on the next edge of
    each, one or two of
      left_outer_near   the contact face's outer corner
      left_end_near     any point on an edge in the contact plane, whose end is out of view
      left_rise_near    any point on an edge that rises from the contact plane
    With --config, the corners are predicted from the configuration's calibration, to some pixels.
    """
    import cv2

    from gripmon.daemon.calibrations import plane_inputs
    from gripmon.daemon.targets import is_target_file, target_of
    from gripmon.model.images import image_paths
    from gripmon.model.provenance import provenance_of
    from gripmon.model.targets import name_of
    from gripmon.teach.hand_eye import calibrate_plane

    _check_options(arguments)
    cv2.setNumThreads(1)
    target, paths = target_of(arguments.target), image_paths(arguments.image)
    given = plane_inputs(
        arguments.camera, arguments.gripper, arguments.config, arguments.corners or (), arguments.jaw_opening,
        infer=arguments.infer,
    )  # fmt: skip
    response = given.response if arguments.response == "auto" else arguments.response
    found = calibrate_plane(
        paths, given.camera, given.gripper, target, corners=given.corners or None, jaw_opening_m=given.jaw_opening_m,
        cam_T_grip=given.cam_T_grip, other_target=arguments.other_target, response=response, progress=progress_bar,
    )  # fmt: skip
    note(f"not used: {reason}" for reason in found.not_used)
    # In full even if a file named it: the hand/eye calibration records its target nowhere else.
    described = name_of(target) if is_target_file(arguments.target) else arguments.target
    provenance = provenance_of(arguments.command_line(target=described), list(dict.fromkeys([*paths, *given.files])))
    made = found.result(arguments.name, arguments.jaw_range, arguments.jaw_opening, provenance)
    written = [path for path in (arguments.gripper_out, arguments.out) if path is not None]
    arguments.save("gripper_out", made.text().encode())
    arguments.save("out", made.reference(provenance))
    note(f"warning: {warning}" for warning in found.fit.warnings)
    notes = [*given.notes, *found.notes]
    values = {**found.values(), "notes": notes, "written": [str(path) for path in written]}
    arguments.answer(values, [*_lines(found, notes), *(f"written: {path}" for path in written)])
    arguments.save("picture", found.picture)


def _check_options(arguments: Arguments) -> None:
    """Refuse, before any work, options that don't go together and files that can't be written."""
    infer, config, corners = arguments.infer, arguments.config, arguments.corners
    known = "has no effect with a gripper that is known; --infer, or leave it out"
    wrong = ""
    if infer and arguments.gripper_out is None:
        wrong = "--infer: where to write the gripper isn't given; --gripper-out FILE.yaml"
    elif infer and not corners:
        wrong = "--infer: needs rough corners; --corners FILE.yaml"
    elif not infer and (arguments.gripper_out or arguments.jaw_range):
        wrong = f"{'--gripper-out' if arguments.gripper_out else '--jaw-range'}: {known}"
    elif not infer and arguments.gripper is None and config is None:
        wrong = "the gripper isn't given; --gripper FILE.yaml, --config CONFIG, or --infer"
    elif arguments.camera is None and config is None:
        wrong = "the camera isn't given; --camera FILE.yaml (of gripmon calibrate intrinsics), or --config CONFIG"
    elif not corners and config is None:
        wrong = "the gripper's place in the image is unknown; --corners FILE.yaml, or --config CONFIG"
    if wrong:
        raise InputError(f"calibrate plane: {wrong}")
    arguments.check_outputs("out", "gripper_out", "picture")


def _lines(found: HandEyeOnPlate, notes: list[str]) -> list[str]:
    """The result as text lines."""
    lines = [*found.fit.table(), *(f"note: {note}" for note in notes)]
    lines += [
        f"note: {image.coincidence.sighting.name}: {name} not measured: {reason}"
        for image in found.images
        for name, reason in image.missing.items()
    ]
    return lines + found.fit.summary()
