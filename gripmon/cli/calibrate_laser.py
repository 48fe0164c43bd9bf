"""``gripmon calibrate laser``: a fixed camera, its plane and a laser pointer on the arm, from spots and poses."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.documents import CameraCalibration
    from gripmon.laser.pointer.calibrating import LaserResult, Spots
    from gripmon.laser.pointer.document import LaserCalibration
    from gripmon.laser.pointer.planning import Plan
    from gripmon.laser.pointer.samples import Samples
    from gripmon.laser.pointer.spot_problem import LensPrior, PoseNoise
    from gripmon.model.records import Array

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
    out = Path(arguments.out)
    files.check_output(out, force=arguments.force)
    if arguments.picture is not None:
        files.check_picture(Path(arguments.picture), force=arguments.force)
    if arguments.recording is not None:
        files.check_output(Path(arguments.recording), force=arguments.force, option="--recording")
    if arguments.plan is not None:
        if arguments.reach is None:
            raise common.CommandFailedError("--plan needs --reach: how far the arm reaches; metres", common.EXIT_USAGE)
        files.check_output(Path(arguments.plan), force=arguments.force, option="--plan")
    calibration = _camera(arguments.camera)
    samples, spots, inputs, notes = _data(arguments, calibration)
    prior = _prior(calibration, arguments)
    if prior is None:
        notes = (*notes, f"{arguments.camera} says nothing of the camera's errors: it counts as exact")
    result = _calibrated(calibration, prior, samples, spots, arguments)
    written = _document(result, samples, notes, inputs, arguments)
    planned = _planned(result, arguments)
    if arguments.picture is not None:
        from gripmon.laser.pointer.picture import draw

        files.write_picture(draw(result, samples.base_T_ee, written), Path(arguments.picture))
    if arguments.recording is not None:
        _record(result, samples.base_T_ee, Path(arguments.recording))
    if planned is not None:
        from gripmon.cli.laser_tables import write_plan

        write_plan(planned, Path(arguments.plan))
    files.write_document(written, out)
    _report(written)
    if planned is not None:
        _report_plan(planned)
    print(f"written: {out}")
    return common.EXIT_DONE


def _camera(name: str) -> CameraCalibration:
    from gripmon.daemon.config.calibrated import read_camera
    from gripmon.daemon.config.errors import ConfigError

    try:
        return read_camera(Path(name))
    except ConfigError as error:
        raise common.CommandFailedError(f"--camera: {error}", common.EXIT_USAGE) from None


def _data(
    arguments: argparse.Namespace, calibration: CameraCalibration
) -> tuple[Samples, Spots, list[Path], tuple[str, ...]]:
    """Samples that have a spot, their spots, all input files, and what is to be noted."""
    from gripmon.cli import laser_tables
    from gripmon.laser.pointer.samples import picked

    paths = [Path(name) for name in arguments.data]
    samples, origins = laser_tables.read_tables(paths)
    size_px = (calibration.camera.width_px, calibration.camera.height_px)
    spots, kept, missing = laser_tables.find_spots(samples, origins, size_px)
    for line in missing:
        print(line, file=sys.stderr)
    if not kept:
        raise common.CommandFailedError(f"calibrate laser: none of {len(samples)} images shows a spot")
    inputs = [*paths, Path(arguments.camera), *laser_tables.image_files(samples, origins)]
    return picked(samples, kept), spots, inputs, tuple(missing)


def _calibrated(
    calibration: CameraCalibration,
    prior: LensPrior | None,
    samples: Samples,
    spots: Spots,
    arguments: argparse.Namespace,
) -> LaserResult:
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.laser.pointer.calibrating import calibrate
    from gripmon.model.camera import make_camera

    try:
        camera = make_camera(calibration.camera)
    except ValueError as error:
        raise common.CommandFailedError(f"--camera {arguments.camera}: {error}", common.EXIT_USAGE) from None
    try:
        return calibrate(
            camera,
            samples.base_T_ee,
            spots,
            samples.groups,
            lens=prior,
            refine_lens=arguments.refine_lens,
            pose_noise=_noise(arguments.arm_noise),
        )
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate laser: {error}") from None


def _noise(given: tuple[float, float] | None) -> PoseNoise | None:
    from gripmon.laser.pointer.spot_problem import PoseNoise

    return None if given is None else PoseNoise(*given)


def _prior(calibration: CameraCalibration, arguments: argparse.Namespace) -> LensPrior | None:
    """What the camera's file knows of its lens; None where it says nothing of its errors."""
    import numpy as np

    from gripmon.calibrate.intrinsics import lens_vector, model_of
    from gripmon.calibrate.lens_models import LensModel, parameter_names
    from gripmon.laser.pointer.spot_problem import LensPrior

    camera = calibration.camera
    count = len(calibration.parameters)
    kind = model_of(camera)
    names, values = parameter_names(kind), lens_vector(camera)
    unknown = [key for key in calibration.parameters if key not in names]
    if count == 0 or unknown or len(values) != len(names):
        if not arguments.refine_lens:
            return None
        raise common.CommandFailedError(
            f"--refine-lens: {arguments.camera} has no covariance of parameters that can be refined; a file of gripmon "
            "calibrate intrinsics",
            common.EXIT_USAGE,
        )
    free = tuple(names.index(key) for key in calibration.parameters)
    model = LensModel(kind, camera.width_px, camera.height_px)
    return LensPrior(model, values, free, np.array(calibration.covariance).reshape(count, count))


def _document(
    result: LaserResult, samples: Samples, notes: tuple[str, ...], inputs: list[Path], arguments: argparse.Namespace
) -> LaserCalibration:
    from gripmon.laser.pointer.calibrating import groups_of
    from gripmon.laser.pointer.document import document
    from gripmon.laser.pointer.planar_start import SEED
    from gripmon.model.provenance import provenance_of

    noise = None if arguments.arm_noise is None else ":".join(f"{value:g}" for value in arguments.arm_noise)
    options = {
        "--camera": arguments.camera, "--out": arguments.out, "--picture": arguments.picture,
        "--recording": arguments.recording, "--refine-lens": arguments.refine_lens, "--arm-noise": noise,
        "--plan": arguments.plan, "--poses": arguments.poses if arguments.plan is not None else None,
        "--reach": arguments.reach, "--force": arguments.force,
    }  # fmt: skip
    provenance = provenance_of(files.command_line("laser", arguments.data, options), inputs, SEED)
    other = [name for name, k in zip(samples.names, result.candidate, strict=True) if k > 0]
    if other:
        notes = (*notes, f"not the brightest place but another one is the spot in: {', '.join(other)}")
    orientations = len(groups_of(samples.groups, samples.base_T_ee))
    return document(result.refined, samples.names, orientations, (*notes, *result.warnings), provenance)


def _record(result: LaserResult, base_T_ee: Array, path: Path) -> None:
    from gripmon.record.write.laser_scene import write

    try:
        write(path, result.refined, base_T_ee, result.uv_px)
    except OSError as error:
        raise common.not_writable(path, error, "--recording") from None


def _planned(result: LaserResult, arguments: argparse.Namespace) -> Plan | None:
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.laser.pointer.planning import Arm, plan

    if arguments.plan is None:
        return None
    try:
        return plan(result.refined, Arm(arguments.reach), arguments.poses)
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate laser --plan: {error}") from None


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
