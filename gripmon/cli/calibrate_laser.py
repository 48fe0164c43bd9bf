"""``gripmon calibrate laser``: a fixed camera, its plane and a laser pointer on the arm, from spots and poses."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.laser.api import CalibratedLaser
    from gripmon.laser.planning import Plan
    from gripmon.laser.setup import LaserCalibration
    from gripmon.model.provenance import Provenance

LONGEST_ARM_M = 20.0
_DESCRIPTION = """\
Calibrate a fixed camera against an arm with a laser pointer on its end-effector: the spot falls on a
plane that the camera sees; the hand need not be in view.  DATA are tables (.csv, .yaml, .json) with a
row for each spot: u_px, v_px, or image (and laser_off, the same view without the laser), and the pose
base_T_ee as tx_m, ty_m, tz_m with qx, qy, qz, qw or with rx_rad, ry_rad, rz_rad, or as m00 to m33; in
YAML and JSON also base_T_ee: {translation_m, rotation_xyzw} or 4 x 4.  At each of three orientations
or more, better nine, the end-effector is shifted along three directions without turning: ten spots."""

_EXAMPLES = """\
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml --picture laser.png
  gripmon calibrate laser monday.csv tuesday.csv --camera camera.yaml --out laser.yaml --recording laser.rrd
  gripmon calibrate laser spots.yaml --camera camera.yaml --refine-lens --arm-noise 0.0001:0.0002 --out laser.yaml
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml --plan next.csv --reach 0.85

exit codes: 0 written; 2 wrong usage or files; 3 the spots can't be calibrated from, and why:
nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "laser", run, "a fixed camera, its plane and a laser pointer on the arm", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("data", nargs="+", metavar="DATA", help="table of samples: .csv, .yaml or .json")
    parser.add_argument(
        "--camera", required=True, metavar="CAMERA.yaml", help="the camera: a file of gripmon calibrate intrinsics"
    )
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument("--picture", metavar="FILE.png", help="also a picture of residuals and scene")
    parser.add_argument("--recording", metavar="FILE.rrd", help="also the scene as a rerun recording")
    parser.add_argument(
        "--refine-lens",
        action="store_true",
        help="estimate the lens, too, within its calibration's covariance; else it stays as it is, and what its "
        "covariance leaves open is in the result's",
    )
    parser.add_argument(
        "--arm-noise",
        type=common.arm_noise,
        metavar="M:RAD",
        help="standard deviations of the arm's poses, position (m) and rotation (rad), each axis (default: none)",
    )
    parser.add_argument("--plan", metavar="FILE.csv", help="also write which poses would help the most next; --reach")
    parser.add_argument("--poses", type=_count, default=10, metavar="N", help="how many are planned (default 10)")
    parser.add_argument("--reach", type=_reach, metavar="M", help="how far the arm reaches (m)")
    parser.add_argument("--force", action="store_true", help="replace files that are there")


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 200:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of poses; 1 to 200")
    return int(text)


def _reach(text: str) -> float:
    value = common.positive_number(text)
    if value > LONGEST_ARM_M:
        raise argparse.ArgumentTypeError(f"{text} m is no arm's reach (millimetres?); metres, e.g. 0.85")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate laser``."""
    from gripmon.daemon.config.calibrated import read_camera
    from gripmon.laser.api import PoseNoise, calibrate_laser
    from gripmon.laser.samples import plan_table

    out = Path(arguments.out)
    _check_outputs(arguments)
    camera = read_camera(Path(arguments.camera))
    with files.errors_of("laser"):
        found = calibrate_laser(
            [Path(name) for name in arguments.data],
            camera,
            refine_lens=arguments.refine_lens,
            arm_noise=None if arguments.arm_noise is None else PoseNoise(*arguments.arm_noise),
            progress=common.progress_bar,
        )
    for line in found.unseen:
        print(line, file=sys.stderr)
    with files.errors_of("laser --plan"):
        planned = None if arguments.plan is None else found.plan(arguments.reach, arguments.poses)
    written = found.document(_provenance(found, arguments))
    if arguments.picture is not None:
        files.write_picture(found.picture(), Path(arguments.picture))
    if arguments.recording is not None:
        _record(found, Path(arguments.recording))
    if planned is not None:
        files.write_bytes(plan_table(planned), Path(arguments.plan), "--plan")
    files.write_document(written, out)
    _report(written)
    if planned is not None:
        _report_plan(planned)
    print(f"written: {out}")
    return common.EXIT_DONE


def _check_outputs(arguments: argparse.Namespace) -> None:
    files.check_output(Path(arguments.out), force=arguments.force)
    if arguments.picture is not None:
        files.check_picture(Path(arguments.picture), force=arguments.force)
    if arguments.plan is not None and arguments.reach is None:
        raise InputError("--plan needs --reach: how far the arm reaches; metres")
    for option in ("recording", "plan"):
        if getattr(arguments, option) is not None:
            files.check_output(Path(getattr(arguments, option)), force=arguments.force, option=f"--{option}")


def _provenance(found: CalibratedLaser, arguments: argparse.Namespace) -> Provenance:
    from gripmon.laser.api import SEED
    from gripmon.model.provenance import provenance_of

    options = files.options_of(arguments, "camera", "out", "picture", "recording", "refine-lens", "arm-noise", "plan")
    if arguments.arm_noise is not None:
        options["--arm-noise"] = ":".join(f"{value:g}" for value in arguments.arm_noise)
    options |= {"--poses": arguments.poses if arguments.plan is not None else None}
    options |= files.options_of(arguments, "reach", "force")
    inputs = [*map(Path, arguments.data), Path(arguments.camera), *found.files]
    return provenance_of(files.command_line("laser", arguments.data, options), inputs, SEED)


def _record(found: CalibratedLaser, path: Path) -> None:
    from gripmon.record.write.laser_scene import write

    try:
        write(path, found.fit.refined, found.samples.base_T_ee, found.fit.uv_px)
    except OSError as error:
        raise common.not_writable(path, error, "--recording") from None


def _report_plan(planned: Plan) -> None:
    now, then = planned.sigmas[0], planned.sigmas[-1]
    print(
        f"camera's position known to {1e3 * now[0]:.2f} mm, after {len(planned.uv_px)} more to {1e3 * then[0]:.2f} mm; "
        f"rotation to {57.29578 * now[1]:.3f} deg, then {57.29578 * then[1]:.3f} deg"
    )


def _report(written: LaserCalibration) -> None:
    residuals, sigmas = written.residuals, written.sigmas
    print(
        f"{residuals.used} of {residuals.spots} spots at {residuals.orientations} orientations, RMS "
        f"{residuals.rms_px:.3f} px; seed {written.provenance.seed}"
    )
    for name in residuals.outliers:
        print(f"  left out: {name}")
    for line in written.warnings:
        print(f"  {line}")

    def shown(values: Any, keys: list[str], scale: float = 1.0) -> str:
        return ", ".join(f"{scale * v:.2f} ± {scale * sigmas[k]:.2f}" for v, k in zip(values, keys, strict=True))

    position = [f"base_T_cam.{axis}_m" for axis in "xyz"]
    turns = [f"base_T_cam.r{axis}_rad" for axis in "xyz"]
    print(f"camera in the base   {shown(written.base_T_cam.translation_m, position, 1e3)} mm")
    print("camera's rotation    ± " + ", ± ".join(f"{57.29578 * sigmas[key]:.3f}" for key in turns) + " deg")
    print(f"plane from camera    {shown([written.plane.distance_cam_m], ['plane.distance_m'], 1e3)} mm")
    tilts = ("plane.tilt_a_rad", "plane.tilt_b_rad", "laser.turn_a_rad", "laser.turn_b_rad")
    print("plane and beam tilt  ± " + ", ± ".join(f"{57.29578 * sigmas[key]:.3f}" for key in tilts) + " deg")
