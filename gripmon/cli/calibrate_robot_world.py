"""``gripmon calibrate robot-world``: a camera and an arm from poses of a target, by Dornaika and Horaud's method."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.documents import RobotWorldCalibration

_DESCRIPTION = """\
Calibrate a fixed camera against an arm that holds a target, or with --eye-in-hand a camera on the arm
against a target that stands: both unknown transforms at once, from the arm's poses and the target's.
DATA are tables (.csv, .yaml, .json) with a row for each pose: base_T_ee as tx_m, ty_m, tz_m with qx, qy,
qz, qw or with rx_rad, ry_rad, rz_rad; and cam_T_target as the same columns with cam_ before their names,
or image, from which --camera and --target find it (a charuco board, or a chequerboard with an even and
an odd number of corners, wholly in view: others don't tell which way up they are).
Turn the hand about at least two axes; ten poses or more are good."""

_EXAMPLES = """\
  gripmon calibrate robot-world poses.csv --out robot_world.yaml
  gripmon calibrate robot-world views.csv --camera camera.yaml --target charuco:8x6:0.03:0.022 --out robot_world.yaml

exit codes: 0 written; 2 wrong usage or files; 3 the poses can't be calibrated from, and why:
nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "robot-world", run, "camera and arm, from poses of a target on the hand", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("data", nargs="+", metavar="DATA", help="table of poses: .csv, .yaml or .json")
    parser.add_argument("--camera", metavar="CAMERA.yaml", help="for images: a file of gripmon calibrate intrinsics")
    parser.add_argument("--target", metavar="TARGET", help="for images: as in gripmon calibrate intrinsics")
    parser.add_argument("--eye-in-hand", action="store_true", help="the camera is on the hand, the target stands")
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace files that are there")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate robot-world``."""
    from gripmon.calibrate.api import calibrate_robot_world
    from gripmon.calibrate.documents import robot_world_document
    from gripmon.calibrate.tables import read_arm_poses
    from gripmon.daemon.calibrations import read_given_camera
    from gripmon.model.provenance import provenance_of

    out, inputs = Path(arguments.out), [Path(name) for name in arguments.data]
    files.check_output(out, force=arguments.force)
    target = None if arguments.target is None else files.target_of(arguments.target)
    camera = None if arguments.camera is None else read_given_camera(Path(arguments.camera))
    with files.errors_of("robot-world"):
        poses = read_arm_poses(inputs, camera, target, common.progress_bar)
        for line in poses.unseen:
            print(line, file=sys.stderr)
        found = calibrate_robot_world(
            poses.base_T_ee,
            poses.cam_T_target,
            poses.covariance,
            common=poses.common,
            eye_in_hand=arguments.eye_in_hand,
        )
    if poses.images:
        inputs += [Path(arguments.camera), *poses.images]
    options = files.options_of(arguments, "camera", "target", "eye-in-hand", "out", "force")
    provenance = provenance_of(files.command_line("robot-world", arguments.data, options), inputs)
    written = robot_world_document(found, poses.names, provenance, eye_in_hand=arguments.eye_in_hand)
    files.write_document(written, out)
    _report(written)
    print(f"written: {out}")
    return common.EXIT_DONE


def _report(written: RobotWorldCalibration) -> None:
    residuals, sigmas = written.residuals, written.sigmas
    print(
        f"{residuals.used} of {residuals.poses} poses, RMS {1e3 * residuals.rms_m:.3f} mm and "
        f"{57.29578 * residuals.rms_rad:.4f} deg each axis"
    )
    for name in residuals.outliers:
        print(f"  left out: {name}")
    for name, transform in list(written.transforms.items())[:2]:
        shown = ", ".join(
            f"{1e3 * value:.2f} ± {1e3 * sigmas[f'{name}.{axis}_m']:.2f}"
            for value, axis in zip(transform.translation_m, "xyz", strict=True)
        )
        turned = ", ".join(f"± {57.29578 * sigmas[f'{name}.r{axis}_rad']:.3f}" for axis in "xyz")
        print(f"{name:14s} {shown} mm; {turned} deg")
