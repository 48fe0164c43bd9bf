"""``gripmon calibrate import`` and ``export``: calibrations from and for other programs."""

from __future__ import annotations

import argparse
import re
import sys

from gripmon.cli.common import REQUIRED, Arguments, Command, note
from gripmon.model.errors import input_errors

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
CALIBRATION  file with the calibration
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
            arguments.calibration, arguments.format, arguments.command_line(), name=arguments.name or "gripmon",
            suffix="" if arguments.out is None else arguments.out.suffix, fit=arguments.fit, frames=frames,
            gripper_in_camera=arguments.gripper_in_camera,
        )  # fmt: skip
    note(f"warning: {warning}" for warning in exported.warnings)
    if arguments.out is None:
        sys.stdout.write(exported.data.decode())
    else:
        arguments.save("out", exported.data)
        print(f"written: {arguments.out}")
