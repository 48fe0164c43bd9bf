"""Step 5 of the corner measurement: a line for each edge through the points that agreed, corners where adjacent lines
meet.

Lines live in ideal coordinates, where a straight edge is straight: the offset ``e`` of a point from its predicted
line is fitted by ``e = a + b * along``.  Corners come with a 2x2 covariance each, and a reason when they are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.corners.consensus import Consensus
from gripmon.corners.prediction import Prediction
from gripmon.corners.profiles import Candidates
from gripmon.gripper import Gripper
from gripmon.records import Array, CornerFault


class CornerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When an intersection counts as a corner."""

    smallest_angle_rad: Annotated[
        float, Meta(ge=0.02, le=1.5, description="smallest angle between two edges that make a corner (rad)")
    ] = 0.2
    largest_sigma_px: Annotated[
        float, Meta(ge=0.01, le=10.0, description="largest standard deviation of a corner that may be used (px)")
    ] = 1.0
    neighbourhood: Annotated[
        int,
        Meta(ge=1, le=20, description="profiles next to the corner, half of which must be seen on each of its edges"),
    ] = 4


@dataclass(frozen=True, slots=True)
class Corners:
    """Measured corners, arrays over all corners of the gripper: ``xy`` (c, 2) ideal coordinates, ``covariance_xy``
    (c, 2, 2), ``uv_px`` (c, 2), ``sigma_px`` (c,) the larger axis, ``fault`` one reason or None each, ``usable``
    (c,) where there is none; NaN where a corner was not measured.
    """

    xy: Array
    covariance_xy: Array
    uv_px: Array
    sigma_px: Array
    fault: tuple[CornerFault | None, ...]
    usable: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CornerGeometry:
    """What of the intersections doesn't depend on the image, for one prediction; c corners with at most three edges
    each.

    ``edges`` (c, 3) indices, -1 where there are fewer; ``slot`` (c, 3) their places among the sampled edges, -1 for
    none; ``along`` (c, 3) the predicted corner on each line; ``direction`` and ``right`` (c, 3, 2) of the lines;
    ``beside`` (c, 3, 2) first and last + 1 of the profiles next to the corner; ``fault`` the reason why a corner
    can't be measured in this view, whatever the image.
    """

    edges: NDArray[np.intp]
    slot: NDArray[np.intp]
    along: Array
    direction: Array
    right: Array
    beside: NDArray[np.intp]
    fault: tuple[CornerFault | None, ...]

    @classmethod
    def of(cls, gripper: Gripper, prediction: Prediction, settings: CornerSettings) -> CornerGeometry:
        layout = prediction.layout
        corners = len(gripper.corner_ids)
        edges = np.full((corners, 3), -1, dtype=np.intp)
        for i in range(corners):
            at = gripper.edges_at_corner(i)[:3]
            edges[i, : len(at)] = at
        slots = np.full(len(gripper.edge_ids) + 1, -1, dtype=np.intp)
        slots[layout.edges] = np.arange(len(layout.edges))
        slot = slots[edges]
        direction = prediction.line_direction[edges]
        from_origin = prediction.corners.xy[:, None, :] - prediction.line_origin[edges]
        bounds = np.append(layout.first, len(layout.edge))
        first, last = bounds[slot], bounds[slot + 1]
        at_start = gripper.edge_points[edges, 0] == gripper.corner_points[:, None]
        begin = np.where(at_start, first, np.maximum(last - settings.neighbourhood, first))
        end = np.where(at_start, np.minimum(first + settings.neighbourhood, last), last)
        return cls(
            edges,
            slot,
            np.einsum("cki,cki->ck", from_origin, direction),
            direction,
            np.stack([-direction[..., 1], direction[..., 0]], axis=-1),
            np.stack([begin, end], axis=-1),
            tuple(
                CornerFault.OUTSIDE
                if not inside
                else CornerFault.SELF_HIDDEN
                if not visible
                else CornerFault.FEW_POINTS
                if sampled < 2
                else None
                for inside, visible, sampled in zip(
                    prediction.corners.inside.tolist(),
                    prediction.corners.visible.tolist(),
                    (slot >= 0).sum(axis=1).tolist(),
                    strict=True,
                )
            ),
        )


def intersect_edges(
    candidates: Candidates,
    prediction: Prediction,
    consensus: Consensus,
    geometry: CornerGeometry,
    settings: CornerSettings,
) -> Corners:
    """Corners as intersections of the lines through the agreed edge points; weighted least squares where three edges
    meet.

    A predicted corner lies on its predicted lines, so the measured line ``offset + slope * along`` asks for a shift
    of the corner with ``(right - slope * direction) . shift = offset + slope * along``.
    """
    lines = _fit_lines(candidates, prediction, consensus)[:, geometry.slot]
    offset, slope, var_offset, covariance, var_slope = lines
    seen = (geometry.slot >= 0) & consensus.edge_seen[geometry.edges] & np.isfinite(offset)
    along = geometry.along
    row = geometry.right - slope[..., None] * geometry.direction
    row[~seen] = 0.0
    weight = np.zeros(seen.shape)
    np.divide(1.0, var_offset + along * (2.0 * covariance + along * var_slope), out=weight, where=seen)
    wanted = np.where(seen, offset + slope * along, 0.0)
    weighted = weight[..., None] * row
    information = weighted.transpose(0, 2, 1) @ row
    fault = _faults(consensus, geometry, seen, row, settings)
    good = np.array([f is None for f in fault], dtype=bool)
    covariance_xy = np.full((len(good), 2, 2), np.nan)
    covariance_xy[good] = np.linalg.inv(information[good])
    shift = (covariance_xy @ (weighted * wanted[..., None]).sum(axis=1)[..., None])[..., 0]
    sigma_px = _largest_sigma(prediction.corners.d_uv_d_xy, covariance_xy)
    uncertain = good & ~(sigma_px <= settings.largest_sigma_px)
    return Corners(
        prediction.corners.xy + shift,
        covariance_xy,
        prediction.corners.uv_px + (prediction.corners.d_uv_d_xy @ shift[..., None])[..., 0],
        sigma_px,
        tuple(CornerFault.UNCERTAIN if unsure else why for why, unsure in zip(fault, uncertain.tolist(), strict=True)),
        good & ~uncertain,
    )


def _fit_lines(candidates: Candidates, prediction: Prediction, consensus: Consensus) -> Array:
    """Weighted straight lines ``e = offset + slope * along`` through the agreed points of every sampled edge at once.

    (5, v + 1): offset, slope, variance of the offset, covariance, variance of the slope; NaN for edges with fewer than
    four points and in the last column, which stands for "no edge" (slot -1).
    """
    first = prediction.layout.first
    inlier = np.flatnonzero(consensus.weight)
    sample = candidates.sample[inlier]
    gain = prediction.gain[sample]
    along = prediction.along[sample]
    terms = np.zeros((5, len(inlier) + 1))
    weight, weighted_along, weighted_square, weighted_offset, weighted_both = terms[:, 1:]
    np.divide(consensus.weight[inlier], gain * gain, out=weight)
    np.multiply(weight, along, out=weighted_along)
    np.multiply(weighted_along, along, out=weighted_square)
    np.multiply(weight, gain * candidates.offset_px[inlier], out=weighted_offset)
    np.multiply(weighted_offset, along, out=weighted_both)
    # Points come sorted by edge: sums over edges are differences of running sums.
    bounds = np.append(np.searchsorted(sample, first), len(inlier))
    sums = np.cumsum(terms, axis=1)[:, bounds]
    s0, s1, s2, t0, t1 = sums[:, 1:] - sums[:, :-1]
    out = np.full((5, len(first) + 1), np.nan)
    determinant = s0 * s2 - s1 * s1
    fit = (np.diff(bounds) >= 4) & (determinant > 0.0)
    np.divide(np.stack([s2 * t0 - s1 * t1, s0 * t1 - s1 * t0, s2, -s1, s0]), determinant, out=out[:, :-1], where=fit)
    return out


def _largest_sigma(lens: Array, covariance_xy: Array) -> Array:
    """(c,) standard deviation along the larger axis of each corner's covariance, px."""
    covariance_px = lens @ covariance_xy @ lens.transpose(0, 2, 1)
    a, b, c = covariance_px[:, 0, 0], covariance_px[:, 0, 1], covariance_px[:, 1, 1]
    sigma_px: Array = np.sqrt(0.5 * (a + c + np.sqrt((a - c) ** 2 + 4.0 * b * b)))
    return sigma_px


def _faults(
    consensus: Consensus,
    geometry: CornerGeometry,
    seen: NDArray[np.bool_],
    row: Array,
    settings: CornerSettings,
) -> list[CornerFault | None]:
    """One reason or None for every corner: hidden if fewer than two of its edges are seen right beside it."""
    count = np.concatenate([[0], np.cumsum(consensus.supported)])[geometry.beside]
    width = geometry.beside[..., 1] - geometry.beside[..., 0]
    beside = seen & (2 * (count[..., 1] - count[..., 0]) >= width)
    seen_beside = beside.sum(axis=1).tolist()
    # Sine of the angle between any two of the (up to three) lines; rows have nearly unit length relative to each other.
    x, y = row[..., 0], row[..., 1]
    length = np.sqrt(x * x + y * y)
    following = [1, 2, 0]
    cross = np.abs(x * y[:, following] - y * x[:, following])
    angle_ok = (cross > np.sin(settings.smallest_angle_rad) * length * length[:, following]).any(axis=1).tolist()
    return [
        fault or (CornerFault.HIDDEN if near < 2 else None if wide else CornerFault.PARALLEL)
        for fault, near, wide in zip(geometry.fault, seen_beside, angle_ok, strict=True)
    ]
