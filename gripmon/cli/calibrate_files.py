"""``gripmon calibrate verify``, ``import`` and ``export``: calibrations that are there, compared and exchanged."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import render
from gripmon.cli.common import REQUIRED, Arguments, Command, note, positive_number
from gripmon.model.errors import InputError, input_errors
from gripmon.model.project import file_of
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

if TYPE_CHECKING:
    from gripmon.calibrate.verify import Calibrated, Verdict

DEFAULT_LEVEL = 0.01

_VERIFY_OPTIONS = """
A                    calibration: a file, or a project's folder for its hand_eye.yaml
B...                 the other calibration, or images (files, folders)
--config CONFIG      with images: the configuration with gripper and monitor
--target TARGET      with images: the plate that the gripper stands on
--other-target       the plate is another one than the calibration's, of the same pattern in another size
--jaw-opening M      in the images (m); default: the calibration's, else the configuration's
--level P            probability that equal calibrations are reported as different (default: 0.01)
--tolerance-mm MM    negligible shift of the TCP, however significant
--tolerance-deg DEG  negligible rotation, however significant; with --tolerance-mm
--tolerance-px PX    negligible difference of two cameras in the image, however significant
--json               print JSON
"""

_VERIFY_EXAMPLES = """\
  gripmon calibrate verify hand_eye.yaml new/hand_eye.yaml
  gripmon calibrate verify camera.yaml imported.yaml --tolerance-px 0.2
  gripmon calibrate verify hand_eye.yaml today/*.png --config mine/arm1.yaml
  gripmon calibrate verify hand_eye.yaml plate/*.png --config mine/arm1.yaml --target charuco:14x12:0.006:0.0044

exit codes: 0 the same; 2 wrong usage or files; 3 different, or the images can't be measured (then
only the reason is printed)"""


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 0.5:
        raise argparse.ArgumentTypeError(f"'{text}' isn't a probability of a false alarm; between 0 and 0.5, e.g. 0.01")
    return value


@Command(
    _VERIFY_OPTIONS, _VERIFY_EXAMPLES,
    level={"type": _share, "default": DEFAULT_LEVEL}, jaw_opening=positive_number, tolerance_mm=positive_number,
    tolerance_deg=positive_number, tolerance_px=positive_number,
)  # fmt: skip
def verify(arguments: Arguments) -> int:
    """Compare two hand/eye calibrations (difference at the TCP, mm and degrees along the camera's axes), two
    cameras (the largest difference of their projections in the image), or a hand/eye calibration with
    fresh images of the gripper: on the calibration plate (--target), or anywhere, measured as by the
    monitor; then three or more before different backgrounds, because one that contradicts the others is
    left out.  Each may also be a configuration, a monitor's state file (its reference in force) or
    estimates.jsonl (its last valid transform).  The significance follows from both covariances; errors
    common to both, such as the camera's, make differences look less significant than they are.
    """
    from gripmon.calibrate.api import verify
    from gripmon.daemon.calibrations import read_calibrated

    tolerance_m, tolerance_rad = arguments.metres("tolerance_mm"), arguments.radians("tolerance_deg")
    if (tolerance_m is None) is not (tolerance_rad is None):
        raise InputError("--tolerance-mm and --tolerance-deg: one without the other; both or none")
    first = read_calibrated(file_of(arguments.a, "reference"))
    second, doubts = _second(first, arguments)
    found = verify(
        first, second, level=arguments.level, tolerance_m=tolerance_m, tolerance_rad=tolerance_rad,
        tolerance_px=arguments.tolerance_px,
    )  # fmt: skip
    found = replace(found, warnings=(*doubts, *found.warnings))
    given = tolerance_m is not None or arguments.tolerance_px is not None
    if arguments.json:
        print(json.dumps(found.values() | {"within_tolerance": found.within if given else None}))
    else:
        print("\n".join(_lines(found, given=given)))
    return EXIT_DONE if found.same else EXIT_FAILED


def _lines(found: Verdict, *, given: bool) -> list[str]:
    """For a person, the verdict last; ``given``: with a tolerance."""
    apart, level = found.difference, f"at a level of {found.level:g}"
    if found.same and found.within:
        verdict = "same: within the tolerance" if given else "same: the difference is negligible"
    elif not found.same and apart.p_value is None:
        verdict = "different: beyond the tolerance"
    else:
        verdict = f"same (not distinguished {level})" if found.same else f"different ({level})"
    return [*_difference(found.values()), *(f"warning: {warning}" for warning in found.warnings), verdict]


def _difference(values: dict[str, Any]) -> list[str]:
    if values["kind"] == "camera":
        names = {"largest_turned_px": "left_after_a_turn_of_the_camera_px", "turn_rad": "that_turn_rad"}
        told = ("largest_px", "largest_sigma_px", "at_px", "rms_px", "largest_turned_px", "turn_rad")
        shown = {names.get(key, key): values[key] for key in told}
        share = {} if values["compared"] == 1.0 else {"share_of_the_image_compared": values["compared"]}
        return render.lines(shown | {"probability_by_chance": _probability(values["p_value"])} | share)
    columns = ("position_m", "position_sigma_m", "rotation_rad", "rotation_sigma_rad")
    heads = ("second_less_first,_camera_axes", "TCP_m", "±_m", "turn_rad", "±_rad")
    rows = [dict(zip(heads, row, strict=True)) for row in zip("xyz", *(values[key] for key in columns), strict=True)]
    parts = {"tcp": "position_p_value", "turn": "rotation_p_value", "both": "p_value"}
    chances = {part: _probability(values[key]) for part, key in parts.items()}
    together = {"tcp_m": math.hypot(*values["position_m"]), "turn_rad": math.hypot(*values["rotation_rad"])}
    return [*render.table(rows), *render.lines({"together": together, "probability_by_chance": chances})]


def _second(first: Calibrated, arguments: Arguments) -> tuple[Calibrated, tuple[str, ...]]:
    """The other calibration, or the measurement in images; and warnings about it."""
    from gripmon.daemon.calibrations import measure_again, read_calibrated
    from gripmon.daemon.targets import target_of
    from gripmon.model.images import IMAGE_SUFFIXES

    names: list[str] = arguments.b

    def of_images(name: str) -> bool:
        if not Path(name).is_dir():
            return Path(name).suffix.lower() in IMAGE_SUFFIXES
        # Images need the configuration: without it, a folder with a calibration is a project's.
        return arguments.config is not None or not file_of(name, "reference").is_file()

    if any(map(of_images, names)):
        target = None if arguments.target is None else target_of(arguments.target)
        return measure_again(
            first, names, arguments.config, target, other_target=arguments.other_target,
            jaw_opening_m=arguments.jaw_opening,
        )  # fmt: skip
    arguments.refuse(("config", "target", "other_target", "jaw_opening"), "applies only to images; leave it out")
    if len(names) > 1:
        raise InputError(f"{names[1]}: a third calibration; two of them, or images")
    return read_calibrated(file_of(names[0], "reference")), ()


def _probability(value: float | None) -> float | str | None:
    return "below 1e-9" if value is not None and value < 1e-9 else value


CAMERA_FORMATS = ("ros", "kalibr", "opencv", "mrcal")
HAND_EYE_FORMATS = ("ros-static", "urdf", "easy_handeye2", "json")
_FRAMES = ("gripper_frame", "camera_frame", "robot_base_frame", "tracking_marker_frame")

_IMPORT_OPTIONS = """
FILE                file of the other program
--camera NAME       which of several cameras, e.g. cam1, or M1 of OpenCV's stereo; of a hand/eye transform the frame
                    that is the camera's (default: the only one)
--size WIDTHxHEIGHT
                    image size (px), for a file without it
--model             the lens, where the file doesn't say it or calls a fisheye plumb_bob
--out FILE.yaml     file to write
--force             replace the file if there is one
"""

_IMPORT_EXAMPLES = """\
  gripmon calibrate import camera_info.yaml --out camera.yaml
  gripmon calibrate import camchain.yaml --camera cam1 --out camera.yaml
  gripmon calibrate import intrinsics.xml --size 1280x960 --model fisheye --out camera.yaml
  gripmon calibrate import wrist.calib --out reference.yaml

exit codes: 0 written; 2 wrong usage or files: nothing is written then"""

_EXPORT_OPTIONS = """
CALIBRATION  file with the calibration, or a project's folder that holds it
--format     what to write
--out FILE   file to write (default: to the terminal)
--force      replace the file if there is one
--name NAME  the camera's name, or the calibration's in easy_handeye2 (default: gripmon)
--fit        cameras: if the format lacks this lens, write the nearest Brown-Conrady and print its deviation
"""

_EXPORT_FRAMES = """
--gripper-frame NAME          the gripper's, at the TCP (default: gripper_tcp)
--camera-frame NAME           the camera's optical frame (default: camera_optical_frame)
--robot-base-frame NAME       in an easy_handeye2 file (default: base_link)
--tracking-marker-frame NAME  in an easy_handeye2 file (default: calibration_plate)
--gripper-in-camera           the gripper as child of the camera instead of the reverse
"""

_EXPORT_EXAMPLES = """\
  gripmon calibrate export camera.yaml --format ros --name wrist --out wrist.yaml
  gripmon calibrate export camera.yaml --format opencv --out camera.xml
  gripmon calibrate export hand_eye.yaml --format ros-static --gripper-frame tool0 --camera-frame wrist_optical_frame
  gripmon calibrate export hand_eye.yaml --format urdf --out wrist_joint.xml
  gripmon calibrate export ~/.local/state/gripmon/arm-wrist.json --format json

exit codes: 0 written; 2 wrong usage or files, or a lens that the format lacks: nothing is written then"""


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' isn't an image size; e.g. 1280x960")
    return int(match[1]), int(match[2])


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", text):
        raise argparse.ArgumentTypeError(f"{text}: isn't a plain name; letters, digits, _ . and -")
    return text


@Command(
    _IMPORT_OPTIONS, _IMPORT_EXAMPLES,
    size=_size, model={"choices": ("brown_conrady", "fisheye")}, out=REQUIRED,
)  # fmt: skip
def import_(arguments: Arguments) -> None:
    """Import a camera that another program has calibrated: of ROS (camera_info, also as ros2 topic echo prints it,
    ost.txt), Kalibr, OpenCV (YAML, XML, JSON), mrcal, COLMAP (cameras.txt), RealSense, ORB-SLAM, VINS or
    OpenICC (GoPro); or a hand/eye transform of easy_handeye 1 or 2, MoveIt, a static_transform_publisher or a
    URDF joint.  The format is recognised by the content.  Commands that take a camera also take these files as
    they are; import answers what they leave open.
    """
    from gripmon.daemon.exchange import import_calibration

    arguments.check_outputs("out")
    found, lines = import_calibration(
        arguments.file, arguments.command_line(), which=arguments.camera, size_px=arguments.size, model=arguments.model
    )
    arguments.save("out", found)
    print("\n".join([*lines, f"written: {arguments.out}"]))


@Command(
    _EXPORT_OPTIONS, _EXPORT_EXAMPLES,
    {"frames of a hand/eye transform": (None, _EXPORT_FRAMES)},
    format={"required": True, "choices": (*CAMERA_FORMATS, *HAND_EYE_FORMATS)}, name=_name,
)  # fmt: skip
def export(arguments: Arguments) -> None:
    """Write a camera as ROS camera_info, Kalibr camchain, OpenCV FileStorage or mrcal .cameramodel, or a
    hand/eye transform as a tf2 static transform command, a URDF joint with its origin, an easy_handeye2
    file or JSON.  CALIBRATION is a file of gripmon calibrate, a configuration, a monitor's state file
    (its reference in force) or estimates.jsonl (its last valid transform).

    A hand/eye transform is written as the camera's pose in the gripper's frame (origin at the TCP, x
    across the jaws, z out of the gripper), in the order of a robot's tree; --gripper-in-camera inverts it.
    """
    from gripmon.daemon.exchange import export_calibration

    arguments.check_outputs("out")
    camera = arguments.format in CAMERA_FORMATS
    # An option without effect is a mistake.
    unused = [*_FRAMES, "gripper_in_camera"] if camera else ["fit"]
    if not camera and arguments.format != "easy_handeye2":
        unused += ["robot_base_frame", "tracking_marker_frame"]
    arguments.refuse(unused, f"has no meaning with --format {arguments.format}; leave it out")
    frames = {key: name for key in _FRAMES if (name := getattr(arguments, key))}
    with input_errors("calibrate export"):
        exported = export_calibration(
            file_of(arguments.calibration, "camera" if camera else "reference"), arguments.format,
            arguments.command_line(), name=arguments.name or "gripmon",
            suffix="" if arguments.out is None else arguments.out.suffix, fit=arguments.fit, frames=frames,
            gripper_in_camera=arguments.gripper_in_camera,
        )  # fmt: skip
    note(f"warning: {warning}" for warning in exported.warnings)
    if arguments.out is None:
        sys.stdout.write(exported.data.decode())
    else:
        arguments.save("out", exported.data)
        print(f"written: {arguments.out}")
