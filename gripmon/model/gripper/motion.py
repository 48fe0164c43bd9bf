"""Finger motion with the jaws, as a table over the opening."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec
import numpy as np

from gripmon.model.gripper.model import AxisMotion, GripperError, JawModel, TableMotion
from gripmon.model.records import Array

_T = TypeVar("_T")

ARC_RADIUS_M = 0.05
"""Radius of the arc on which fingers of adaptive grippers move, whose links are 50 to 60 mm long."""


def motion_table(name: str, motion: dict[str, Any] | None, jaw: JawModel | None) -> Array:
    """Table (rows, 4) of opening and offset; an axis becomes a table with its two ends."""
    if motion is None:
        return np.zeros((1, 4))
    key = f"fingers.{name}.motion"
    if jaw is None:
        raise GripperError(f"{key}: the gripper has no jaw; a section `jaw` with nominal_m, min_m, max_m")
    if set(motion) == {"axis"}:
        axis = np.array(_convert(motion, AxisMotion, key).axis)
        if not np.isfinite(axis).all():
            raise GripperError(f"{key}.axis: holds a value that is not finite; three ordinary numbers")
        if jaw.min_m == jaw.max_m:
            return np.zeros((1, 4))
        ends = np.array([jaw.min_m, jaw.max_m])
        return np.column_stack([ends, (ends - jaw.nominal_m)[:, None] * axis])
    if set(motion) != {"table"}:
        raise GripperError(f"{key}: has the keys {', '.join(motion) or 'none'}; either `axis` or `table`")
    table = np.array(_convert(motion, TableMotion, key).table)
    if not np.isfinite(table).all():
        raise GripperError(f"{key}.table: holds a value that is not finite; ordinary numbers")
    if not (np.diff(table[:, 0]) > 0.0).all():
        raise GripperError(f"{key}.table: openings don't ascend; rows sorted by opening_m")
    if not table[0, 0] - 1e-9 <= jaw.nominal_m <= table[-1, 0] + 1e-9:
        raise GripperError(f"{key}.table: covers {table[0, 0]} to {table[-1, 0]} m; jaw.nominal_m within it")
    if np.abs(offset_m(table, jaw.nominal_m)).max() > 1e-6:
        raise GripperError(f"{key}.table: the finger is not at rest at jaw.nominal_m; an offset of zero there")
    return table


def offset_m(table: Array, opening_m: float) -> Array:
    """Offset (3,) of a finger in the gripper frame at an opening; beyond the table it goes on straight."""
    if len(table) == 1:
        return table[0, 1:]
    last = len(table) - 2
    k = min(max(int(table[:, 0].searchsorted(opening_m, "right")) - 1, 0), last) if last else 0
    low, high = table[k], table[k + 1]
    return np.asarray(low[1:] + (opening_m - low[0]) / (high[0] - low[0]) * (high[1:] - low[1:]))


def beyond_table_m(table: Array, opening_m: float) -> float:
    """How far a finger may be off its straight way beyond the table: as far as a circle of :data:`ARC_RADIUS_M` leaves
    its chord, the finger's way over the table, at that distance; 0 within the table.
    """
    first, last = table[0], table[-1]
    over_m = max(first[0] - opening_m, opening_m - last[0], 0.0)
    if len(table) == 1 or over_m == 0.0:
        return 0.0
    travel_m = float(np.linalg.norm(last[1:] - first[1:]))
    more_m = travel_m * over_m / (last[0] - first[0])
    return float(more_m * (more_m + travel_m) / (2.0 * ARC_RADIUS_M))


def _convert(value: Any, kind: type[_T], key: str) -> _T:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise GripperError(f"{key}: {error}") from None
