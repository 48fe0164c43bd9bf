"""``gripmon calibrate laser`` and ``robot-world``: a fixed camera against an arm."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    REQUIRED,
    Arguments,
    Command,
    arm_noise,
    note,
    positive_number,
    progress_bar,
    whole_number,
)
from gripmon.model.atomic import writing
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.documents import RobotWorldCalibration
    from gripmon.laser.documents import LaserCalibration
    from gripmon.laser.planning import Plan

LONGEST_ARM_M = 20.0
_LASER_OPTIONS = """
DATA...               table of samples: .csv, .yaml or .json
--camera CAMERA.yaml  the camera: a file of gripmon calibrate intrinsics
--out FILE.yaml       file to write
--picture FILE.png    also draw residuals and scene
--recording FILE.rrd  also write the scene as a rerun recording
--refine-lens         also estimate the lens, within its calibration's covariance; otherwise it is held, and its
                      covariance is included in the result's
--arm-noise M:RAD     standard deviations of the arm's poses, position (m) and rotation (rad), each axis
                      (default: none)
--plan FILE.csv       also write the poses that would help most next; needs --reach
--poses N             number of planned poses (default 10)
--reach M             the arm's reach (m)
--force               replace existing files
"""

_LASER_EXAMPLES = """\
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml --picture laser.png
  gripmon calibrate laser monday.csv tuesday.csv --camera camera.yaml --out laser.yaml --recording laser.rrd
  gripmon calibrate laser spots.yaml --camera camera.yaml --refine-lens --arm-noise 0.0001:0.0002 --out laser.yaml
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml --plan next.csv --reach 0.85

exit codes: 0 written; 2 wrong usage or files; 3 no calibration from these spots, with the reason:
nothing is written then"""

_ROBOT_WORLD_OPTIONS = """
DATA...               table of poses: .csv, .yaml or .json
--camera CAMERA.yaml  for images: a file of gripmon calibrate intrinsics
--target TARGET       for images: as in gripmon calibrate intrinsics
--other-target        the target is another one than the camera's, of the same pattern in another size
--eye-in-hand         the camera is on the hand, the target is fixed
--out FILE.yaml       file to write
--force               replace existing files
"""

_ROBOT_WORLD_EXAMPLES = """\
  gripmon calibrate robot-world poses.csv --out robot_world.yaml
  gripmon calibrate robot-world views.csv --camera camera.yaml --target charuco:8x6:0.03:0.022 --out robot_world.yaml

exit codes: 0 written; 2 wrong usage or files; 3 no calibration from these poses, with the reason:
nothing is written then"""


def _reach(text: str) -> float:
    value = positive_number(text)
    if value > LONGEST_ARM_M:
        raise argparse.ArgumentTypeError(f"{text} m isn't an arm's reach (millimetres?); metres, e.g. 0.85")
    return value


@Command(
    _LASER_OPTIONS, _LASER_EXAMPLES,
    camera=REQUIRED, out=REQUIRED, arm_noise=arm_noise, reach=_reach,
    poses={"type": whole_number(1, 200, "isn't a number of poses; 1 to 200"), "default": 10},
)  # fmt: skip
def laser(arguments: Arguments) -> None:
    """Calibrate a fixed camera against an arm with a laser pointer on its end-effector: the spot falls on a
    plane that the camera sees; the hand need not be in view.  DATA are tables (.csv, .yaml, .json) with
    one row per spot: u_px, v_px, or image (and laser_off, the same view without the laser), and the pose
    base_T_ee as tx_m, ty_m, tz_m with qx, qy, qz, qw or with rx_rad, ry_rad, rz_rad, or as m00 to m33; in
    YAML and JSON also base_T_ee: {translation_m, rotation_xyzw} or 4 x 4.  At each of at least three
    orientations, better nine, shift the end-effector along three directions without turning: ten spots.
    """
    from gripmon.daemon.config.calibrated import read_camera
    from gripmon.laser.api import SEED, PoseNoise, calibrate_laser
    from gripmon.laser.samples import plan_table
    from gripmon.model.provenance import provenance_of
    from gripmon.record.laser_scene import write_calibration

    arguments.check_outputs("out", "picture")
    if arguments.plan is not None and arguments.reach is None:
        raise InputError("--plan needs --reach, the arm's reach; metres")
    arguments.check_outputs("recording", "plan")
    noise = None if arguments.arm_noise is None else PoseNoise(*arguments.arm_noise)
    found = calibrate_laser(
        arguments.data, read_camera(arguments.camera), refine_lens=arguments.refine_lens, arm_noise=noise,
        progress=progress_bar,
    )  # fmt: skip
    note(found.unseen)
    planned = None if arguments.plan is None else found.plan(arguments.reach, arguments.poses)
    inputs = [*arguments.data, arguments.camera, *found.files]
    written = found.document(provenance_of(arguments.command_line(), inputs, SEED))
    arguments.save("picture", found.picture)
    if arguments.recording is not None:
        with writing(f"--recording {arguments.recording}"):
            write_calibration(arguments.recording, found.fit.refined, found.samples.base_T_ee, found.fit.uv_px)
    if planned is not None:
        arguments.save("plan", plan_table(planned))
    arguments.save("out", written)
    print("\n".join([*_laser_lines(written), *_plan_lines(planned), f"written: {arguments.out}"]))


def _plan_lines(planned: Plan | None) -> list[str]:
    if planned is None:
        return []
    now, then = planned.sigmas[0], planned.sigmas[-1]
    turn = f"rotation to {math.degrees(now[1]):.3f} deg, then {math.degrees(then[1]):.3f} deg"
    more = f"after {len(planned.uv_px)} more to {1e3 * then[0]:.2f} mm"
    return [f"camera's position known to {1e3 * now[0]:.2f} mm, {more}; {turn}"]


def _shown(values: Iterable[float], names: Iterable[str], sigmas: Mapping[str, float]) -> str:
    """Lengths with their standard deviations, mm."""
    return ", ".join(f"{1e3 * v:.2f} ± {1e3 * sigmas[f'{name}_m']:.2f}" for v, name in zip(values, names, strict=True))


def _turned(names: Iterable[str], sigmas: Mapping[str, float]) -> str:
    """Standard deviations of angles."""
    return ", ".join(f"± {math.degrees(sigmas[f'{name}_rad']):.3f}" for name in names) + " deg"


def _laser_lines(written: LaserCalibration) -> list[str]:
    residuals, sigmas, camera = written.residuals, written.sigmas, written.base_T_cam.translation_m
    spots = f"{residuals.used} of {residuals.spots} spots at {residuals.orientations} orientations"
    return [
        f"{spots}, RMS {residuals.rms_px:.3f} px; seed {written.provenance.seed}",
        *(f"  left out: {name}" for name in residuals.outliers),
        *(f"  {line}" for line in written.warnings),
        f"camera in the base   {_shown(camera, [f'base_T_cam.{axis}' for axis in 'xyz'], sigmas)} mm",
        f"camera's rotation    {_turned([f'base_T_cam.r{axis}' for axis in 'xyz'], sigmas)}",
        f"plane from camera    {_shown([written.plane.distance_cam_m], ['plane.distance'], sigmas)} mm",
        f"plane and beam tilt  {_turned(_TILTS, sigmas)}",
    ]


_TILTS = ("plane.tilt_a", "plane.tilt_b", "laser.turn_a", "laser.turn_b")


@Command(
    _ROBOT_WORLD_OPTIONS, _ROBOT_WORLD_EXAMPLES,
    out=REQUIRED,
)  # fmt: skip
def robot_world(arguments: Arguments) -> None:
    """Calibrate a fixed camera against an arm that holds a target, or with --eye-in-hand a camera on the arm
    against a fixed target: both unknown transforms together, from the arm's poses and the target's.
    DATA are tables (.csv, .yaml, .json) with one row per pose: base_T_ee as tx_m, ty_m, tz_m with qx, qy,
    qz, qw or with rx_rad, ry_rad, rz_rad; and cam_T_target as the same columns with the prefix cam_, or
    image, in which it is measured with --camera and --target (a charuco board, or wholly in view a
    chequerboard with an even and an odd number of corners or staggered discs in an odd number of rows:
    others have no unique orientation).
    Turn the hand about at least two axes; ten poses or more are good.
    """
    from gripmon.calibrate.api import calibrate_robot_world
    from gripmon.calibrate.documents import robot_world_document
    from gripmon.calibrate.tables import read_arm_poses
    from gripmon.daemon.calibrations import camera_in
    from gripmon.daemon.targets import target_of
    from gripmon.model.provenance import provenance_of

    arguments.check_outputs("out")
    target = None if arguments.target is None else target_of(arguments.target)
    camera = None if arguments.camera is None else camera_in(arguments.camera)
    poses = read_arm_poses(arguments.data, camera, target, progress_bar, other_target=arguments.other_target)
    note(poses.unseen)
    found = calibrate_robot_world(
        poses.base_T_ee, poses.cam_T_target, poses.covariance, common=poses.common, eye_in_hand=arguments.eye_in_hand,
    )  # fmt: skip
    inputs = [*arguments.data, *([arguments.camera, *poses.images] if poses.images else [])]
    provenance = provenance_of(arguments.command_line(), inputs)
    written = robot_world_document(found, poses.names, provenance, eye_in_hand=arguments.eye_in_hand)
    arguments.save("out", written)
    print("\n".join([*_robot_world_lines(written), f"written: {arguments.out}"]))


def _robot_world_lines(written: RobotWorldCalibration) -> list[str]:
    residuals, sigmas = written.residuals, written.sigmas
    rms = f"RMS {1e3 * residuals.rms_m:.3f} mm and {math.degrees(residuals.rms_rad):.4f} deg each axis"
    lines = [
        f"{residuals.used} of {residuals.poses} poses, {rms}",
        *(f"  left out: {name}" for name in residuals.outliers),
    ]
    for name, transform in list(written.transforms.items())[:2]:
        shown = _shown(transform.translation_m, [f"{name}.{axis}" for axis in "xyz"], sigmas)
        lines.append(f"{name:14s} {shown} mm; {_turned([f'{name}.r{axis}' for axis in 'xyz'], sigmas)}")
    return [*lines, *(f"warning: {warning}" for warning in written.warnings)]
