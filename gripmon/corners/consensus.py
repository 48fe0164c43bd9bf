"""Step 4 of the corner measurement: one robust fit of all edge candidates in the six parameters of the motion.

Lines that are fitted one by one lock onto straight edges of the background; a rigid gripper leaves only six ways to
be wrong. Candidates vote with Tukey's biweight about a hypothesis; hypotheses come from the prediction or, after a
jump, from a grid of starts. The residual of a candidate is its offset along the profile minus ``jacobian @ xi``, in
px.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from gripmon.corners.prediction import Prediction
from gripmon.corners.profiles import Candidates
from gripmon.records import Array


class ConsensusSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How edge candidates agree on one motion."""

    start_width_px: Annotated[
        float, Meta(ge=0.5, le=10.0, description="width of the robust weight at the prediction (px)")
    ] = 2.5
    point_floor_px: Annotated[
        float,
        Meta(
            ge=0.005, le=1.0, description="standard deviation of an edge point that image noise does not explain (px)"
        ),
    ] = 0.05
    edge_floor_px: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="standard deviation of a whole edge's position that averaging along it does not remove (px)",
        ),
    ] = 0.03
    support_sigmas: Annotated[
        float,
        Meta(ge=1.0, le=20.0, description="by how many standard deviations an edge must beat chance to count as seen"),
    ] = 4.0
    support_share: Annotated[
        float, Meta(ge=0.05, le=0.95, description="share of an edge's profiles that must agree for it to count as seen")
    ] = 0.3
    trusted_share: Annotated[
        float,
        Meta(
            ge=0.05,
            le=0.95,
            description="share of neighbouring profiles that must agree where the gripper was expected",
        ),
    ] = 0.3
    found_share: Annotated[
        float,
        Meta(ge=0.05, le=0.95, description="share of neighbouring profiles that must agree where it was looked for"),
    ] = 0.42


GATE_PX = 0.5
"""A profile supports a fit if a candidate lies this close to it."""

_TUKEY = 4.685
_LARGEST_SCALE_PX = 0.5
_ROUNDS = 6
_CONVERGED = 0.04  # squared step over its covariance: a fifth of a standard deviation; what is still to come is less


@dataclass(frozen=True, slots=True)
class Consensus:
    """The common motion of the edge candidates.

    ``xi`` (m,) relative to the prediction's pose, m = 6, or 7 with the jaw opening; ``weight`` (k,) per candidate in
    1/px², zero for those that don't belong; ``information`` (m, m) of the edge points alone; ``scale_px`` robust
    spread of the inliers; ``supported`` (n,) whether a profile agrees; for all edges of the gripper ``edge_share``
    (e,) share of its profiles that agree and ``edge_seen`` (e,).  ``share``: part of all pairs of neighbouring
    profiles in which both agree, on edges that are seen; zero with fewer than three such edges.
    """

    xi: Array
    weight: Array
    residual_px: Array
    information: Array
    scale_px: float
    supported: NDArray[np.bool_]
    edge_share: Array
    edge_seen: NDArray[np.bool_]
    share: float


def base_weights(
    candidates: Candidates,
    prediction: Prediction,
    polarity: NDArray[np.int8],
    bevel_m: Array,
    settings: ConsensusSettings,
) -> Array:
    """Weight (k,) of each candidate before the robust part, 1/px²; zero where the taught polarity disagrees.

    ``polarity`` and ``bevel_m`` (e,) belong to the gripper's edges.  What moves a whole edge at once (pixel grid,
    shading, a bevel with the spread of a uniform distribution, bevel / sqrt(12)) makes n points on it worth no more
    than one with that spread.
    """
    edge = prediction.layout.edge[candidates.sample]
    points = np.bincount(prediction.layout.edge, minlength=len(bevel_m))
    spread = np.full(len(bevel_m), float(settings.edge_floor_px**2))
    if bevel_m.any():
        spread += (bevel_m * prediction.pixels_per_m) ** 2 / 12.0
    variance = candidates.sigma_px**2
    variance += (settings.point_floor_px**2 + points * spread)[edge]
    weight = 1.0 / variance
    if polarity.any():
        wanted = polarity[edge]
        weight[(wanted != 0) & (np.sign(candidates.step) != wanted)] = 0.0
    return weight


def agree(
    candidates: Candidates,
    prediction: Prediction,
    weights: Array,
    start: Array,
    prior_mean: Array,
    prior: Array,
    settings: ConsensusSettings,
) -> Consensus:
    """Robust fit from one start: iteratively re-weighted, the width shrinking from ``start_width_px`` to the measured
    scale.

    ``weights`` (k,) from :func:`base_weights`; ``prior`` (m,) holds each unknown at ``prior_mean`` by that much
    (1/m², 1/rad²), as a reported jaw opening does.  With fewer candidates than unknowns the fit stays at the start
    and supports nothing.
    """
    jacobian = prediction.jacobian_by_unknown[:, candidates.sample]
    offset = candidates.offset_px
    active = None if weights.all() else weights > 0.0
    xi = start
    residual = offset - xi @ jacobian
    width, scale = settings.start_width_px, _LARGEST_SCALE_PX
    for round_ in range(_ROUNDS):
        if round_:
            scale = _scale(residual, active, width, settings.point_floor_px)
            width = min(_TUKEY * scale, width)
        step, information, weight = _step(jacobian, residual, weights, width, prior_mean - xi, prior)
        xi = xi + step
        residual = offset - xi @ jacobian
        if round_ >= 2 and float(step @ information @ step) < _CONVERGED:
            break
    return _judge(candidates, prediction, active, xi, weight, residual, information, scale, settings)


def agree_from_grid(
    candidates: Candidates,
    prediction: Prediction,
    weights: Array,
    starts: Array,
    prior_mean: Array,
    prior: Array,
    settings: ConsensusSettings,
    refine: int = 6,
) -> Consensus:
    """Best fit from many starts (g, m): all are scored by the candidates near them, the best few refined."""
    jacobian = prediction.jacobian[candidates.sample].T
    active = weights > 0.0
    distance = (candidates.offset_px - starts @ jacobian) * (1.0 / settings.start_width_px)
    np.square(distance, out=distance)
    np.subtract(1.0, distance, out=distance)
    np.maximum(distance, 0.0, out=distance)
    best = np.argsort(-(distance @ active.astype(float)), kind="stable")[:refine]
    fits = [agree(candidates, prediction, weights, starts[i], prior_mean, prior, settings) for i in best]
    return max(fits, key=lambda fit: fit.share)


def grid_of_starts(prediction: Prediction, reach_px: float, step_px: float) -> Array:
    """Starts (g, m) that shift the image by a grid of ``step_px``, turn it and scale it: the motions that a camera
    shows at first order.

    Expressed as translations of the gripper across the axis, rotation about the optical axis, and translation along it.
    """
    middle = prediction.corners.cam_m.mean(axis=0)
    span_px = float(np.abs(prediction.uv_px - prediction.uv_px.mean(axis=0)).max())
    ticks = np.arange(-round(reach_px / step_px), round(reach_px / step_px) + 1) * step_px
    turns = np.array([-1.0, 0.0, 1.0]) * 0.6 * reach_px / span_px
    dx, dy, scale, turn = (a.ravel() for a in np.meshgrid(ticks, ticks, turns, turns, indexing="ij"))
    starts = np.zeros((len(dx), prediction.jacobian.shape[1]))
    starts[:, 0], starts[:, 1] = dx / prediction.pixels_per_m, dy / prediction.pixels_per_m
    starts[:, 2] = scale * middle[2]
    starts[:, 5] = turn
    return starts


def _step(
    jacobian: Array, residual: Array, weights: Array, width: float, to_prior: Array, prior: Array
) -> tuple[Array, Array, Array]:
    """One weighted Gauss-Newton step: (m,) step, (m, m) information, (k,) weights."""
    weight = residual * (1.0 / width)
    np.square(weight, out=weight)
    np.subtract(1.0, weight, out=weight)
    np.maximum(weight, 0.0, out=weight)
    np.square(weight, out=weight)
    weight *= weights
    weighted = jacobian * weight
    information = weighted @ jacobian.T
    normal = information.copy()
    normal.flat[:: len(normal) + 1] += prior
    _, step, failed = dposv(normal, weighted @ residual + prior * to_prior)
    if failed:
        raise FloatingPointError("the normal matrix of the joint fit is not positive definite")
    return step, information, weight


def noise_inflation(candidates: Candidates, prediction: Prediction, consensus: Consensus) -> float:
    """Factor >= 1 by which the fit's covariance must grow so that it matches the residuals.

    Edge points are worth less than their image noise says: texture on and behind an edge moves them, and neighbours
    err together. Both show in the means of whole stretches of an edge: with independent errors of the assumed size
    the weighted squares of these means add up to the number of stretches less the number of unknowns.
    """
    inlier = np.flatnonzero(consensus.weight)
    stretch = prediction.layout.stretch[candidates.sample[inlier]]
    weight = consensus.weight[inlier]
    total = np.bincount(stretch, weight)
    moment = np.bincount(stretch, weight * consensus.residual_px[inlier])
    full = total > 0.0
    freedom = int(np.count_nonzero(full)) - len(consensus.xi)
    if freedom < 3:
        return 1.0
    return max(1.0, float((moment[full] ** 2 / total[full]).sum()) / freedom)


def prior_information(jaw_sigma_m: float | None) -> Array:
    """Prior information (m,): far below what any usable view gives, it only keeps a view without information solvable.

    With a ``jaw_sigma_m`` the jaw opening is the seventh unknown, and the reported one is worth that standard
    deviation (at least a micrometre, which stands for "exact").
    """
    pose = [1.0 / 0.1**2] * 3 + [1.0] * 3
    return np.array(pose if jaw_sigma_m is None else [*pose, max(jaw_sigma_m, 1e-6) ** -2])


def _scale(residual: Array, active: NDArray[np.bool_] | None, width: float, floor_px: float) -> float:
    """Robust standard deviation (px) of the residuals inside the present width: 1.4826 times their median size."""
    size = np.abs(residual if active is None else residual[active])
    size = size[size < width]
    if len(size) < 12:
        return _LARGEST_SCALE_PX
    middle = len(size) // 2
    return min(max(1.4826 * float(np.partition(size, middle)[middle]), floor_px), _LARGEST_SCALE_PX)


def _judge(
    candidates: Candidates,
    prediction: Prediction,
    active: NDArray[np.bool_] | None,
    xi: Array,
    weight: Array,
    residual: Array,
    information: Array,
    scale_px: float,
    settings: ConsensusSettings,
) -> Consensus:
    """Count who agrees, and hold it against chance: the density of candidates tells how many would lie in the gate
    anyway.
    """
    edges = len(prediction.line_origin)
    edge_of = prediction.layout.edge
    sample = candidates.sample if active is None else candidates.sample[active]
    close = sample[np.abs(residual if active is None else residual[active]) < GATE_PX]
    supported = np.zeros(len(edge_of), dtype=bool)
    supported[close] = True
    profiles, some = prediction.profiles, prediction.some_profiles
    agreeing = np.bincount(edge_of, supported, edges)
    others = np.bincount(edge_of[sample], minlength=edges) - np.bincount(edge_of[close], minlength=edges)
    # Edge responses end before the profiles do: what was found tells how far candidates reach.
    reach_px = max(float(np.abs(candidates.offset_px).max(initial=0.0)), settings.start_width_px)
    chance = 1.0 - np.exp(others * (-GATE_PX / max(reach_px - GATE_PX, 0.5)) / some)
    needed = profiles * chance + settings.support_sigmas * np.sqrt(profiles * chance * (1.0 - chance))
    share = agreeing / some
    seen = (agreeing >= 5) & (agreeing > needed) & (share >= settings.support_share)
    # What chance supports is scattered, what the gripper supports comes in runs: neighbours are counted, not profiles.
    pair = prediction.pair
    believed = 0.0
    if prediction.pairs and np.count_nonzero(seen) >= 3:
        agreeing_pairs = pair & supported[1:] & supported[:-1] & seen[edge_of[1:]]
        believed = int(np.count_nonzero(agreeing_pairs)) / prediction.pairs
    return Consensus(xi, weight, residual, information, scale_px, supported, share, seen, believed)
