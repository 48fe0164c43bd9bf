"""``gripmon calibrate export``: a calibration in the format of another program."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.cli.calibrate_import import CAMERA_FORMATS
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.verify import Calibrated

HAND_EYE_FORMATS = ("ros-static", "urdf", "easy_handeye2", "json")
_FRAMES = {
    "gripper_frame": ("--gripper-frame", "gripper_tcp"),
    "camera_frame": ("--camera-frame", "camera_optical_frame"),
    "robot_base_frame": ("--robot-base-frame", "base_link"),
    "tracking_marker_frame": ("--tracking-marker-frame", "calibration_plate"),
}

_DESCRIPTION = """\
Write a camera as ROS camera_info, Kalibr camchain, OpenCV FileStorage or mrcal .cameramodel, or a
hand/eye transform as a tf2 static transform command, a URDF joint with its origin, an easy_handeye2
file or JSON.  CALIBRATION is a file of gripmon calibrate, a configuration, a monitor's state file
(its reference in force) or estimates.jsonl (the last valid one).

A hand/eye transform is written as the camera's pose in the gripper's frame (origin at the TCP, x
across the jaws, z out of the gripper), as a robot's tree runs; --gripper-in-camera turns it round."""

_EXAMPLES = """\
  gripmon calibrate export camera.yaml --format ros --name wrist --out wrist.yaml
  gripmon calibrate export camera.yaml --format opencv --out camera.xml
  gripmon calibrate export hand_eye.yaml --format ros-static --gripper-frame tool0 --camera-frame wrist_optical_frame
  gripmon calibrate export hand_eye.yaml --format urdf --out wrist_joint.xml
  gripmon calibrate export ~/.local/state/gripmon/arm-wrist.json --format json

exit codes: 0 written; 2 wrong usage or files, or a lens that the format hasn't: nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "export", run, "a calibration for ROS, Kalibr, OpenCV, mrcal, URDF, easy_handeye2", _DESCRIPTION,
        _EXAMPLES,
    )  # fmt: skip
    parser.add_argument("calibration", metavar="CALIBRATION", help="file with the calibration")
    parser.add_argument("--format", required=True, choices=(*CAMERA_FORMATS, *HAND_EYE_FORMATS), help="what to write")
    parser.add_argument("--out", metavar="FILE", help="file to write (default: to the terminal)")
    parser.add_argument("--force", action="store_true", help="replace the file if there is one")
    parser.add_argument("--name", help="the camera's name, or the calibration's in easy_handeye2 (default: gripmon)")
    parser.add_argument(
        "--fit",
        action="store_true",
        help="cameras: if the format lacks this lens, write the nearest Brown-Conrady and print how far off it is",
    )
    frames = parser.add_argument_group("frames of a hand/eye transform")
    help_of = {
        "gripper_frame": "the gripper's, at the TCP",
        "camera_frame": "the camera's optical frame",
        "robot_base_frame": "in an easy_handeye2 file",
        "tracking_marker_frame": "in an easy_handeye2 file",
    }
    for key, (option, default) in _FRAMES.items():
        frames.add_argument(option, metavar="NAME", help=f"{help_of[key]} (default: {default})")
    frames.add_argument(
        "--gripper-in-camera", action="store_true", help="the gripper below the camera instead of the reverse"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate export``."""
    from gripmon.daemon.calibrations import read_calibrated

    out = None if arguments.out is None else Path(arguments.out)
    if out is not None:
        files.check_output(out, force=arguments.force)
    _check_options(arguments)
    source = read_calibrated(Path(arguments.calibration))
    data = (_camera if arguments.format in CAMERA_FORMATS else _hand_eye)(source, _notes(source, arguments), arguments)
    if out is None:
        sys.stdout.write(data.decode())
    else:
        files.write_bytes(data, out)
        print(f"written: {out}")
    return common.EXIT_DONE


def _check_options(arguments: argparse.Namespace) -> None:
    """An option that would do nothing was meant for something."""
    camera = arguments.format in CAMERA_FORMATS
    frames = [option for key, (option, _) in _FRAMES.items() if getattr(arguments, key) is not None]
    frames += ["--gripper-in-camera"] if arguments.gripper_in_camera else []
    unused = frames if camera else ["--fit"] if arguments.fit else []
    if not camera and arguments.format != "easy_handeye2":
        unused += [o for o in frames if o in ("--robot-base-frame", "--tracking-marker-frame")]
    if unused:
        raise InputError(f"{unused[0]}: has no meaning with --format {arguments.format}; leave it out")


def _notes(source: Calibrated, arguments: argparse.Namespace) -> tuple[str, ...]:
    from gripmon.model.provenance import provenance_of

    frames = [option.removeprefix("--") for option, _ in _FRAMES.values()]
    options = files.options_of(arguments, "format", "name", "fit", *frames, "gripper-in-camera", "out")
    made = provenance_of(files.command_line("export", [arguments.calibration], options), [Path(arguments.calibration)])
    return (
        f"written {made.time} by gripmon {made.gripmon}: {made.command}",
        f"from {source.name}, SHA-256 {made.inputs[0].sha256}",
        *source.notes,
        *(() if arguments.format in CAMERA_FORMATS else source.pose_notes),
    )


def _camera(source: Calibrated, notes: tuple[str, ...], arguments: argparse.Namespace) -> bytes:
    from gripmon.calibrate.interchange import write_camera

    if source.lens is None:
        raise InputError(
            f"{source.name}: is {source.kind} without a camera; a camera calibration, a hand/eye calibration or a "
            "configuration"
        )
    exported = write_camera(
        source.lens,
        arguments.format,
        notes,
        name=_name(arguments),
        file=source.name,
        suffix=Path(arguments.out or "").suffix,
        fit=arguments.fit,
    )
    for warning in exported.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return exported.data


def _hand_eye(source: Calibrated, notes: tuple[str, ...], arguments: argparse.Namespace) -> bytes:
    from gripmon.calibrate.interchange import HandEye, write_hand_eye

    if source.cam_T_grip is None:
        raise InputError(
            f"{source.name}: is {source.kind}, which has no hand/eye transform; a hand/eye calibration, a "
            "configuration, a monitor's state or its estimates"
        )
    frames = {key: getattr(arguments, key) or default for key, (_, default) in _FRAMES.items()}
    try:
        hand_eye = HandEye(
            source.cam_T_grip,
            source.covariance,
            gripper_in_camera=arguments.gripper_in_camera,
            name=_name(arguments),
            **frames,
        )
        return write_hand_eye(hand_eye, arguments.format, notes).encode()
    except ValueError as error:
        raise InputError(f"calibrate export: {error}") from None


def _name(arguments: argparse.Namespace) -> str:
    import re

    name = arguments.name or "gripmon"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise InputError(f"--name {name}: isn't a plain name; letters, digits, _ . and -")
    return str(name)
