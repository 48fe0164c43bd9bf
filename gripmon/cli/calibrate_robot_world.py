"""``gripmon calibrate robot-world``: a camera and an arm from poses of a target, by Dornaika and Horaud's method."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.robot_world import RobotWorld
    from gripmon.calibrate.robot_world_document import RobotWorldCalibration
    from gripmon.laser.pointer.samples import Row
    from gripmon.model.records import Array

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
    import numpy as np

    from gripmon.calibrate import robot_world
    from gripmon.calibrate.robot_world_doubts import check_reading
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.model.geometry import invert

    out = Path(arguments.out)
    files.check_output(out, force=arguments.force)
    poses = _poses(arguments)
    arm = np.stack([invert(T) for T in poses.base_T_ee]) if arguments.eye_in_hand else poses.base_T_ee
    try:
        start = robot_world.solve(poses.cam_T_target, arm)
        found = robot_world.refine(poses.cam_T_target, arm, start, poses.covariance, inexact_arm=True)
        check_reading(found, poses.cam_T_target, arm)
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate robot-world: {error}") from None
    written = _document(found, poses, arguments)
    files.write_document(written, out)
    _report(written)
    print(f"written: {out}")
    return common.EXIT_DONE


class _Poses:
    """Poses of arm and target (n, 4, 4), names, files; covariances (n, 6, 6) where all targets were seen in images."""

    def __init__(self, base_T_ee: Array, cam_T_target: Array, covariance: Array | None):
        self.base_T_ee, self.cam_T_target, self.covariance = base_T_ee, cam_T_target, covariance
        self.names: list[str] = []
        self.inputs: list[Path] = []


def _poses(arguments: argparse.Namespace) -> _Poses:
    import numpy as np

    from gripmon.calibrate.robot_world_doubts import check_target_scale
    from gripmon.cli.laser_tables import rows_of
    from gripmon.laser.pointer.samples import check_scale, pose_of

    arm: list[Array] = []
    target, covariances, names = [], [], []
    inputs = [Path(name) for name in arguments.data]
    seer = _Seer(arguments)
    for path in list(inputs):
        rows, places = rows_of(path)
        with common.progress_bar(len(rows), "pose") as step:
            for row, place in zip(rows, places, strict=True):
                step()
                try:
                    hand = pose_of(row, place)
                    own = {key.removeprefix("cam_"): value for key, value in row.items() if key.startswith("cam_")}
                    if own:
                        target.append(pose_of(own, f"{place}, cam_"))
                    else:
                        seen = seer.see(path, row, place)
                        if seen is None:
                            continue
                        target.append(seen[0])
                        covariances.append(seen[1])
                except ValueError as error:
                    raise common.CommandFailedError(f"{path}: {error}", common.EXIT_USAGE) from None
                arm.append(hand)
                names.append(f"{path.name}, {place}")
    for line in seer.unseen:
        print(line, file=sys.stderr)
    if not arm:
        raise common.CommandFailedError(f"calibrate robot-world: none of {len(seer.unseen)} images shows the target")
    if covariances and len(covariances) < len(arm):
        raise common.CommandFailedError(
            f"{inputs[0]}: some rows have cam_ columns, others images; one or the other", common.EXIT_USAGE
        )
    try:
        check_scale(np.stack(arm))
        check_target_scale(np.stack(target))
        _check_once(arm, target, names)
    except ValueError as error:
        raise common.CommandFailedError(f"{inputs[0]}: {error}", common.EXIT_USAGE) from None
    poses = _Poses(np.stack(arm), np.stack(target), np.stack(covariances) if covariances else None)
    poses.names, poses.inputs = names, [*inputs, *seer.files]
    return poses


def _check_once(arm: list[Array], target: list[Array], names: list[str]) -> None:
    """The same pose twice would make every uncertainty too small."""
    import numpy as np

    seen: dict[tuple[float, ...], str] = {}
    for hand, plate, name in zip(arm, target, names, strict=True):
        key = tuple(np.round(np.concatenate([hand.ravel(), plate.ravel()]), 9).tolist())
        first = seen.setdefault(key, name)
        if first is not name:
            raise ValueError(f"{name}: is the same pose as {first}; each pose once")


class _Seer:
    """Finds the target in images; ``unseen`` says where it doesn't, and why."""

    def __init__(self, arguments: argparse.Namespace):
        self.files: list[Path] = []
        self.unseen: list[str] = []
        self._arguments = arguments
        self._camera: Any = None
        self._target: Any = None

    def see(self, table: Path, row: Row, place: str) -> tuple[Array, Array] | None:
        """``cam_T_target`` and its covariance, None if the image doesn't show it; what is wrong ends the command."""
        from gripmon.calibrate.detection import detect
        from gripmon.calibrate.intrinsics import plate_pose
        from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
        from gripmon.calibrate.upright import upright
        from gripmon.io.sources.folder import read_image
        from gripmon.model.targets import Chequerboard

        if not row.get("image"):
            raise ValueError(f"{place}: has neither cam_tx_m … nor image; the target's pose, or an image of it")
        self._prepare()
        path = table.parent / str(row["image"])
        self.files.append(path)
        image, fault = read_image(path)
        if image is None:
            raise common.CommandFailedError(f"{path}: {fault}; an image file", common.EXIT_USAGE)
        if (image.shape[1], image.shape[0]) != (self._camera.width_px, self._camera.height_px):
            raise common.CommandFailedError(
                f"{path}: is {image.shape[1]} x {image.shape[0]} px, the camera {self._camera.width_px} x "
                f"{self._camera.height_px}; images of this camera",
                common.EXIT_USAGE,
            )
        sight = detect(image, self._target, str(path))
        if isinstance(sight, Sighting) and isinstance(self._target, Chequerboard):
            sight = upright(image, sight, self._target)
        if isinstance(sight, NotFound):
            self.unseen.append(f"{path}: {sight.reason}")
            return None
        try:
            pose, covariance, _ = plate_pose(self._camera, sight)
        except CalibrationError as error:
            self.unseen.append(f"{path}: {error}")
            return None
        return pose, covariance

    def _prepare(self) -> None:
        from gripmon.daemon.config.calibrated import read_camera
        from gripmon.daemon.config.errors import ConfigError
        from gripmon.model.targets import tells_its_turn

        if self._camera is not None:
            return
        if self._arguments.camera is None or self._arguments.target is None:
            raise common.CommandFailedError("images need --camera and --target; both of them", common.EXIT_USAGE)
        try:
            self._camera = read_camera(Path(self._arguments.camera)).camera
        except ConfigError as error:
            raise common.CommandFailedError(f"--camera: {error}", common.EXIT_USAGE) from None
        self._target = files.target_of(self._arguments.target)
        if not tells_its_turn(self._target):
            raise common.CommandFailedError(
                f"--target {self._arguments.target}: an image of it doesn't tell which way up it is, so any pose may "
                "be turned by half; a charuco board, or a chequerboard with one even, one odd number of corners",
                common.EXIT_USAGE,
            )
        self.files.append(Path(self._arguments.camera))


def _document(found: RobotWorld, poses: _Poses, arguments: argparse.Namespace) -> RobotWorldCalibration:
    import numpy as np

    from gripmon.calibrate.robot_world_document import RobotWorldCalibration, RobotWorldResiduals
    from gripmon.model.geometry import invert, to_record
    from gripmon.model.provenance import provenance_of

    first, second, inverse = (
        ("cam_T_ee", "base_T_target", "ee_T_cam") if arguments.eye_in_hand else
        ("cam_T_base", "ee_T_target", "base_T_cam")
    )  # fmt: skip
    axes = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    names = tuple(f"{transform}.{axis}" for transform in (first, second) for axis in axes)
    options = {
        "--camera": arguments.camera, "--target": arguments.target, "--eye-in-hand": arguments.eye_in_hand,
        "--out": arguments.out, "--force": arguments.force,
    }  # fmt: skip
    return RobotWorldCalibration(
        transforms={
            first: to_record(found.cam_T_base),
            second: to_record(found.ee_T_target),
            inverse: to_record(invert(found.cam_T_base)),
        },
        parameters=names,
        sigmas=dict(zip(names, np.sqrt(found.covariance.diagonal()).tolist(), strict=True)),
        covariance=tuple(found.covariance.ravel().tolist()),
        residuals=RobotWorldResiduals(
            rms_m=found.rms_m,
            rms_rad=found.rms_rad,
            poses=len(poses.names),
            used=int(found.used.sum()),
            outliers=tuple(name for name, used in zip(poses.names, found.used, strict=True) if not used),
        ),
        provenance=provenance_of(files.command_line("robot-world", arguments.data, options), poses.inputs),
    )


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
