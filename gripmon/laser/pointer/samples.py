"""Samples of the laser-pointer method from rows of a table: spots or images, and the poses that they were seen at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gripmon.model.geometry import exp_rotation, make_transform, rotation_from_xyzw
from gripmon.model.records import Array

Row = Mapping[str, Any]

POSITION = ("tx_m", "ty_m", "tz_m")
QUATERNION = ("qx", "qy", "qz", "qw")
ROTATION_VECTOR = ("rx_rad", "ry_rad", "rz_rad")
MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
POSE_COLUMNS = (
    f"{', '.join(POSITION)} with {', '.join(QUATERNION)} (quaternion) or {', '.join(ROTATION_VECTOR)} (rotation "
    "vector), or m00 … m33 (4 x 4, row by row)"
)
_UNIT = 1e-2
_ORTHONORMAL = 1e-3
_FARTHEST_M = 20.0
"""No arm reaches farther from its base: such numbers are millimetres."""


@dataclass(frozen=True, slots=True)
class Samples:
    """``names`` of n samples; ``uv_px`` (n, 2), NaN where an image is to be looked at; ``images`` and ``laser_off``,
    file names or None; ``base_T_ee`` (n, 4, 4); ``groups`` (n,) labels of orientations, or None: the poses tell them.
    """

    names: tuple[str, ...]
    uv_px: Array
    images: tuple[str | None, ...]
    laser_off: tuple[str | None, ...]
    base_T_ee: Array
    groups: tuple[str, ...] | None

    def __len__(self) -> int:
        return len(self.names)


def from_rows(rows: Sequence[Row], places: Sequence[str]) -> Samples:
    """``places`` say where each row stands.  ValueError: "place: what is wrong; what would be right"."""
    if not rows:
        raise ValueError("holds no sample; a row for each spot, better 50 of them")
    uv_px = np.array([_spot(row, place) for row, place in zip(rows, places, strict=True)])
    base_T_ee = np.stack([pose_of(row, place) for row, place in zip(rows, places, strict=True)])
    check_scale(base_T_ee)
    named = [row.get("group") not in (None, "") for row in rows]
    if any(named) and not all(named):
        raise ValueError(f"{places[named.index(False)]}: has no group, others have; a group for every row, or for none")
    images = tuple(_text(row.get("image")) for row in rows)
    _check_different(uv_px, base_T_ee, images, places)
    return Samples(
        names=tuple(image or place for image, place in zip(images, places, strict=True)),
        uv_px=uv_px,
        images=images,
        laser_off=tuple(_text(row.get("laser_off")) for row in rows),
        base_T_ee=base_T_ee,
        groups=tuple(str(row["group"]) for row in rows) if all(named) else None,
    )


def joined(parts: Sequence[Samples], sources: Sequence[str]) -> Samples:
    """Several tables as one; groups of different tables are different, poses of one orientation are not."""
    grouped = [part.groups is not None for part in parts]
    if any(grouped) and not all(grouped):
        raise ValueError(f"{sources[grouped.index(False)]}: has no groups, other files have; all or none of them")
    groups = [f"{k}/{g}" for k, part in enumerate(parts) for g in (part.groups or ())]
    return Samples(
        names=tuple(name for part in parts for name in part.names),
        uv_px=np.concatenate([part.uv_px for part in parts]),
        images=tuple(i for part in parts for i in part.images),
        laser_off=tuple(i for part in parts for i in part.laser_off),
        base_T_ee=np.concatenate([part.base_T_ee for part in parts]),
        groups=tuple(groups) if all(grouped) else None,
    )


def picked(samples: Samples, kept: Sequence[int]) -> Samples:
    """Those samples only."""
    return Samples(
        names=tuple(samples.names[k] for k in kept),
        uv_px=samples.uv_px[list(kept)],
        images=tuple(samples.images[k] for k in kept),
        laser_off=tuple(samples.laser_off[k] for k in kept),
        base_T_ee=samples.base_T_ee[list(kept)],
        groups=None if samples.groups is None else tuple(samples.groups[k] for k in kept),
    )


def _text(value: Any) -> str | None:
    return None if value is None or str(value).strip() == "" else str(value).strip()


def _spot(row: Row, place: str) -> tuple[float, float]:
    spot = [row.get("u_px"), row.get("v_px")]
    if all(value not in (None, "") for value in spot):
        u, v = _numbers(row, ("u_px", "v_px"), place)
        return u, v
    if _text(row.get("image")) is None:
        raise ValueError(f"{place}: has neither u_px and v_px nor image; the spot in pixels, or the image file's name")
    return math.nan, math.nan


def _numbers(row: Row, keys: Sequence[str], place: str) -> list[float]:
    out = []
    for key in keys:
        value = row.get(key)
        if value in (None, ""):
            raise ValueError(f"{place}: has no {key}; a number")
        try:
            number = float(value) if not isinstance(value, bool) else math.nan
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(f"{place}: {key} is {value!r}; a number")
        out.append(number)
    return out


def pose_of(row: Row, place: str) -> Array:
    """``base_T_ee`` (4, 4) of a row.  ValueError: what is wrong, and what would be right."""
    if row.get("base_T_ee") is not None:
        return _nested(row["base_T_ee"], place)
    if any(key in row for key in MATRIX):
        return checked_transform(np.array(_numbers(row, MATRIX, place)).reshape(4, 4), place)
    missing = [key for key in POSITION if key not in row]
    if missing:
        other = next((key for key in row if key and key.lower() in ("tx", "x", "x_mm", "tx_mm", "x_m")), None)
        found = f" (there is {other}: which unit?)" if other else ""
        raise ValueError(f"{place}: has no column {missing[0]}{found}; {POSE_COLUMNS}")
    position = np.array(_numbers(row, POSITION, place))
    if any(key in row for key in QUATERNION):
        return make_transform(_from_quaternion(_numbers(row, QUATERNION, place), place), position)
    if any(key in row for key in ROTATION_VECTOR):
        return make_transform(_from_vector(_numbers(row, ROTATION_VECTOR, place), place), position)
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
        raise ValueError(f"{place}: base_T_ee is no transform; translation_m and rotation_xyzw, or 4 x 4 numbers")
    lines = [_list(line, 4, f"{place}: a row of base_T_ee") for line in value]
    return checked_transform(np.array(lines), place)


def _list(value: Any, count: int, what: str) -> list[float]:
    good = isinstance(value, list) and len(value) == count
    if not good or not all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in value):
        raise ValueError(f"{what} is {value!r}; {count} numbers")
    return [float(v) for v in value]


def _from_quaternion(quaternion: Sequence[float], place: str) -> Array:
    length = math.sqrt(sum(q * q for q in quaternion))
    if abs(length - 1.0) > _UNIT:
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
    """A matrix (4, 4) that is a rigid motion; ValueError for one that isn't."""
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
    if far > _FARTHEST_M:
        raise ValueError(
            f"the end-effector is {far:.4g} m from the base (median), which no arm reaches: millimetres? metres"
        )


def _check_different(uv_px: Array, base_T_ee: Array, images: Sequence[str | None], places: Sequence[str]) -> None:
    """The same sample twice would make every uncertainty too small."""
    seen: dict[tuple[Any, ...], str] = {}
    for uv, pose, image, place in zip(uv_px, base_T_ee, images, places, strict=True):
        key = (image, *np.round(pose, 9).ravel().tolist(), *([] if np.isnan(uv).any() else uv.tolist()))
        first = seen.setdefault(key, place)
        if first is not place:
            raise ValueError(f"{place}: is the same sample as {first}; each sample once")


def _shown(values: Any) -> str:
    return " ".join(f"{float(v):.4g}" for v in values)
