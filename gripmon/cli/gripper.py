"""``gripmon gripper``: a gripper file from CAD, or from images before changing backgrounds."""

from __future__ import annotations

import argparse
import itertools
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    REQUIRED,
    RESPONSE,
    RESPONSE_OPTION,
    Arguments,
    Command,
    jaw_opening,
    jaw_range,
    length,
    note,
    positive_number,
    progress_bar,
    two_numbers,
)
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.model.provenance import Provenance
    from gripmon.teach.result import GripperResult

_CAD_OPTIONS = """
FILE...                 .stl, .obj, .ply, .dae, .cao: one per finger, or both in one; or one .urdf
--out FILE.yaml         gripper file to write
--unit UNIT             unit of meshes: m, cm, mm or in (a .dae has its own)
--body BODIES           for one mesh of several bodies: all (one finger), or their numbers, as 1,2 (two fingers) or
                        1+3,2; for a URDF: the fingers' links, as link1,link2
--approach AXIS[,AXIS]  axis of the CAD frame that points out of the gripper: +x, -x, +y, -y, +z or -z (default: +z, for
                        a URDF the direction of its fingers), and the one from the left finger to the right one; write
                        negative ones as --approach=-x
--frame FRAME           tcp: origin between the fingertips; cad: the CAD's own (default tcp)
--length M              use only this length of the fingers, from the tips (m)
--jaw-range MIN:MAX     range of the jaw opening (m); for a URDF: only this part of its joint's
--jaw-opening M         reported opening of the jaws as drawn (default: the tips' distance, m)
--joint NAME[=POS]      for a URDF: the joint that opens the jaws, if several are possible, or where it stands (m or
                        rad); two of them with a comma
--bevel M               width of the bevels on real edges that are sharp in the CAD (default: 0.0002 m); 0: the edges
                        are known to be sharp to 0.02 mm
--camera FILE.yaml      the view's camera: a file of gripmon calibrate intrinsics, or a configuration
--reference FILE.yaml   the gripper's pose in the view: a file of gripmon calibrate plane, or a configuration
| --view D:TILT         a rough pose: the TCP at distance D (m) in the image's middle, the camera at -y and tilted
                        by TILT (degrees) against z
--name NAME             the gripper's name (default: FILE's; for several FILEs that of --out)
--picture FILE.png      also draw the model in the view
--force                 replace existing files
--json                  one JSON object instead of text; m
"""

_CAD_EXAMPLES = """\
  gripmon gripper from-cad left.stl right.stl --unit mm --jaw-range 0:0.06 --out gripper.yaml
  gripmon gripper from-cad gripper.urdf --camera camera.yaml --view 0.12:30 \\
      --out gripper.yaml --picture gripper.png
  gripmon gripper from-cad finger.obj --unit m --approach=-y --camera camera.yaml \\
      --reference hand_eye.yaml --length 0.04 --out gripper.yaml

exit codes: 0 written; 2 wrong usage or files, one line says what would be right"""


def _view(text: str) -> tuple[float, float]:
    values = two_numbers(text)
    if values is None or not (0.0 < values[0] <= 2.0 and 0.0 <= values[1] <= 180.0):
        raise argparse.ArgumentTypeError(
            f"'{text}' isn't D:TILT; metres (2 at most; millimetres?) and degrees, e.g. 0.12:30"
        )
    return values


def _bevel(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' isn't the width of a bevel; metres, e.g. 0.0002") from None


@Command(
    _CAD_OPTIONS, _CAD_EXAMPLES, out=REQUIRED, length=positive_number,
    jaw_range=jaw_range, jaw_opening=jaw_opening, view=_view, frame={"default": "tcp"},
    bevel=_bevel,
)  # fmt: skip
def from_cad(arguments: Arguments) -> None:
    """Make a gripper file from CAD.  FILE is one mesh (STL, OBJ, PLY, DAE) or ViSP .cao for each finger, one
    with both, or one URDF.  Meshes need --unit; URDF, DAE and .cao have theirs.

    The origin is the TCP, the middle of the four innermost fingertip corners: x across the jaws, from the
    finger called left to the right one, z along --approach.  --frame cad keeps the CAD's axes.

    The jaws' motion comes from the URDF's joint; for meshes, both fingers move straight by half of an opening
    in --jaw-range.  What a URDF or a mesh of several bodies doesn't tell is asked for, with the option.

    Real edges are broken, by 0.1 to 0.3 mm if the drawing leaves it open (ISO 13715); CAD draws them sharp.
    --bevel states the width.  The default makes the bounds of an untaught gripper so wide that hardly any
    transform is valid at an alert limit of 1 mm: gripmon teach measures the real edges.

    Convex fingers with flat faces are valid for every view.  For round, hollow or open ones the edges and
    outlines are those of one view: --camera with --reference, or with a rough --view.  Make such a file
    again when the camera moves by more than some degrees.
    """
    from gripmon.daemon.calibrations import view_in
    from gripmon.model.gripper import UNTOLD_BEVEL_M
    from gripmon.model.provenance import provenance_of
    from gripmon.teach.cad import gripper_from_cad

    arguments.check_outputs("out", "picture")
    camera, cam_T_grip = view_in(arguments.camera, arguments.reference, arguments.view)
    if arguments.picture is not None and (camera is None or cam_T_grip is None):
        raise InputError("--picture: needs a view; add --camera and --reference or --view")
    missing = [path for path in arguments.file if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: there is no such file; a mesh, URDF or .cao")
    name = arguments.name or (arguments.out.stem if len(arguments.file) > 1 else None)
    provenance = provenance_of(arguments.command_line(), arguments.file)
    made = gripper_from_cad(
        arguments.file, unit=arguments.unit, name=name, camera=camera, cam_T_grip=cam_T_grip,
        jaw_range_m=arguments.jaw_range, jaw_opening_m=arguments.jaw_opening, joint=arguments.joint,
        body=arguments.body, frame=arguments.frame, approach=arguments.approach, length_m=arguments.length,
        bevel_m=UNTOLD_BEVEL_M if arguments.bevel is None else arguments.bevel,
        provenance=provenance, progress=progress_bar,
    )  # fmt: skip
    save(arguments, made, provenance)


_IMAGES_OPTIONS = f"""
IMAGE...                image file, video file, or folder with images or videos; of a video some frames at equal
                        distances are taken, those that show another view
--camera FILE.yaml      file of gripmon calibrate intrinsics
--distance M:SIGMA      distance of the fingertips from the camera along its axis, with its standard deviation (m),
                        which is in every protection level
| --finger-width M:SIGMA
                        width of a fingertip across the jaws, with its standard deviation (m)
| --reference FILE.yaml
                        hand/eye calibration: its frame is kept.  Of gripmon calibrate plane, or cam_T_grip with
                        position_sigma_m and rotation_sigma_rad
--jaw-range MIN:MAX     range of the jaw opening (m); otherwise as far again as the images show to either side
--fingers {{1,2}}         how many fingers the images show; with 1, another one isn't expected (default: 2)
--within LEFT,TOP,RIGHT,BOTTOM...
                        where in the image the fingers are (px), if something else stays in it, too; given twice, one
                        finger in each
{RESPONSE_OPTION.strip()}
--name NAME             the gripper's name (default: gripper)
--out FILE.yaml         gripper file to write
--reference-out FILE.yaml
                        reference to write, for a configuration's `reference:`
--picture FILE.png      also draw outline, scatter and fingers over the first image, or what stays if that isn't clear
--force                 replace existing files
--json                  one JSON object instead of text; m, rad, px
"""

_IMAGES_EXAMPLES = """\
  gripmon gripper from-images free/ --camera camera.yaml --distance 0.12:0.003 \\
      --out gripper.yaml --reference-out reference.yaml --picture gripper.png
  gripmon gripper from-images openings/ --camera camera.yaml --out gripper.yaml \\
      --reference-out reference.yaml --jaw-range 0:0.085

exit codes: 0 written; 2 wrong usage or files; 3 no gripper found in the images, with the reason:
nothing is written then"""


def _box(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, right, bottom = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' isn't LEFT,TOP,RIGHT,BOTTOM in pixels") from None
    if not (0 <= left < right and 0 <= top < bottom):
        raise argparse.ArgumentTypeError(f"'{text}' is empty; LEFT,TOP,RIGHT,BOTTOM in pixels, e.g. 100,200,500,479")
    return left, top, right, bottom


@Command(
    _IMAGES_OPTIONS, _IMAGES_EXAMPLES, camera=REQUIRED, distance=length,
    finger_width=length, fingers={"type": int, "choices": (1, 2)}, within=_box, jaw_range=jaw_range,
    name={"default": "gripper"}, out=REQUIRED, response=RESPONSE,
)  # fmt: skip
def from_images(arguments: Arguments) -> None:
    """Measure a gripper's outline, inner edges and pose in five to a hundred images of the wrist camera: the
    robot moves, so that the background changes and the gripper stays.  This needs no dimensions, straight
    edges or plate.  One length gives the size: the distance of the fingertips from the camera, or the
    width of a finger.  Images at several jaw openings show how the fingers move; with the openings in
    metres in a timestamps.csv beside them, as for gripmon replay, they also give the size, unless the
    fingers turn.  Without any, lengths are in units of the distance, which is enough to watch a mount.

    Use at least five images of each opening, in focus, each before another background, lit as in use.  If
    the fingers' long edges meet in one point (their vanishing point), it gives the fingers' pose in space,
    otherwise the motion of both fingers between openings; with one opening the outline is then assumed to
    be flat, tilted as usual.  The uncertainty is printed, in the reference's covariance and in the file.

    The command writes the gripper file and, with --reference-out, its reference.
    """
    import cv2

    from gripmon.daemon.calibrations import camera_in, pose_in
    from gripmon.daemon.gripper_images import images_taken, openings_beside
    from gripmon.model.images import images_of_one_camera
    from gripmon.model.provenance import provenance_of
    from gripmon.teach.fingers import UnclearPartsError
    from gripmon.teach.from_images import gripper_from_images

    arguments.check_outputs("out", "reference_out", "picture")
    cv2.setNumThreads(1)
    taken = images_taken(arguments.image)
    images = taken.images
    reference = None if arguments.reference is None else pose_in(arguments.reference)
    camera, openings_m = camera_in(arguments.camera).lens, openings_beside(images)
    files = [*taken.files, arguments.camera, *([] if reference is None else [arguments.reference])]
    provenance = provenance_of(arguments.command_line(), list(dict.fromkeys(files)))
    try:
        found = gripper_from_images(
            images, camera, openings_m=openings_m, distance_m=arguments.distance,
            finger_width_m=arguments.finger_width, reference=reference, jaw_range_m=arguments.jaw_range,
            fingers=arguments.fingers, within=arguments.within or (), name=arguments.name, provenance=provenance,
            response=arguments.response, progress=progress_bar,
        )  # fmt: skip
    except UnclearPartsError as unclear:
        _, shown = next(images_of_one_camera(images[unclear.image :]))
        arguments.save("picture", unclear.picture(shown))
        if arguments.picture is not None:
            note([f"written: {arguments.picture} (what was seen; with --force the next try replaces it)"])
        raise
    save(arguments, found, provenance, videos=taken.notes)


def save(arguments: Arguments, made: GripperResult, provenance: Provenance, **taken: list[str]) -> None:
    """Write what the options name of a gripper, its file, reference and picture, and print its summary, after what was
    ``taken``: lines by their keys in JSON.
    """
    arguments.save("out", made.text().encode())
    if getattr(arguments, "reference_out", None) is not None:
        arguments.save("reference_out", made.reference(provenance))
    arguments.save("picture", made.picture)
    paths = (getattr(arguments, name, None) for name in ("out", "reference_out", "picture"))
    written = [str(path) for path in paths if path is not None]
    lines = [*itertools.chain(*taken.values()), *made.summary(), *(f"written: {each}" for each in written)]
    arguments.answer({**made.values(), **taken, "written": written}, lines)
