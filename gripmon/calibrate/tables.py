"""Tables with a row for each pose of an arm (CSV, YAML or JSON), the notations of a pose, and the target's pose at each
of them, from columns or from the named images.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.foreign import FileValues, read_mapping
from gripmon.calibrate.plate_pose import plate_pose, pose_slopes
from gripmon.calibrate.robot_world import FARTHEST_M, check_target_scale
from gripmon.calibrate.sighting import CalibrationError, NotFound
from gripmon.model.csv_rows import csv_rows, read_text
from gripmon.model.errors import InputError, input_errors
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.images import check_size, image_in
from gripmon.model.progress import Progress, quiet
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, Target, TargetError, name_of, refuse_other_size, turns_alike

POSITION = ("tx_m", "ty_m", "tz_m")
QUATERNION = ("qx", "qy", "qz", "qw")
ROTATION_VECTOR = ("rx_rad", "ry_rad", "rz_rad")
MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
POSE_COLUMNS = (
    f"{', '.join(POSITION)} with {', '.join(QUATERNION)} (quaternion) or {', '.join(ROTATION_VECTOR)} (rotation "
    "vector), or m00 … m33 (4 x 4, row by row)"
)
_NESTED = "translation_m and rotation_xyzw, or 4 x 4 numbers"
_ORTHONORMAL = 1e-3
_TABLE = "a table of samples"
_SAMPLES = "samples: [{u_px, v_px, base_T_ee}, ...]"


def rows_of(path: Path) -> list[FileValues]:
    """A table's rows; their faults name the file and the row.  :class:`~gripmon.model.errors.InputError` for anything
    else.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".yaml", ".yml", ".json"):
        raise InputError(f"{path}: is not a table; a .csv, .yaml or .json file")
    if suffix == ".csv":
        return [FileValues(str(path), row, POSE_COLUMNS, f"{place}: ") for place, row in csv_rows(path, _TABLE)]
    if suffix == ".json":
        try:
            values = json.loads(read_text(path, _TABLE))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not JSON: {error}; a JSON file") from None
    else:
        values = read_mapping(str(path), read_text(path, _TABLE), _SAMPLES)
    samples = values.get("samples") if isinstance(values, dict) else values
    if not isinstance(samples, list) or not all(isinstance(sample, dict) for sample in samples):
        raise InputError(f"{path}: samples is not a list of samples; {_SAMPLES}")
    named = [{str(key): value for key, value in sample.items()} for sample in samples]
    return [FileValues(str(path), row, POSE_COLUMNS, f"sample {k}: ") for k, row in enumerate(named, 1)]


def pose_of(row: FileValues) -> Array:
    """``base_T_ee`` (4, 4) of a row, in any notation.  :class:`~gripmon.model.errors.InputError`."""
    if row.content.get("base_T_ee") is not None:
        return _nested(row)
    if any(key in row.content for key in MATRIX):
        return _rigid(row, np.array([row.number(key) for key in MATRIX]).reshape(4, 4))
    missing = [key for key in POSITION if key not in row.content]
    if missing:
        other = next((key for key in row.content if key.lower() in ("tx", "x", "x_mm", "tx_mm", "x_m")), None)
        found = f" (there is {other}: which unit?)" if other else ""
        raise row.fault("", f"has no column {missing[0]}{found}")
    shift = [row.number(key) for key in POSITION]
    if any(key in row.content for key in QUATERNION):
        return row.pose(shift, [row.number(key) for key in QUATERNION])
    if not any(key in row.content for key in ROTATION_VECTOR):
        raise row.fault("", "has no rotation")
    turn = np.array([row.number(key) for key in ROTATION_VECTOR])
    angle = float(np.linalg.norm(turn))
    if angle > 2.0 * np.pi * 1.01:
        raise row.fault("", f"turns by {angle:.4g} rad, more than once around (degrees?)", "radians")
    return make_transform(exp_rotation(turn), np.array(shift))


def _nested(row: FileValues) -> Array:
    """``{translation_m, rotation_xyzw}`` or a list of four lists of four."""
    if not isinstance(row.content["base_T_ee"], dict):
        return _rigid(row, np.reshape(row.numbers("base_T_ee", (16,), _NESTED), (4, 4)))
    pose = row.below("base_T_ee")
    if pose.content.keys() != {"translation_m", "rotation_xyzw"}:
        raise row.fault("base_T_ee", f"has the keys {', '.join(map(str, pose.content))}", _NESTED)
    return pose.pose(pose.numbers("translation_m", (3,), "3 numbers"), pose.numbers("rotation_xyzw", (4,), "4 numbers"))


def _rigid(row: FileValues, matrix: Array) -> Array:
    """A matrix (4, 4) that is a rigid transform."""
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        last = " ".join(f"{value:.4g}" for value in matrix[3])
        raise row.fault("", f"the last row of the 4 x 4 is {last}", "0 0 0 1 (is it transposed?)")
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > _ORTHONORMAL:
        wrong = f"the rotation is not orthonormal (off by {off:.2g})"
        raise row.fault("", wrong, "a rotation matrix, columns of length 1 that stand on each other")
    if np.linalg.det(rotation) < 0.0:
        raise row.fault("", "the rotation is left-handed (determinant -1)", "a right-handed frame")
    left, _, right = np.linalg.svd(rotation)
    return make_transform(left @ right, matrix[:3, 3])


def check_scale(base_T_ee: Array) -> None:
    """ValueError for poses (n, 4, 4) that no arm reaches."""
    far = float(np.median(np.linalg.norm(base_T_ee[:, :3, 3], axis=1)))
    if far > FARTHEST_M:
        raise ValueError(
            f"the end-effector is {far:.4g} m from the base (median), which no arm reaches: millimetres? metres"
        )


@dataclass(frozen=True, slots=True)
class ArmPoses:
    """``base_T_ee`` and ``cam_T_target`` (n, 4, 4) with ``names``.  If the targets were seen in ``images``, also the
    ``covariance`` (n, 6, 6) of their poses and ``common`` (n, 6, k), the effect of the camera's own errors on them;
    ``unseen``: images without the target, each with the reason.
    """

    names: tuple[str, ...]
    base_T_ee: Array
    cam_T_target: Array
    covariance: Array | None = None
    common: Array | None = None
    images: tuple[Path, ...] = ()
    unseen: tuple[str, ...] = ()


def read_arm_poses(
    tables: Sequence[Path],
    camera: GivenCamera | None = None,
    target: Target | None = None,
    progress: Progress = quiet,
    *,
    other_target: bool = False,
) -> ArmPoses:
    """All rows of all tables; rows that name images need the ``camera`` that took them and the ``target``.

    :class:`~gripmon.model.errors.InputError` for wrong tables, also for a ``target`` of the pattern of the camera's in
    another size, unless ``other_target`` confirms it; :class:`CalibrationError` if no image shows it.
    """
    if camera is not None and target is not None and not other_target:
        refuse_other_size(target, camera.target)
    named: list[tuple[str, Array]] = []
    given: list[Array] = []
    seen: list[tuple[Array, Array, Array]] = []
    images: list[Path] = []
    unseen: list[str] = []
    for path in tables:
        rows = rows_of(path)
        with progress(len(rows), "pose") as step:
            for row in rows:
                step()
                base_T_ee, own = pose_of(row), _of_target(row)
                if own is not None:
                    given.append(pose_of(own))
                else:
                    images.append(path.parent / _image_of(row))
                    try:
                        seen.append(_seen(images[-1], camera, target))
                    except CalibrationError as error:
                        unseen.append(f"{images[-1]}: {error}")
                        continue
                named.append((f"{path.name}, {row.path.rstrip(': ')}", base_T_ee))
    if not named:
        raise CalibrationError(f"none of {len(unseen)} images shows the target", unseen)
    if given and images:
        raise InputError(f"{tables[0]}: some rows have cam_ columns, others images; one or the other")
    names, arm = tuple(name for name, _ in named), np.stack([base_T_ee for _, base_T_ee in named])
    targets = np.stack(given or [pose for pose, _, _ in seen])
    with input_errors(str(tables[0])):
        check_scale(arm)
        check_target_scale(targets)
        _check_once(arm, targets, names)
    covariance, common = (np.stack([each[k] for each in seen]) if seen else None for k in (1, 2))
    return ArmPoses(names, arm, targets, covariance, common, tuple(images), tuple(unseen))


def _of_target(row: FileValues) -> FileValues | None:
    """The columns of the target's pose under the names of the arm's; None if there are none."""
    own = {key.removeprefix("cam_"): value for key, value in row.content.items() if key.startswith("cam_")}
    return FileValues(row.file, own, row.right, f"{row.path}cam_") if own else None


def _image_of(row: FileValues) -> str:
    if not row.content.get("image"):
        raise row.fault("", "has neither cam_tx_m … nor image", "the target's pose, or an image of it")
    return str(row.content["image"])


def _seen(path: Path, camera: GivenCamera | None, target: Target | None) -> tuple[Array, Array, Array]:
    if camera is None or target is None:
        raise InputError("images need --camera and --target; both of them")
    image = image_in(path)
    check_size(str(path), image, camera.lens.width_px, camera.lens.height_px)
    return target_pose(image, camera, target, str(path))


def target_pose(image: Image, camera: GivenCamera, target: Target, name: str = "") -> tuple[Array, Array, Array]:
    """The pose of a target in an image: ``cam_T_target`` (4, 4), its covariance (6, 6) for an exact camera, and the
    effect of the camera's own independent errors (6, k).  :class:`~gripmon.model.targets.TargetError` for a target
    without a unique orientation, :class:`CalibrationError` for an image that doesn't show it.
    """
    from gripmon.calibrate.detection import detect  # which takes longer to import than a table to read

    if turns_alike(target) > 1:
        raise TargetError(
            f"{name_of(target)}: an image of it doesn't tell which way up it is, so any pose may be turned by half; a "
            "charuco board, or a chequerboard with one even, one odd number of corners"
        )
    sight = detect(image, target, name)
    if isinstance(sight, NotFound):
        raise CalibrationError(sight.reason)
    count = target.columns * target.rows
    if not isinstance(target, Charuco) and len(sight) < count:
        raise CalibrationError(f"{len(sight)} of the target's {count} points; all of them, to tell which way up it is")
    if sight.turns != 1:
        raise CalibrationError("dark and light squares don't tell which way up the board is; a board in even light")
    pose, covariance, _ = plate_pose(camera.lens, sight)
    return pose, covariance, pose_slopes(camera, sight, pose)


def _check_once(arm: Array, target: Array, names: Sequence[str]) -> None:
    """Reject duplicate poses, which would make every uncertainty too small."""
    seen: dict[tuple[float, ...], str] = {}
    for hand, plate, name in zip(arm, target, names, strict=True):
        key = tuple(np.round(np.concatenate([hand.ravel(), plate.ravel()]), 9).tolist())
        first = seen.setdefault(key, name)
        if first is not name:
            raise ValueError(f"{name}: is the same pose as {first}; each pose once")
