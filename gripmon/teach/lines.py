"""The line of one edge in the teaching images, among everything else that looks like an edge next to it; what all edges
have in common; and the depth of an edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.least_squares import TUKEY, tukey_weights
from gripmon.model.records import Array
from gripmon.track.edges.prediction import STRETCH
from gripmon.track.edges.robust_fit import GATE_PX

_START_PX = 1.0  # half width of a line in the search: two lines closer than this are one in a blurred image
_FLOOR_PX = 0.05  # least assumed scatter of edge points: pixels are that coarse
_STEP_PX = 0.5
_TILTS_PX = (-1.0, 0.0, 1.0)
FEWEST_POINTS = 6  # edge points of a line
_ROUNDS = 20
_SETTLED_PX = 1e-4


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """Edge points of one edge in all images, against the reference's prediction.

    ``way`` (k,) from 0 to 1 along the sampled part, ``offset_px`` (k,), ``step`` (k,) grey-level step, ``profile`` (k,)
    number of the search line, ``image`` (k,) of the image; ``profiles`` (i,) number of search lines on it in each
    image.
    """

    way: Array
    offset_px: Array
    step: Array
    profile: NDArray[np.intp]
    image: NDArray[np.intp]
    profiles: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Line:
    """An edge's offset at both ends of its sampled part, px, with its covariance (2, 2) from the points' scatter.

    ``inlier`` (k,): which points belong to it; ``rms_px``: their scatter; ``seen``: the part of the search lines that
    show it; ``rival_px``: distance to another line that nearly as many points support, None if there is none.
    """

    ends_px: Array
    covariance_px2: Array
    inlier: NDArray[np.bool_]
    rms_px: float
    seen: float
    rival_px: float | None = None


def find_line(points: EdgePoints, expected_px: Array, reach_px: float) -> Line | None:
    """The line that most edge points of all images support within ``reach_px`` of the expected one (2,), px at both
    ends; None if there is none.

    Of two lines supported equally well, the one closer to the expected line is taken.
    """
    if len(points.way) < FEWEST_POINTS:
        return None
    shifts = np.arange(-round(reach_px / _STEP_PX), round(reach_px / _STEP_PX) + 1) * _STEP_PX
    starts = np.array([expected_px + s + 0.5 * t * np.array([-1.0, 1.0]) for s in shifts for t in _TILTS_PX])
    away = np.abs(starts.mean(axis=1) - expected_px.mean())
    support = support_of(points, starts)
    score = support * (1.0 - 0.5 * np.square(away / (reach_px + _STEP_PX)))
    best = int(score.argmax())
    line = settle_line(points, starts[best])
    if line is None:
        return None
    apart = np.abs(starts.mean(axis=1) - line.ends_px.mean()) > 1.5 * _START_PX
    rivals = np.flatnonzero(apart & (support > 0.8 * support[best]))
    rival_px = None
    if len(rivals):
        rival_px = float(starts[rivals[support[rivals].argmax()]].mean() - line.ends_px.mean())
    return replace(line, rival_px=rival_px)


def settle_line(points: EdgePoints, start_px: Array) -> Line | None:
    """Robust straight line (Tukey's biweight, its width from the points' own scatter) from a start (2,); None if too
    few points lie there.
    """
    design = np.column_stack([1.0 - points.way, points.way])
    ends_px, width, scale = start_px, _START_PX, _FLOOR_PX
    for _ in range(_ROUNDS):
        residual = points.offset_px - design @ ends_px
        weight = tukey_weights(np.abs(residual), width)
        near = np.abs(residual) < width
        if np.count_nonzero(near) < FEWEST_POINTS:
            return None
        scale = max(1.4826 * float(np.median(np.abs(residual[near]))), _FLOOR_PX)
        width = min(TUKEY * scale, _START_PX)
        weighted = design * weight[:, None]
        normal = weighted.T @ design
        if not np.linalg.cond(normal) < 1e6:
            return None
        step = np.linalg.solve(normal, weighted.T @ residual)
        ends_px = ends_px + step
        if np.abs(step).max() < _SETTLED_PX:
            break
    residual = points.offset_px - design @ ends_px
    inlier = np.abs(residual) < width
    if np.count_nonzero(inlier) < FEWEST_POINTS:
        return None
    # Neighbours see the same pixels and the same texture: a whole stretch of them counts as one point.
    rms_px = float(np.sqrt(np.mean(np.square(residual[inlier]))))
    covariance = np.linalg.inv(design[inlier].T @ design[inlier]) * max(rms_px, scale) ** 2 * STRETCH
    shown = np.unique(points.profile[np.abs(residual) < GATE_PX])
    return Line(ends_px, covariance, inlier, rms_px, len(shown) / max(int(points.profiles.sum()), 1))


def of_image(points: EdgePoints, image: int) -> EdgePoints:
    """The points of one image alone."""
    own = points.image == image
    profiles = np.zeros_like(points.profiles)
    profiles[image] = points.profiles[image]
    return EdgePoints(
        points.way[own],
        points.offset_px[own],
        points.step[own],
        points.profile[own],
        points.image[own],
        profiles,
    )


def support_of(points: EdgePoints, starts: Array, worth: Array | None = None) -> Array:
    """Sum (s,) over all points of a weight that decreases with their distance from each line (s, 2), times their
    ``worth`` (k,), if they differ in it.
    """
    lines = starts[:, :1] * (1.0 - points.way) + starts[:, 1:] * points.way
    nearness = np.maximum(1.0 - np.square((points.offset_px - lines) / _START_PX), 0.0)
    return np.asarray(nearness.sum(axis=1) if worth is None else nearness @ worth)


@dataclass(frozen=True, slots=True)
class PooledOffsets:
    """Offsets ``ends_m`` (e, 2) and their covariances (e, 2, 2); ``own_m`` (e, 2), the part that is the edges' own, and
    ``usual_own_m`` (g,), its standard deviation over edges of a kind; ``common`` (m,), the common unknowns, with
    ``common_covariance`` (m, m).
    """

    ends_m: Array
    covariance_m2: Array
    own_m: Array
    usual_own_m: Array
    common: Array
    common_covariance: Array


def pool(
    ends_m: Array, covariance_m2: Array, rows: Array, kind: NDArray[np.intp], prior_covariance: Array
) -> PooledOffsets:
    """Posterior of the offsets ``ends_m`` (e, 2), whose noise has ``covariance_m2`` (e, 2, 2).

    ``rows`` (e, 2, m): derivatives, metres of offset by the common unknowns, which have a prior ``prior_covariance``
    (m, m) about zero.  ``kind`` (e,): the own offsets of edges of a kind (outlines, creases) share one standard
    deviation, and correlate by a half between both ends of an edge; it is estimated by restricted maximum likelihood
    (expectation maximisation).
    """
    own_shape = np.array([[1.0, 0.5], [0.5, 1.0]])
    inverse_shape = np.linalg.inv(own_shape)
    kinds = int(kind.max()) + 1
    own_m2 = np.full(kinds, float(np.mean(np.square(ends_m))) + 1e-16)
    common = np.zeros(rows.shape[2])
    mean, covariance, own, common_covariance = ends_m, covariance_m2, ends_m, prior_covariance
    for _ in range(30):
        shape = own_m2[kind][:, None, None] * own_shape
        weight = np.linalg.inv(covariance_m2 + shape)
        information = np.einsum("eim,eij,ejn->mn", rows, weight, rows) + np.linalg.inv(prior_covariance)
        common_covariance = np.linalg.inv(information)
        common = common_covariance @ np.einsum("eim,eij,ej->m", rows, weight, ends_m)
        gain = shape @ weight  # of what isn't common, the part that is the edge's own
        own = np.einsum("eij,ej->ei", gain, ends_m - np.einsum("eim,m->ei", rows, common))
        mean = np.einsum("eim,m->ei", rows, common) + own
        rest = np.eye(2) - gain
        lever, of_own = rest @ rows, gain @ rows
        own_covariance = shape - gain @ shape + of_own @ common_covariance @ of_own.transpose(0, 2, 1)
        covariance = shape - gain @ shape + lever @ common_covariance @ lever.transpose(0, 2, 1)
        whitened = np.einsum("ij,ei,ej->e", inverse_shape, own, own)
        whitened += np.einsum("ij,eji->e", inverse_shape, own_covariance)
        new = np.array([np.mean(whitened[kind == k]) / 2.0 if (kind == k).any() else 0.0 for k in range(kinds)])
        settled = np.abs(np.sqrt(new) - np.sqrt(own_m2)).max() < 1e-3 * np.sqrt(np.mean(own_m2) + 1e-16)
        own_m2 = new + 1e-18
        if settled:
            break
    return PooledOffsets(mean, covariance, own, np.sqrt(own_m2), common, common_covariance)


LARGEST_SLOPE = 5.0
"""Largest depth per metre of offset: that of a face 11° from the line of sight."""

UNKNOWN_SLOPE = 2.0
"""Standard deviation of the depth per metre of offset where faces don't show it."""

SLOPE_SHARE = 0.5
"""Standard deviation of a depth from faces, as a share of it: the line of a rounding lies less deep than a bevel's."""


def slopes(
    gripper: Gripper, points_grip_m: Array, crease: NDArray[np.bool_], axes: tuple[Array, Array], offset_m: Array
) -> Array:
    """Depth (e,) of an edge's rim per metre of its offset (e,) across the line of sight; NaN where the gripper file has
    no two faces at the edge.

    ``axes`` as from :func:`gripmon.track.edges.taught.sight_axes`.  The rim of an outline with equal bevels is the
    outer one, that of a crease the one on the side to which it is shifted.
    """
    across, depth = axes
    out = np.full(len(gripper.edge_ids), np.nan)
    members = [set(face.points.tolist()) for face in gripper.faces]
    for edge, (start, end) in enumerate(gripper.edge_points.tolist()):
        faces = [face for face, m in zip(gripper.faces, members, strict=True) if {start, end} <= m]
        if len(faces) != 2:
            continue
        along = points_grip_m[end] - points_grip_m[start]
        along = along / np.linalg.norm(along)
        into = np.array([points_grip_m[face.points].mean(axis=0) - points_grip_m[start] for face in faces])
        into -= np.outer(into @ along, along)
        into /= np.linalg.norm(into, axis=1)[:, None]
        shift, deeper = into @ across[edge], into @ depth[edge]
        rim = int(np.argmax(shift * offset_m[edge])) if crease[edge] else int(np.argmin(np.abs(shift)))
        if shift[rim] * offset_m[edge] > 0.0:
            out[edge] = np.clip(deeper[rim] / shift[rim], -LARGEST_SLOPE, LARGEST_SLOPE)
    return out
