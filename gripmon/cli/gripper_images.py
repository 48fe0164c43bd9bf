"""``gripmon gripper from-images``: a gripper file from images before changing backgrounds."""

from __future__ import annotations

import argparse

from gripmon.cli.common import REQUIRED, RESPONSE, RESPONSE_OPTION, Arguments, Command, jaw_range, length, progress_bar

_OPTIONS = f"""
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

_EXAMPLES = """\
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
    _OPTIONS, _EXAMPLES, camera=REQUIRED, distance=length,
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

    from gripmon.daemon.gripper_images import images_inputs, images_taken
    from gripmon.model.images import images_of_one_camera
    from gripmon.model.provenance import provenance_of
    from gripmon.teach.fingers import UnclearPartsError
    from gripmon.teach.from_images import gripper_from_images

    arguments.check_outputs("out", "reference_out", "picture")
    cv2.setNumThreads(1)
    taken = images_taken(arguments.image)
    images = taken.images
    given = images_inputs(images, arguments.camera, arguments.reference)
    provenance = provenance_of(arguments.command_line(), list(dict.fromkeys([*taken.files, *given.files])))
    try:
        found = gripper_from_images(
            images, given.camera, openings_m=given.openings_m, distance_m=arguments.distance,
            finger_width_m=arguments.finger_width, reference=given.reference, jaw_range_m=arguments.jaw_range,
            fingers=arguments.fingers, within=arguments.within or (), name=arguments.name, provenance=provenance,
            response=arguments.response, progress=progress_bar,
        )  # fmt: skip
    except UnclearPartsError as unclear:
        arguments.save("picture", unclear.picture(next(images_of_one_camera(images))[1]))
        raise
    arguments.save_gripper(found, provenance, videos=taken.notes)
