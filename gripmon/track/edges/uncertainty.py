"""How uncertain a joint fit is: from the scatter that its edge points show, never only from the noise assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from gripmon.model.compiled import COMPILES
from gripmon.model.records import Array
from gripmon.track.edges import kernel
from gripmon.track.edges.kernel import FEWEST_FREE, SMALLEST_VARIANCE_RATIO
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import (
    NOT_SOLVED,
    ROUNDS,
    Prior,
    RobustFit,
    RobustFitSettings,
    fit_irls,
    fit_irls_with_numpy,
)

CONTRADICTION_RATIO = 3.0
"""Stretches that contradict each other more than this call for an edge that is none, without which they do so by no
more than such a part; texture gives 1 to 2.
"""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """What each edge adds to the fit's normal equations; v edges with agreed points, m unknowns.

    ``edge`` (v,) of the gripper; ``pull`` (v, m): sum of weight times Jacobian times residual at the fit;
    ``information`` (v, m, m): by how much that grows with a step; ``middle`` (v, m, m): its covariance.  A fit without
    some of them is these sums without theirs.
    """

    edge: NDArray[np.intp]
    pull: Array
    information: Array
    middle: Array


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """``covariance`` (m, m) of the fit's unknowns; ``line_weight`` (k,) what each candidate is worth for the line of
    its edge alone, 1/px², zero for those that don't belong; ``shared_px`` standard deviation that the points of a
    stretch share; ``contradiction``: the weighted squares of the stretches' means over what independent errors of the
    assumed size would give, about 1; ``normal``: what the covariance was made of.
    """

    covariance: Array
    line_weight: Array
    shared_px: float
    contradiction: float
    normal: NormalEquations


def assess(
    edgels: Edgels, consensus: RobustFit, prior_information: Array, expected_shared_px: float = 0.0
) -> Uncertainty:
    """Covariance of a fit whose points err together.

    Texture on and behind an edge moves it, and neighbours with it.  That shows in the weighted means of the residuals
    of whole stretches: with independent errors of the assumed size their weighted squares Q add up to the number of
    stretches less the number of unknowns.  What Q has more is the variance tau² that the points of a stretch share (the
    moment estimator of a random effect, DerSimonian and Laird 1986); what it has less says that the points are better
    than assumed.  With N the information of the fit, k its stiffness, P the prior, and g the sum of weight times
    Jacobian over a group, the covariance of the weighted fit is (Huber 1981, section 6.3, for groups that err
    together)

        H^-1 (c N + tau² sum_stretches g g' + k² sum_edges spread² g g' + P) H^-1,   H = k N + P

    c and tau² come from the biweight's pulls, which are smaller than the residuals, so that only the edges' spread,
    which is given in px, has to be multiplied by k.  ``expected_shared_px``: at least this much of tau is assumed.
    """
    if not COMPILES:
        return assess_with_numpy(edgels, consensus, prior_information, expected_shared_px)
    layout = edgels.prediction.layout
    solved, (covariance, line_weight, shared_px, contradiction), normal = kernel.assess(
        edgels.candidates.sample,
        consensus.weight,
        consensus.residual_px,
        consensus.information,
        consensus.stiffness,
        edgels.prediction.jacobian,
        layout.edge,
        layout.stretch,
        edgels.edge_spread_px,
        edgels.cut_off_px,
        prior_information,
        expected_shared_px,
    )
    if not solved:
        raise FloatingPointError(NOT_SOLVED)
    return Uncertainty(covariance, line_weight, shared_px, contradiction, NormalEquations(*normal))


def assess_with_numpy(
    edgels: Edgels, consensus: RobustFit, prior_information: Array, expected_shared_px: float = 0.0
) -> Uncertainty:
    """:func:`assess` where nothing compiles, and what the compiled one is held against."""
    inlier = np.flatnonzero(consensus.weight)
    stiffness = consensus.stiffness
    stiff = stiffness * consensus.information
    stiff.flat[:: len(stiff) + 1] += prior_information
    _, inverse, failed = dposv(stiff, np.eye(len(stiff)))
    if failed:
        raise FloatingPointError(NOT_SOLVED)
    unknowns = len(consensus.xi)
    if not len(inlier):
        nothing = NormalEquations(
            np.zeros(0, dtype=np.intp), np.zeros((0, unknowns)), *np.zeros((2, 0, unknowns, unknowns))
        )
        return Uncertainty(0.5 * (inverse + inverse.T), np.zeros(len(consensus.weight)), 0.0, 1.0, nothing)
    prediction = edgels.prediction
    sample, weight = edgels.candidates.sample[inlier], consensus.weight[inlier]
    edge, stretch = prediction.layout.edge[sample], prediction.layout.stretch[sample]
    # The weights were limited for what an edge's points share; this undoes it.
    worth = 1.0 - edgels.edge_spread_px**2 * np.bincount(edge, weight, len(edgels.edge_spread_px))
    alone = weight / worth[edge]
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    total = np.add.reduceat(alone, first)
    residual_px = consensus.residual_px[inlier]
    moment = np.add.reduceat(alone * residual_px, first)
    freedom = len(total) - unknowns
    contradiction = _contradiction(total, moment, freedom)
    scatter, shared = max(min(contradiction, 1.0), SMALLEST_VARIANCE_RATIO), 0.0
    if contradiction > 1.0:
        shared = (contradiction - 1.0) * len(total) / float(total.sum())
    shared = max(shared, (stiffness * expected_shared_px) ** 2)
    jacobian = prediction.jacobian_by_unknown[:, sample]
    weighted = jacobian * weight
    pulls = np.add.reduceat(weighted, first, axis=1)
    of_stretch = edge[first]
    begin = np.flatnonzero(np.diff(of_stretch, prepend=-1))
    at_edge = first[begin]
    seen = of_stretch[begin]
    # Sums over each edge: of points, of stretches, and of the edge as a whole.
    information = np.add.reduceat(weighted[:, None] * jacobian, at_edge, axis=2).transpose(2, 0, 1)
    by_stretch = np.add.reduceat(pulls[:, None] * pulls, begin, axis=2).transpose(2, 0, 1)
    spread_px = np.hypot(edgels.edge_spread_px, edgels.cut_off_px)
    whole = (np.add.reduceat(pulls, begin, axis=1) * (stiffness * spread_px[seen])).T
    middles = scatter * worth[seen][:, None, None] * information + shared * by_stretch
    middles += whole[:, :, None] * whole[:, None, :]
    # A scatter that is itself estimated from few stretches makes Student's distribution, with this variance.
    middles *= freedom / (freedom - 2.0) if freedom >= FEWEST_FREE else FEWEST_FREE
    middle = middles.sum(axis=0)
    middle.flat[:: len(middle) + 1] += prior_information
    covariance = inverse @ middle @ inverse
    pull = np.add.reduceat(weighted * residual_px, at_edge, axis=1).T
    normal = NormalEquations(seen, pull, stiffness * information, middles)
    line_weight = np.zeros(len(consensus.weight))
    counts = np.diff(np.append(first, len(inlier)))
    line_weight[inlier] = alone * np.repeat(stiffness**2 / (scatter + shared * total), counts)
    shared_px = float(np.sqrt(shared)) / stiffness
    return Uncertainty(0.5 * (covariance + covariance.T), line_weight, shared_px, contradiction, normal)


def _contradiction(total: Array, moment: Array, freedom: int) -> float:
    """Weighted squares of the stretches' means over their degrees of freedom; 1 where too few stretches are left.

    Above 1 it gives tau² = (contradiction - 1) * stretches / sum of their weights.
    """
    return float((moment**2 / total).sum()) / freedom if freedom >= FEWEST_FREE else 1.0


def without_one_edge(
    edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings, contradiction: float
) -> tuple[Edgels, RobustFit, Uncertainty] | None:
    """The fit, from ``start`` (m,), without the one edge of the gripper that contradicts all others; None if no single
    edge explains the ``contradiction``.

    An edge without contrast that has a straight edge of the background beside it, for example, turns the whole gripper
    towards that, a little at each of its other edges, which are too many to be outliers.
    """
    without = contradictions_without if COMPILES else contradictions_without_with_numpy
    stays = without(edgels, prior, start, settings)
    if not len(stays) or not stays.min() < contradiction / CONTRADICTION_RATIO:
        return None
    rest = _without(edgels, int(edgels.prediction.layout.edges[stays.argmin()]))
    consensus = fit_irls(rest, prior, start, settings)
    return rest, consensus, assess(rest, consensus, prior.information)


def contradictions_without(edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings) -> Array:
    """(v,) the contradiction that stays in the fit from ``start`` (m,) without each of the sampled edges."""
    candidates, prediction = edgels.candidates, edgels.prediction
    stays: Array = kernel.contradictions_without(
        prediction.layout.edges,
        candidates.sample,
        candidates.offset_px,
        edgels.weight,
        prediction.jacobian,
        prediction.layout.edge,
        prediction.layout.stretch,
        edgels.edge_spread_px,
        prior.mean,
        prior.information,
        start,
        settings.start_width_px,
        ROUNDS,
    )
    if np.isnan(stays).any():
        raise FloatingPointError(NOT_SOLVED)
    return stays


def contradictions_without_with_numpy(edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings) -> Array:
    """:func:`contradictions_without` where nothing compiles, and what the compiled one is held against."""
    fits = []
    for left_out in edgels.prediction.layout.edges.tolist():
        rest = _without(edgels, left_out)
        fits.append(assess_with_numpy(rest, fit_irls_with_numpy(rest, prior, start, settings), prior.information))
    return np.array([fit.contradiction for fit in fits])


def _without(edgels: Edgels, left_out: int) -> Edgels:
    edge = edgels.prediction.layout.edge[edgels.candidates.sample]
    return replace(edgels, weight=np.where(edge == left_out, 0.0, edgels.weight))
