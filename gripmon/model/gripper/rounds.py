"""Outlines of round surfaces: they move over the surface as the view changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper.model import GripperError, PointModel, RoundModel
from gripmon.model.records import Array

LARGEST_RADIUS_M = 1.0


@dataclass(frozen=True, slots=True)
class Rounds:
    """The points (r,) on round surfaces: ``which``, the ``centres_m`` and unit ``axes`` (r, 3), ``radius_m`` (r,), and
    the directions ``outwards`` (r, 3) from the axis to the points.
    """

    which: NDArray[np.intp]
    centres_m: Array
    axes: Array
    radius_m: Array
    outwards: Array

    @classmethod
    def of(cls, points: Mapping[str, PointModel], points_m: Array) -> Rounds:
        """From a gripper's points; :class:`GripperError` for an impossible rounding."""
        names = list(points)
        rounds = [point.round for point in points.values()]
        which = [k for k, each in enumerate(rounds) if isinstance(each, RoundModel)]
        given = [each for each in rounds if isinstance(each, RoundModel)]
        centres = np.reshape(np.array([g.centre_m for g in given], dtype=float), (-1, 3))
        axes = np.reshape(np.array([g.axis for g in given], dtype=float), (-1, 3))
        length = np.linalg.norm(axes, axis=1)
        for k, good in enumerate(np.isfinite(centres).all(axis=1) & np.isfinite(length) & (length > 0.0)):
            if not good:
                key = f"points.{names[which[k]]}.round"
                raise GripperError(f"{key}: holds no centre or no direction; ordinary numbers, an axis that isn't zero")
        axes = axes / length[:, None]
        away = points_m[which] - centres
        # The centre may be anywhere along the axis: move it to the point's height.
        along = np.einsum("ri,ri->r", away, axes)[:, None] * axes
        away = away - along
        radius = np.linalg.norm(away, axis=1)
        for k, good in enumerate((radius > 0.0) & (radius <= LARGEST_RADIUS_M)):
            if not good:
                key = f"points.{names[which[k]]}.round.centre_m"
                wrong = f"the axis passes the point by {radius[k]:g} m"
                raise GripperError(f"{key}: {wrong}; the radius, more than 0 and at most {LARGEST_RADIUS_M:g} m")
        return cls(np.array(which, dtype=np.intp), centres + along, axes, radius, away / radius[:, None])

    def seen_from(self, eye_grip_m: Array | None, points_grip_m: Array, offsets_m: Array) -> Array:
        """The points (p, 3), with those on round surfaces moved to where the eye (3,) sees the outline.

        In the plane across the axis that is the tangent point of a line from the eye to the circle; of the two, the one
        on the point's side.  ``offsets_m`` (p or 1, 3): how far the fingers have moved.  An eye inside the rounding
        sees no outline: such points stay.
        """
        if eye_grip_m is None or not len(self.which):
            return points_grip_m
        moved = offsets_m if len(offsets_m) == 1 else offsets_m[self.which]
        sight = eye_grip_m - (self.centres_m + moved)
        sight -= np.einsum("ri,ri->r", sight, self.axes)[:, None] * self.axes
        distance = np.sqrt(np.einsum("ri,ri->r", sight, sight))
        outside = distance > self.radius_m
        towards = sight / np.maximum(distance, 1e-30)[:, None]
        beside = np.cross(self.axes, towards)
        beside *= np.where(np.einsum("ri,ri->r", beside, self.outwards) < 0.0, -1.0, 1.0)[:, None]
        share = np.where(outside, self.radius_m / np.maximum(distance, 1e-30), 0.0)[:, None]
        normal = share * towards + np.sqrt(1.0 - share**2) * beside
        out = points_grip_m.copy()
        seen = self.centres_m + moved + self.radius_m[:, None] * normal
        out[self.which] = np.where(outside[:, None], seen, points_grip_m[self.which])
        return out
