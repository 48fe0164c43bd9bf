"""How the fingers of a CAD model move with the jaws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gripmon.model.errors import InputError
from gripmon.model.gripper import JawModel
from gripmon.model.records import Array
from gripmon.teach.cad.surface import Surface

STRAIGHT_M = 1e-6
"""Largest deviation from a line of a finger that moves along an axis; with a larger one it gets a table."""

OVERLAP_M = 1e-3
"""Jaws that a joint closes farther than this into each other have other limits than the joint."""


@dataclass(frozen=True, slots=True)
class Jaw:
    """The gripper file's jaw section, and each finger's shifts: ``opening_m`` (s,) ascending, ``path_m`` (s, 3)."""

    model: JawModel
    opening_m: Array
    path_m: dict[str, Array]

    def turned(self, to_R_jaw: Array) -> Jaw:
        return replace(self, path_m={name: path @ to_R_jaw.T for name, path in self.path_m.items()})

    def motion(self, finger: str) -> dict[str, Any] | None:
        """A finger's ``motion`` in the gripper file; None where it stands."""
        path_m, beyond = self.path_m[finger], self.opening_m - self.model.nominal_m
        axis = beyond @ path_m / float(beyond @ beyond)
        if not path_m.any():
            return None
        if np.abs(path_m - beyond[:, None] * axis).max() <= STRAIGHT_M:
            return {"axis": [round(float(v), 9) + 0.0 for v in axis]}
        rows = np.column_stack([self.opening_m, path_m])
        return {"table": [[round(float(v), 7) + 0.0 for v in row] for row in rows]}


def jaw_of(
    fingers: Mapping[str, Surface],
    paths_m: Sequence[Array],
    jaw_range_m: tuple[float, float] | None,
    jaw_opening_m: float | None,
) -> Jaw | None:
    """From the joint's motion (``paths_m``, one (s, 3) per finger), within a range if one is given; for two meshes from
    the range; None if nothing moves.  Gripper axes.

    The opening is the distance of the fingers' tips along x, unless ``jaw_opening_m`` is what a robot reports for the
    fingers as drawn.
    """
    if paths_m:
        return _linked(list(fingers), list(fingers.values()), paths_m, jaw_range_m, jaw_opening_m)
    if jaw_range_m is None:
        if jaw_opening_m is not None:
            raise InputError(f"{jaw_opening_m:g}: nothing says that the jaws move; with --jaw-range", "jaw_opening_m")
        return None
    if len(fingers) != 2:
        raise InputError(
            f"belongs to two fingers, and the files hold {len(fingers)}; give the meshes of both", "jaw_range_m"
        )
    low, high = jaw_range_m
    nominal = round(max(_gap_m(*fingers.values()), 0.0) if jaw_opening_m is None else jaw_opening_m, 7)
    if not low <= nominal <= high:
        raise InputError(
            f"{low:g}:{high:g} m: the fingers stand {nominal:g} m apart; a range that holds this, or --jaw-opening "
            "with what the robot reports for it",
            "jaw_range_m",
        )
    opening = np.array(jaw_range_m)
    ways: dict[str, Array] = {
        name: (opening - nominal)[:, None] * [side, 0.0, 0.0] for name, side in zip(fingers, (-0.5, 0.5), strict=True)
    }
    return Jaw(JawModel(nominal_m=nominal, min_m=low, max_m=high), opening, ways)


def _gap_m(left: Surface, right: Surface) -> float:
    """Distance of the tips' inner sides along x, over the foremost tenth of the fingers; negative if they overlap."""
    inner = []
    for surface, best in ((left, np.max), (right, np.min)):
        z = surface.points_m[:, 2]
        inner.append(float(best(surface.points_m[z >= z.max() - 0.1 * np.ptp(z) - 1e-6, 0])))
    return inner[1] - inner[0]


def _linked(
    names: list[str],
    surfaces: list[Surface],
    paths_m: Sequence[Array],
    range_m: tuple[float, float] | None,
    nominal_m: float | None,
) -> Jaw:
    middle = len(paths_m[0]) // 2
    if len(names) >= 2:
        opening: Array = np.asarray(_gap_m(surfaces[0], surfaces[-1]) + paths_m[-1][:, 0] - paths_m[0][:, 0])
    else:
        opening = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(paths_m[0], axis=0), axis=1))])
    if nominal_m is not None:
        opening = np.asarray(opening + (nominal_m - opening[middle]))
    steps = np.diff(opening)
    if not ((steps > 0.0).all() or (steps < 0.0).all()):
        raise InputError("doesn't open or close the jaws all along its way; the joint of the jaws", "joint")
    nominal = round(float(opening[middle]), 7)
    order = np.argsort(opening)
    opening, paths = opening[order], [path[order] for path in paths_m]
    low, high = float(opening[0]), float(opening[-1])
    if low < -OVERLAP_M and range_m is None:
        raise InputError(
            f"closes the jaws {-1e3 * low:.1f} mm into each other; limits of the joint that the fingers have, or "
            f"--jaw-range 0:{max(high, 0.0):.4f}",
            "joint",
        )
    if range_m is None:
        range_m = max(low, 0.0), high
    elif not (low - OVERLAP_M <= range_m[0] <= nominal <= range_m[1] <= high + OVERLAP_M):
        raise InputError(
            f"{range_m[0]:g}:{range_m[1]:g} m: the joint opens the jaws from {low:.4f} to {high:.4f} m, and they "
            f"are drawn at {nominal:.4f} m; a range within, with this, or --jaw-opening with what the robot reports",
            "jaw_range_m",
        )
    inside = (opening > range_m[0] + 1e-9) & (opening < range_m[1] - 1e-9)
    rows = np.concatenate([[range_m[0]], opening[inside], [range_m[1]]])
    ways = [np.column_stack([np.interp(rows, opening, path[:, k]) for k in range(3)]) for path in paths]
    jaw = JawModel(nominal_m=nominal, min_m=round(range_m[0], 7), max_m=round(range_m[1], 7))
    return Jaw(jaw, rows, dict(zip(names, ways, strict=True)))
