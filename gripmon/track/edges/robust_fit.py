"""Step 4 of the corner measurement: one robust fit of all edgel hypotheses in the six parameters of the motion, and
its covariance.

Lines that are fitted one by one lock onto straight edges of the background; a rigid gripper leaves only six ways to
be wrong.  The fit is iteratively re-weighted least squares with Tukey's biweight, from the prediction or, after a jump,
from a grid of starts.  The residual of an edgel is its offset along the search line minus ``jacobian @ xi``, px.  The
covariance rests on the scatter that the edgels show, never only on the noise assumed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.track.edges import kernel
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.settings import RobustFitSettings

GATE_PX = 0.5
"""A search line supports a fit if an edgel hypothesis lies this close to it (px of the zoomed image)."""

RESTART_WIDTH_PX = 0.4
"""Width of the robust weight at a start that is nearly right, px."""

CONTRADICTION_RATIO = 3.0
"""Ratio of the stretches' scatter to what independent errors give, above which one edge is taken to belong to something
else, if the ratio falls by this factor without it; texture gives 1 to 2.
"""

NOT_SOLVED = "the normal matrix of the joint fit is not positive definite"

ROUNDS = 6
"""Re-weightings at most; half as many from a start that is nearly right."""


class Prior(NamedTuple):
    """What holds the unknowns (m,) before the image is seen: ``mean`` relative to the prediction, ``information`` in
    1/m², 1/rad².
    """

    mean: Array
    information: Array


class RobustFit(NamedTuple):
    """The common motion of the edgel hypotheses.

    ``xi`` (m,) relative to the prediction's pose, m = 6, or 7 with the jaw opening; ``weight`` (k,) per edgel
    hypothesis in 1/px², zero for those that don't belong, each edge's together limited by what its points share;
    ``information`` (m, m) of the edge points alone; ``spread_px`` robust size of the residuals, ``stiffness``: factor
    on ``information`` that gives the robust gradient's change by a small step; ``supported`` (n,) whether a search line
    agrees; for all edges of the gripper ``edge_share`` (e,) share of its search lines that agree and ``edge_seen``
    (e,). ``share``: part of all pairs of neighbouring search lines in which both agree, on edges that are seen; zero
    with fewer than three such edges.
    """

    xi: Array
    weight: Array
    residual_px: Array
    information: Array
    spread_px: float
    stiffness: float
    supported: NDArray[np.bool_]
    edge_share: Array
    edge_seen: NDArray[np.bool_]
    share: float


class NormalEquations(NamedTuple):
    """What each edge adds to the fit's normal equations; v edges with agreed points, m unknowns.

    ``edge`` (v,) of the gripper; ``pull`` (v, m): sum of weight times Jacobian times residual at the fit;
    ``information`` (v, m, m): by how much that grows with a step; ``middle`` (v, m, m): its covariance in one frame;
    ``lasting`` (v, m): what comes on top in every frame alike if the edge lies beside its place by its standard
    deviation.  A fit without some of them is these sums without theirs.
    """

    edge: NDArray[np.intp]
    pull: Array
    information: Array
    middle: Array
    lasting: Array


class Uncertainty(NamedTuple):
    """``covariance`` (m, m) of the fit's unknowns; ``line_weight`` (k,) what each edgel hypothesis is worth for the
    line of its edge alone, 1/px², zero for those that don't belong; ``shared_px`` standard deviation that the points of
    a stretch share; ``contradiction``: the weighted squares of the stretches' means over what independent errors of the
    assumed size would give, about 1; ``normal``: what the covariance was made of.
    """

    covariance: Array
    line_weight: Array
    shared_px: float
    contradiction: float
    normal: NormalEquations


def fit_irls(
    edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings, width_px: float | None = None
) -> RobustFit:
    """Robust fit from one start (m,): iteratively re-weighted, the width shrinking from ``width_px`` (if None, from the
    settings' ``start_width_px``) to what each edgel hypothesis's own standard deviation and the measured scatter allow.

    With fewer edgel hypotheses than unknowns the fit stays at the start and supports nothing.
    """
    candidates, prediction = edgels.candidates, edgels.prediction
    solved, fitted = kernel.fit(
        candidates.sample,
        candidates.offset_px,
        edgels.weight,
        prediction.jacobian,
        prediction.layout.edge,
        prediction.ok,
        prediction.independence,
        edgels.edge_spread_px,
        prior.mean,
        prior.information,
        start,
        settings.start_width_px if width_px is None else width_px,
        ROUNDS if width_px is None else ROUNDS // 2,
        settings.start_width_px,
        GATE_PX * candidates.zoom,
        settings.support_sigmas,
        settings.support_share,
    )
    if not solved:
        raise FloatingPointError(NOT_SOLVED)
    return RobustFit(*fitted)


def refit_visible(
    edgels: Edgels, prior: Prior, consensus: RobustFit, settings: RobustFitSettings
) -> tuple[Edgels, RobustFit]:
    """The fit again without the edges that chance supports as well: what lies near them is background."""
    edges = edgels.prediction.layout.edges
    seen = consensus.edge_seen
    if seen[edges].all() or np.count_nonzero(seen) < FEWEST_EDGES:
        return edgels, consensus
    edge = edgels.prediction.layout.edge[edgels.candidates.sample]
    rest = edgels._replace(weight=np.where(seen[edge], edgels.weight, 0.0))
    return rest, fit_irls(rest, prior, consensus.xi, settings, RESTART_WIDTH_PX)


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
    return edgels._replace(weight=np.where(edge == left_out, 0.0, edgels.weight))


def fit_irls_from_grid(
    edgels: Edgels, prior: Prior, starts: Array, settings: RobustFitSettings, refine: int = 6
) -> RobustFit:
    """Best fit from many starts (g, m): all are scored by the edgel hypotheses near them, the best few refined."""
    candidates = edgels.candidates
    jacobian = edgels.prediction.jacobian[candidates.sample].T
    active = edgels.weight > 0.0
    distance = (candidates.offset_px - starts @ jacobian) * (1.0 / settings.start_width_px)
    np.square(distance, out=distance)
    np.subtract(1.0, distance, out=distance)
    np.maximum(distance, 0.0, out=distance)
    best = np.argsort(-(distance @ active.astype(float)), kind="stable")[:refine]
    return max((fit_irls(edgels, prior, starts[i], settings) for i in best), key=lambda fit: fit.share)


def grid_of_starts(prediction: Prediction, reach_px: float, step_px: float) -> Array:
    """Starts (g, m) that shift the image by a grid of ``step_px``, turn it and scale it: the motions that a camera
    shows at first order.

    Expressed as translations of the gripper across the axis, rotation about the optical axis, and translation along it.
    """
    corners_m = prediction.corners.cam_m
    depth_m = float(corners_m[:, 2].mean()) if len(corners_m) else float(prediction.cam_T_grip[2, 3])
    span_px = float(np.abs(prediction.uv_px - prediction.uv_px.mean(axis=0)).max())
    ticks = np.arange(-round(reach_px / step_px), round(reach_px / step_px) + 1) * step_px
    turns = np.array([-1.0, 0.0, 1.0]) * 0.6 * reach_px / span_px
    dx, dy, scale, turn = (a.ravel() for a in np.meshgrid(ticks, ticks, turns, turns, indexing="ij"))
    starts = np.zeros((len(dx), prediction.jacobian.shape[1]))
    starts[:, 0], starts[:, 1] = dx / prediction.pixels_per_m, dy / prediction.pixels_per_m
    starts[:, 2] = scale * depth_m
    starts[:, 5] = turn
    return starts


VAGUE_M, VAGUE_RAD = 0.1, 1.0
"""Standard deviations of a pose of which nothing is known."""


def prior_information(jaw_sigma_m: float | None) -> Array:
    """Prior information (m,): far below what any usable view gives, it only keeps a view without information solvable.

    With a ``jaw_sigma_m`` the jaw opening is the seventh unknown, and the reported one is worth that standard
    deviation (at least a micrometre, which stands for "exact").
    """
    pose = [VAGUE_M**-2] * 3 + [VAGUE_RAD**-2] * 3
    return np.array(pose if jaw_sigma_m is None else [*pose, max(jaw_sigma_m, 1e-6) ** -2])
