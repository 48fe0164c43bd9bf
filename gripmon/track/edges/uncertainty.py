"""How uncertain a joint fit is: from the scatter that its edge points show, never only from the noise assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.track.edges import kernel
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import NOT_SOLVED, ROUNDS, Prior, RobustFit, fit_irls
from gripmon.track.edges.settings import RobustFitSettings

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


def without_one_edge(
    edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings, contradiction: float
) -> tuple[Edgels, RobustFit, Uncertainty] | None:
    """The fit, from ``start`` (m,), without the one edge of the gripper that contradicts all others; None if no single
    edge explains the ``contradiction``.

    An edge without contrast that has a straight edge of the background beside it, for example, turns the whole gripper
    towards that, a little at each of its other edges, which are too many to be outliers.
    """
    stays = contradictions_without(edgels, prior, start, settings)
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


def _without(edgels: Edgels, left_out: int) -> Edgels:
    edge = edgels.prediction.layout.edge[edgels.candidates.sample]
    return replace(edgels, weight=np.where(edge == left_out, 0.0, edgels.weight))
