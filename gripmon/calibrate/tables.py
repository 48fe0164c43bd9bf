"""Tables with a row for each pose of an arm (CSV, YAML or JSON), the notations of a pose, and the target's pose at each
of them, from columns or from the named images.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.foreign import as_number, read_mapping
from gripmon.calibrate.plate_pose import plate_pose, pose_slopes
from gripmon.calibrate.robot_world import FARTHEST_M, check_target_scale
from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
from gripmon.model.csv_rows import csv_rows, read_text
from gripmon.model.errors import InputError, input_errors
from gripmon.model.geometry import UNIT_TOLERANCE, exp_rotation, make_transform, rotation_from_xyzw
from gripmon.model.images import check_size, image_in
from gripmon.model.progress import Progress, quiet
from gripmon.model.records import Array, Image
from gripmon.model.targets import Chequerboard, Target, TargetError, name_of, refuse_other_size, tells_its_turn

Row = Mapping[str, Any]

POSITION = ("tx_m", "ty_m", "tz_m")
QUATERNION = ("qx", "qy", "qz", "qw")
ROTATION_VECTOR = ("rx_rad", "ry_rad", "rz_rad")
MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
POSE_COLUMNS = (
    f"{', '.join(POSITION)} with {', '.join(QUATERNION)} (quaternion) or {', '.join(ROTATION_VECTOR)} (rotation "
    "vector), or m00 … m33 (4 x 4, row by row)"
)
_ORTHONORMAL = 1e-3
_TABLE = "a table of samples"
_SAMPLES = "samples: [{u_px, v_px, base_T_ee}, ...]"


def rows_of(path: Path, right: str = _TABLE) -> tuple[list[dict[str, Any]], list[str]]:
    """A table's rows, and the place of each for messages; ``right``: what kind of table it should be.
    :class:`~gripmon.model.errors.InputError` for anything else.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".yaml", ".yml", ".json"):
        raise InputError(f"{path}: is not a table; a .csv, .yaml or .json file")
    if suffix == ".csv":
        places, rows = zip(*csv_rows(path, right), strict=True)
        return [*rows], [*places]
    if suffix == ".json":
        try:
            values = json.loads(read_text(path, right))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not JSON: {error}; a JSON file") from None
    else:
        values = read_mapping(str(path), read_text(path, right), _SAMPLES)
    samples = values.get("samples") if isinstance(values, dict) else values
    if not isinstance(samples, list) or not all(isinstance(sample, dict) for sample in samples):
        raise InputError(f"{path}: samples is not a list of samples; {_SAMPLES}")
    return samples, [f"sample {k + 1}" for k in range(len(samples))]


def numbers_of(row: Row, keys: Sequence[str], place: str) -> list[float]:
    """Finite numbers in a row's columns.  ValueError: what is wrong, and what would be right."""
    out = []
    for key in keys:
        value = row.get(key)
        if value in (None, ""):
            raise ValueError(f"{place}: has no {key}; a number")
        if (number := as_number(value)) is None:
            raise ValueError(f"{place}: {key} is {value!r}; a number")
        out.append(number)
    return out


def pose_of(row: Row, place: str) -> Array:
    """``base_T_ee`` (4, 4) of a row.  ValueError: what is wrong, and what would be right."""
    if row.get("base_T_ee") is not None:
        return _nested(row["base_T_ee"], place)
    if any(key in row for key in MATRIX):
        return checked_transform(np.array(numbers_of(row, MATRIX, place)).reshape(4, 4), place)
    missing = [key for key in POSITION if key not in row]
    if missing:
        other = next((key for key in row if key and key.lower() in ("tx", "x", "x_mm", "tx_mm", "x_m")), None)
        found = f" (there is {other}: which unit?)" if other else ""
        raise ValueError(f"{place}: has no column {missing[0]}{found}; {POSE_COLUMNS}")
    position = np.array(numbers_of(row, POSITION, place))
    if any(key in row for key in QUATERNION):
        return make_transform(_from_quaternion(numbers_of(row, QUATERNION, place), place), position)
    if any(key in row for key in ROTATION_VECTOR):
        return make_transform(_from_vector(numbers_of(row, ROTATION_VECTOR, place), place), position)
    raise ValueError(f"{place}: has no rotation; {POSE_COLUMNS}")


def _nested(value: Any, place: str) -> Array:
    """``{translation_m, rotation_xyzw}`` or a list of four lists of four."""
    if isinstance(value, Mapping):
        unknown = set(value) - {"translation_m", "rotation_xyzw"}
        if unknown or len(value) != 2:
            raise ValueError(
                f"{place}: base_T_ee has the keys {', '.join(map(str, value))}; translation_m and rotation_xyzw"
            )
        position = _list(value["translation_m"], 3, f"{place}: base_T_ee.translation_m")
        rotation = _list(value["rotation_xyzw"], 4, f"{place}: base_T_ee.rotation_xyzw")
        return make_transform(_from_quaternion(rotation, place), np.array(position))
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError(f"{place}: base_T_ee is not a transform; translation_m and rotation_xyzw, or 4 x 4 numbers")
    lines = [_list(line, 4, f"{place}: a row of base_T_ee") for line in value]
    return checked_transform(np.array(lines), place)


def _list(value: Any, count: int, what: str) -> list[float]:
    numbers = [as_number(v) for v in value] if isinstance(value, list) else []
    found = [number for number in numbers if number is not None]
    if len(numbers) != count or len(found) != count:
        raise ValueError(f"{what} is {value!r}; {count} numbers")
    return found


def _from_quaternion(quaternion: Sequence[float], place: str) -> Array:
    length = math.sqrt(sum(q * q for q in quaternion))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        hint = " (degrees?)" if max(abs(q) for q in quaternion) > 1.5 else ""
        raise ValueError(
            f"{place}: the quaternion {_shown(quaternion)} has the length {length:.4g}{hint}; a unit quaternion x y z w"
        )
    x, y, z, w = quaternion
    return rotation_from_xyzw((x, y, z, w))


def _from_vector(vector: Sequence[float], place: str) -> Array:
    angle = math.sqrt(sum(v * v for v in vector))
    if angle > 2.0 * math.pi * 1.01:
        raise ValueError(
            f"{place}: the rotation vector {_shown(vector)} turns by {angle:.4g} rad, more than once around: degrees? "
            "radians"
        )
    return exp_rotation(np.array(vector))


def checked_transform(matrix: Array, place: str) -> Array:
    """A matrix (4, 4) that is a rigid transform; ValueError otherwise."""
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise ValueError(f"{place}: the last row of the 4 x 4 is {_shown(matrix[3])}; 0 0 0 1 (is it transposed?)")
    rotation = matrix[:3, :3]
    fault = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if fault > _ORTHONORMAL:
        raise ValueError(
            f"{place}: the rotation is not orthonormal (off by {fault:.2g}); a rotation matrix, columns of length 1 "
            "that stand on each other"
        )
    if np.linalg.det(rotation) < 0.0:
        raise ValueError(f"{place}: the rotation is left-handed (determinant -1); a right-handed frame")
    left, _, right = np.linalg.svd(rotation)
    return make_transform(left @ right, matrix[:3, 3])


def check_scale(base_T_ee: Array) -> None:
    """ValueError for poses (n, 4, 4) that no arm reaches."""
    far = float(np.median(np.linalg.norm(base_T_ee[:, :3, 3], axis=1)))
    if far > FARTHEST_M:
        raise ValueError(
            f"the end-effector is {far:.4g} m from the base (median), which no arm reaches: millimetres? metres"
        )


def _shown(values: Any) -> str:
    return " ".join(f"{float(v):.4g}" for v in values)


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


@dataclass(slots=True)
class _Found:
    names: list[str] = field(default_factory=list)
    arm: list[Array] = field(default_factory=list)
    target: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    common: list[Array] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)


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
    found = _Found()
    for path in tables:
        rows, places = rows_of(path)
        with progress(len(rows), "pose") as step:
            for row, place in zip(rows, places, strict=True):
                step()
                try:
                    _take(found, path, row, place, camera, target)
                except InputError:
                    raise
                except ValueError as error:
                    raise InputError(f"{path}: {error}") from None
    if not found.arm:
        raise CalibrationError(f"none of {len(found.unseen)} images shows the target", found.unseen)
    if found.covariances and len(found.covariances) < len(found.arm):
        raise InputError(f"{tables[0]}: some rows have cam_ columns, others images; one or the other")
    arm, targets = np.stack(found.arm), np.stack(found.target)
    with input_errors(str(tables[0])):
        check_scale(arm)
        check_target_scale(targets)
        _check_once(arm, targets, found.names)
    covariance, common = (np.stack(each) if each else None for each in (found.covariances, found.common))
    return ArmPoses(tuple(found.names), arm, targets, covariance, common, tuple(found.images), tuple(found.unseen))


def _take(found: _Found, table: Path, row: Row, place: str, camera: GivenCamera | None, target: Target | None) -> None:
    hand = pose_of(row, place)
    own = {key.removeprefix("cam_"): value for key, value in row.items() if key.startswith("cam_")}
    if own:
        found.target.append(pose_of(own, f"{place}, cam_"))
    else:
        if not row.get("image"):
            raise ValueError(f"{place}: has neither cam_tx_m … nor image; the target's pose, or an image of it")
        if camera is None or target is None:
            raise InputError("images need --camera and --target; both of them")
        path = table.parent / str(row["image"])
        found.images.append(path)
        image = image_in(path)
        check_size(str(path), image, camera.lens.width_px, camera.lens.height_px)
        try:
            pose, covariance, common = target_pose(image, camera, target, str(path))
        except CalibrationError as error:
            found.unseen.append(f"{path}: {error}")
            return
        found.target.append(pose)
        found.covariances.append(covariance)
        found.common.append(common)
    found.arm.append(hand)
    found.names.append(f"{table.name}, {place}")


def target_pose(image: Image, camera: GivenCamera, target: Target, name: str = "") -> tuple[Array, Array, Array]:
    """The pose of a target in an image: ``cam_T_target`` (4, 4), its covariance (6, 6) for an exact camera, and the
    effect of the camera's own independent errors (6, k).  :class:`~gripmon.model.targets.TargetError` for a target
    without a unique orientation, :class:`CalibrationError` for an image that doesn't show it.
    """
    from gripmon.calibrate.detection import detect, upright  # which takes longer to import than a table to read

    if not tells_its_turn(target):
        raise TargetError(
            f"{name_of(target)}: an image of it doesn't tell which way up it is, so any pose may be turned by half; a "
            "charuco board, or a chequerboard with one even, one odd number of corners"
        )
    sight = detect(image, target, name)
    if isinstance(sight, Sighting) and isinstance(target, Chequerboard):
        sight = upright(image, sight, target)
    if isinstance(sight, NotFound):
        raise CalibrationError(sight.reason)
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
