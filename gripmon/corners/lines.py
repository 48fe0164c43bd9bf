"""Step 5 of the corner measurement: a line for each edge through the points that agreed, corners where adjacent lines meet.

Lines live in ideal coordinates, where a straight edge is straight: the offset ``e`` of a point from its predicted line is fitted by
``e = a + b * along``.  Corners come with a 2x2 covariance each, and a reason when they are refused.
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
    """Measured corners, arrays over all corners of the gripper: ``xy`` (c, 2) ideal coordinates, ``covariance_xy`` (c, 2, 2),
    ``uv_px`` (c, 2), ``sigma_px`` (c,) the larger axis, ``fault`` one reason or None each; NaN where there is a fault.
    """

    xy: Array
    covariance_xy: Array
    uv_px: Array
    sigma_px: Array
    fault: tuple[CornerFault | None, ...]

    @property
    def usable(self) -> NDArray[np.bool_]:
        return np.array([f is None for f in self.fault], dtype=bool)


@dataclass(frozen=True, slots=True)
class _Lines:
    """``offset`` (e,), ``slope`` (e,) and their covariance (e, 3: var a, cov, var b); NaN where an edge has too few points."""

    offset: Array
    slope: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class CornerTopology:
    """Which edges meet in each corner: ``edges`` (c, 3) indices, -1 where there are fewer, for one gripper."""

    edges: NDArray[np.intp]

    @classmethod
    def of(cls, gripper: Gripper) -> CornerTopology:
        edges = np.full((len(gripper.corner_ids), 3), -1, dtype=np.intp)
        for i in range(len(edges)):
            at = gripper.edges_at_corner(i)[:3]
            edges[i, : len(at)] = at
        return cls(edges)


def intersect_edges(
    candidates: Candidates,
    prediction: Prediction,
    consensus: Consensus,
    topology: CornerTopology,
    settings: CornerSettings,
) -> Corners:
    """Corners as intersections of the lines through the agreed edge points; weighted least squares where three edges meet."""
    lines = _fit_lines(candidates, prediction, consensus)
    edges = topology.edges
    seen = (edges >= 0) & consensus.edge_seen[edges] & np.isfinite(lines.offset[edges])
    direction = prediction.line_direction[edges]
    right = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
    row = right - lines.slope[edges][..., None] * direction
    from_origin = prediction.corners_xy[:, None, :] - prediction.line_origin[edges]
    along = np.einsum("cki,cki->ck", from_origin, direction)
    var_a, cov_ab, var_b = np.moveaxis(lines.covariance[edges], -1, 0)
    variance = var_a + 2.0 * along * cov_ab + along * along * var_b
    distance = lines.offset[edges] - np.einsum("cki,cki->ck", row, from_origin)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(seen, 1.0 / variance, 0.0)
        row = np.where(seen[..., None], row, 0.0)
        distance = np.where(seen, distance, 0.0)
    information = np.einsum("ck,cki,ckj->cij", weight, row, row)
    right_side = np.einsum("ck,ck,cki->ci", weight, distance, row)
    angle_ok = _largest_sine(row, seen) >= np.sin(settings.smallest_angle_rad)
    fault = _faults(prediction, consensus, edges, seen, angle_ok, settings)
    good = np.array([f is None for f in fault], dtype=bool)
    information[~good] = np.eye(2)
    covariance = np.linalg.inv(information)
    covariance[~good] = np.nan
    shift = np.einsum("cij,cj->ci", covariance, right_side)
    lens = prediction.corners_d_uv_d_xy
    covariance_px = lens @ covariance @ lens.transpose(0, 2, 1)
    half_trace = 0.5 * (covariance_px[:, 0, 0] + covariance_px[:, 1, 1])
    determinant = covariance_px[:, 0, 0] * covariance_px[:, 1, 1] - covariance_px[:, 0, 1] ** 2
    with np.errstate(invalid="ignore"):
        sigma_px = np.sqrt(half_trace + np.sqrt(np.maximum(half_trace**2 - determinant, 0.0)))
        uncertain = sigma_px > settings.largest_sigma_px
    return Corners(
        prediction.corners_xy + shift,
        covariance,
        prediction.corners_uv_px + np.einsum("cij,cj->ci", lens, shift),
        sigma_px,
        tuple(CornerFault.UNCERTAIN if u else f for f, u in zip(fault, uncertain.tolist(), strict=True)),
    )


def _fit_lines(candidates: Candidates, prediction: Prediction, consensus: Consensus) -> _Lines:
    """Weighted straight lines through the agreed points of every edge at once, by sums over edges."""
    edges = len(prediction.line_origin)
    inlier = np.flatnonzero(consensus.weight)
    sample = candidates.sample[inlier]
    edge = prediction.layout.edge[sample]
    gain = prediction.gain[sample]
    along = prediction.along[sample]
    offset = gain * candidates.offset_px[inlier]
    weight = consensus.weight[inlier] / gain**2
    if len(edge) == 0:
        nothing = np.full(edges, np.nan)
        return _Lines(nothing, nothing, np.full((edges, 3), np.nan))
    s0 = np.bincount(edge, weight, edges)
    s1 = np.bincount(edge, weight * along, edges)
    s2 = np.bincount(edge, weight * along * along, edges)
    t0 = np.bincount(edge, weight * offset, edges)
    t1 = np.bincount(edge, weight * along * offset, edges)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = s0 * s2 - s1 * s1
        determinant[np.bincount(edge, minlength=edges) < 4] = np.nan
        offset_at_origin = (s2 * t0 - s1 * t1) / determinant
        slope = (s0 * t1 - s1 * t0) / determinant
        covariance = np.stack([s2, -s1, s0], axis=-1) / determinant[:, None]
    return _Lines(offset_at_origin, slope, covariance)


def _largest_sine(row: Array, seen: NDArray[np.bool_]) -> Array:
    """(c,) sine of the largest angle between any two of a corner's seen lines; zero with fewer than two."""
    length = np.sqrt(np.einsum("cki,cki->ck", row, row))
    length[~seen] = 1.0
    unit = row / length[..., None]
    cross = unit[:, :, None, 0] * unit[:, None, :, 1] - unit[:, :, None, 1] * unit[:, None, :, 0]
    return np.abs(cross).max(axis=(1, 2))


def _faults(
    prediction: Prediction,
    consensus: Consensus,
    edges: NDArray[np.intp],
    seen: NDArray[np.bool_],
    angle_ok: NDArray[np.bool_],
    settings: CornerSettings,
) -> list[CornerFault | None]:
    beside = (
        np.zeros(edges.shape, dtype=bool)
        if len(prediction.layout.edges) == 0
        else _seen_beside(prediction, consensus, edges, settings.neighbourhood)
    )
    inside = np.isfinite(prediction.corners_uv_px).all(axis=1)
    sampled = (edges >= 0) & np.isfinite(prediction.line_origin[edges, 0])
    out: list[CornerFault | None] = []
    for i in range(len(edges)):
        if not prediction.corner_visible[i]:
            out.append(CornerFault.SELF_HIDDEN if inside[i] and prediction.corner_inside[i] else CornerFault.OUTSIDE)
        elif sampled[i].sum() < 2:
            out.append(CornerFault.FEW_POINTS)
        elif seen[i].sum() < 2 or (beside[i] & seen[i]).sum() < 2:
            out.append(CornerFault.HIDDEN)
        elif not angle_ok[i]:
            out.append(CornerFault.PARALLEL)
        else:
            out.append(None)
    return out


def _seen_beside(
    prediction: Prediction, consensus: Consensus, edges: NDArray[np.intp], neighbourhood: int
) -> NDArray[np.bool_]:
    """(c, 3) whether at least half of the profiles nearest to the corner agree, on each of its edges."""
    layout = prediction.layout
    last = np.append(layout.first[1:], len(layout.edge))
    slot = np.full(len(prediction.line_origin), -1, dtype=np.intp)
    slot[layout.edges] = np.arange(len(layout.edges))
    count = np.concatenate([[0], np.cumsum(consensus.supported)])
    at = slot[edges]
    known = (edges >= 0) & (at >= 0)
    low, high = layout.first[at], last[at]
    near_start = prediction.corner_at_start[np.arange(len(edges))[:, None], np.where(edges >= 0, edges, 0)]
    begin = np.where(near_start, low, np.maximum(high - neighbourhood, low))
    end = np.where(near_start, np.minimum(low + neighbourhood, high), high)
    return known & (2 * (count[end] - count[begin]) >= end - begin)
