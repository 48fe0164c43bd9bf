"""How the fingers of a CAD model move with the jaws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gripmon.model.errors import InputError
from gripmon.model.gripper import JawModel
from gripmon.model.records import Array
from gripmon.teach.cad.surface import Surface

STRAIGHT_M = 1e-6
"""Largest deviation from a line of a finger that moves along an axis; with a larger one it gets a table."""


@dataclass(frozen=True, slots=True)
class Jaw:
    """The gripper file's jaw section, and each finger's ``motion``."""

    model: JawModel
    motion: dict[str, dict[str, Any]]


def jaw_of(
    fingers: Mapping[str, Surface],
    paths_m: Sequence[Array],
    jaw_range_m: tuple[float, float] | None,
    jaw_opening_m: float | None,
) -> Jaw | None:
    """From the joint's motion (``paths_m``, one (s, 3) per finger), or for two meshes from a range; None if nothing
    moves.

    The opening is the distance of the fingers' tips along x, unless ``jaw_opening_m`` is what a robot reports for the
    fingers as drawn.
    """
    if paths_m:
        return _linked(list(fingers), list(fingers.values()), paths_m, jaw_opening_m)
    if jaw_range_m is None:
        if jaw_opening_m is not None:
            raise InputError(f"{jaw_opening_m:g}: nothing says that the jaws move; with --jaw-range", "jaw_opening_m")
        return None
    if len(fingers) != 2:
        raise InputError(
            f"belongs to two fingers, and the files hold {len(fingers)}; give the meshes of both", "jaw_range_m"
        )
    low, high = jaw_range_m
    nominal = round(_apart_m(*fingers.values()) if jaw_opening_m is None else jaw_opening_m, 7)
    if not low <= nominal <= high:
        raise InputError(
            f"{low:g}:{high:g} m: the fingers stand {nominal:g} m apart; a range that holds this, or --jaw-opening "
            "with what the robot reports for it",
            "jaw_range_m",
        )
    first, last = fingers
    motion = {first: {"axis": [-0.5, 0.0, 0.0]}, last: {"axis": [0.5, 0.0, 0.0]}}
    return Jaw(JawModel(nominal_m=nominal, min_m=low, max_m=high), motion)


def _apart_m(left: Surface, right: Surface) -> float:
    """Distance of the tips' inner sides along x, over the foremost tenth of the fingers."""
    inner = []
    for surface, best in ((left, np.max), (right, np.min)):
        z = surface.points_m[:, 2]
        inner.append(float(best(surface.points_m[z >= z.max() - 0.1 * np.ptp(z) - 1e-6, 0])))
    return max(inner[1] - inner[0], 0.0)


def _linked(names: list[str], surfaces: list[Surface], paths_m: Sequence[Array], nominal_m: float | None) -> Jaw:
    middle = len(paths_m[0]) // 2
    if len(names) >= 2:
        apart = _apart_m(surfaces[0], surfaces[-1])
        opening: Array = np.asarray(apart + paths_m[-1][:, 0] - paths_m[0][:, 0])
    else:
        opening = _travelled(paths_m[0])
    if nominal_m is not None:
        opening = np.asarray(opening + (nominal_m - opening[middle]))
    steps = np.diff(opening)
    if not ((steps > 0.0).all() or (steps < 0.0).all()):
        raise InputError("doesn't open or close the jaws all along its way; the joint of the jaws", "joint")
    if opening.min() < -1e-3:
        raise InputError(
            f"closes the jaws {-1e3 * opening.min():.1f} mm into each other; limits of the joint that the fingers have",
            "joint",
        )
    opening = np.asarray(np.maximum(opening, 0.0))
    order = np.argsort(opening)
    nominal = round(float(opening[middle]), 7)
    motion = {name: _motion(opening[order], path[order], nominal) for name, path in zip(names, paths_m, strict=True)}
    low, high = float(opening[order[0]]), float(opening[order[-1]])
    return Jaw(JawModel(nominal_m=nominal, min_m=round(low, 7), max_m=round(high, 7)), motion)


def _travelled(path_m: Array) -> Array:
    """A finger's distance travelled along its path."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])


def _motion(opening_m: Array, path_m: Array, nominal_m: float) -> dict[str, Any]:
    beyond = opening_m - nominal_m
    axis = beyond @ path_m / float(beyond @ beyond)
    if np.abs(path_m - beyond[:, None] * axis).max() <= STRAIGHT_M:
        return {"axis": [round(float(v), 9) + 0.0 for v in axis]}
    rows = np.column_stack([opening_m, path_m])
    return {"table": [[round(float(v), 7) + 0.0 for v in row] for row in rows]}
