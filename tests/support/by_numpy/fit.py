"""What ``track.edges.kernel`` compiles, by NumPy: the joint fit of all edge candidates, and its covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from gripmon.model.least_squares import TUKEY
from gripmon.model.records import Array
from gripmon.track.edges.kernel import (
    CONVERGED_SQUARED_STEP,
    FEWEST_AGREEING,
    FEWEST_EDGES,
    FEWEST_FREE,
    FEWEST_SPREAD,
    INNER_PX,
    INNER_SIGMAS,
    LARGEST_SPREAD,
    LARGEST_SPREAD_PX,
    LEAST_SCATTER,
    SMALLEST_SPREAD_PX,
    SMALLEST_STIFFNESS,
    WIDTH_DECAY,
)
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import (
    GATE_PX,
    NOT_SOLVED,
    ROUNDS,
    NormalEquations,
    Prior,
    RobustFit,
    Uncertainty,
    _without,
)
from gripmon.track.edges.settings import RobustFitSettings


class Fit(NamedTuple):
    """Where a robust fit ended, before it is judged; fields as in :class:`RobustFit`."""

    xi: Array
    weight: Array
    residual_px: Array
    information: Array
    spread_px: float
    stiffness: float


def fit_irls(
    edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings, width_px: float | None = None
) -> RobustFit:
    candidates, prediction = edgels.candidates, edgels.prediction
    width = settings.start_width_px if width_px is None else width_px
    shared = edgels.edge_spread_px**2
    xi, spread, spread_px = start, 1.0, LARGEST_SPREAD_PX
    near = _near(edgels, start, max(width, TUKEY * LARGEST_SPREAD_PX))
    rounds = ROUNDS if width_px is None else ROUNDS // 2
    for round_ in range(rounds):
        if round_:
            width *= WIDTH_DECAY
            spread, spread_px = _spread(near.residual(xi), near.sigma, settings.start_width_px)
        residual = near.residual(xi)
        reach = np.minimum(np.hypot(width, (TUKEY * spread) * near.sigma), max(width, TUKEY * spread_px))
        weight = _biweight(residual, reach)
        weight *= near.weight
        # All points of an edge together are worth no more than one with the spread that they share.
        weight /= (1.0 + shared * np.bincount(near.edge, weight, len(shared)))[near.edge]
        step, information = _step(near.jacobian, residual, weight, prior.mean - xi, prior.information)
        xi = xi + step
        if round_ >= rounds - 3 and float(step @ information @ step) < CONVERGED_SQUARED_STEP:
            break
    stiffness = _stiffness(weight, near.residual(xi), reach)
    every = np.zeros(len(candidates.sample))
    every[near.place] = weight
    residual = candidates.offset_px - xi @ prediction.jacobian_by_unknown[:, candidates.sample]
    return _judge(edgels, Fit(xi, every, residual, information, spread_px, stiffness), settings)


class _Near(NamedTuple):
    """The candidates that may belong to a fit: ``place`` (j,) among all, and what the fit needs of them."""

    place: NDArray[np.intp]
    jacobian: Array
    offset: Array
    sigma: Array
    weight: Array
    edge: NDArray[np.intp]

    def residual(self, xi: Array) -> Array:
        return np.asarray(self.offset - xi @ self.jacobian)


def _near(edgels: Edgels, start: Array, reach_px: float) -> _Near:
    """Candidates with a weight within ``reach_px`` of where ``start`` puts the edges."""
    candidates, prediction = edgels.candidates, edgels.prediction
    moved = prediction.jacobian @ start
    far = np.abs(candidates.offset_px - moved[candidates.sample])
    index = np.flatnonzero((far < reach_px) & (edgels.weight > 0.0))
    sample, weight = candidates.sample[index], edgels.weight[index]
    return _Near(
        index,
        prediction.jacobian_by_unknown[:, sample],
        candidates.offset_px[index],
        1.0 / np.sqrt(weight),
        weight,
        prediction.layout.edge[sample],
    )


def _biweight(residual: Array, reach: Array) -> Array:
    """Tukey's weights (1 - (r / reach)²)², zero beyond the reach."""
    weight = residual / reach
    np.square(weight, out=weight)
    np.subtract(1.0, weight, out=weight)
    np.maximum(weight, 0.0, out=weight)
    np.square(weight, out=weight)
    return weight


def _step(jacobian: Array, residual: Array, weight: Array, to_prior: Array, prior: Array) -> tuple[Array, Array]:
    """One weighted Gauss-Newton step: (m,) step, (m, m) information of the points."""
    weighted = jacobian * weight
    information = weighted @ jacobian.T
    normal = information.copy()
    normal.flat[:: len(normal) + 1] += prior
    _, step, failed = dposv(normal, weighted @ residual + prior * to_prior)
    if failed:
        raise FloatingPointError(NOT_SOLVED)
    return step, information


def _stiffness(weight: Array, residual: Array, reach: Array) -> float:
    """How much the biweight's pull really grows with the residuals, over what its weights say: the mean of its
    derivative, (1 - u²) (1 - 5 u²), over that of (1 - u²)².

    0.83 for normal residuals; less where many points lie half way out and pull the less the farther they go.
    """
    inside = np.flatnonzero(weight)
    square = np.minimum((residual[inside] / reach[inside]) ** 2, 1.0)
    base = weight[inside] / np.maximum((1.0 - square) ** 2, 1e-6)
    pull, growth = (1.0 - square) ** 2, (1.0 - square) * (1.0 - 5.0 * square)
    total = float(base @ pull)
    return max(float(base @ growth) / total, SMALLEST_STIFFNESS) if total > 0.0 else 1.0


def _spread(residual: Array, sigma: Array, width: float) -> tuple[float, float]:
    """Robust size of the residuals that may belong to the fit, 1.4826 times their median: over their standard
    deviations, at least 1, and in px.
    """
    size = np.abs(residual)
    near = np.flatnonzero(size < np.minimum(width, INNER_SIGMAS * sigma + INNER_PX))
    if len(near) < FEWEST_SPREAD:
        return 1.0, LARGEST_SPREAD_PX
    size = size[near]
    middle = len(size) // 2
    spread_px = 1.4826 * float(np.partition(size, middle)[middle])
    spread = 1.4826 * float(np.partition(size / sigma[near], middle)[middle])
    return min(max(spread, 1.0), LARGEST_SPREAD), min(max(spread_px, SMALLEST_SPREAD_PX), LARGEST_SPREAD_PX)


def _judge(edgels: Edgels, fit: Fit, settings: RobustFitSettings) -> RobustFit:
    """Count who agrees, and hold it against chance: the density of candidates tells how many would lie in the gate
    anyway.
    """
    candidates, prediction, residual = edgels.candidates, edgels.prediction, fit.residual_px
    active = None if edgels.weight.all() else edgels.weight > 0.0
    edges = len(prediction.line_origin)
    gate_px = GATE_PX * candidates.zoom
    edge_of = prediction.layout.edge
    sample = candidates.sample if active is None else candidates.sample[active]
    close = sample[np.abs(residual if active is None else residual[active]) < gate_px]
    supported = np.zeros(len(edge_of), dtype=bool)
    supported[close] = True
    profiles = prediction.profiles
    some = np.maximum(profiles, 1)
    agreeing = np.bincount(edge_of, supported, edges)
    others = np.bincount(edge_of[sample], minlength=edges) - np.bincount(edge_of[close], minlength=edges)
    # Edge responses end before the profiles do: what was found tells how far candidates reach.
    reach_px = max(float(np.abs(candidates.offset_px).max(initial=0.0)), settings.start_width_px)
    chance = 1.0 - np.exp(others * (-gate_px / max(reach_px - gate_px, 0.5)) / some)
    # Profiles that see the same pixels agree by the same chance.
    variance = profiles * chance * (1.0 - chance) / prediction.independence
    needed = profiles * chance + settings.support_sigmas * np.sqrt(variance)
    share = agreeing / some
    seen = (agreeing >= FEWEST_AGREEING) & (agreeing > needed) & (share >= settings.support_share)
    # What chance supports is scattered, what the gripper supports comes in runs: neighbours are counted, not profiles.
    pair = (edge_of[1:] == edge_of[:-1]) & prediction.ok[1:] & prediction.ok[:-1]
    pairs = int(np.count_nonzero(pair))
    believed = 0.0
    if pairs and np.count_nonzero(seen) >= FEWEST_EDGES:
        agreeing_pairs = pair & supported[1:] & supported[:-1] & seen[edge_of[1:]]
        believed = int(np.count_nonzero(agreeing_pairs)) / pairs
    return RobustFit(
        fit.xi,
        fit.weight,
        residual,
        fit.information,
        fit.spread_px,
        fit.stiffness,
        supported,
        share,
        seen,
        believed,
    )


def assess(
    edgels: Edgels, consensus: RobustFit, prior_information: Array, expected_shared_px: float = 0.0
) -> Uncertainty:
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
            np.zeros(0, dtype=np.intp),
            np.zeros((0, unknowns)),
            *np.zeros((2, 0, unknowns, unknowns)),
            np.zeros((0, unknowns)),
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
    scatter, shared = max(min(contradiction, 1.0), LEAST_SCATTER), 0.0
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
    lasting, cut_off = (
        (np.add.reduceat(pulls, begin, axis=1) * (stiffness * spread_px[seen])).T
        for spread_px in (edgels.edge_spread_px, edgels.cut_off_px)
    )
    middles = scatter * worth[seen][:, None, None] * information + shared * by_stretch
    middles += cut_off[:, :, None] * cut_off[:, None, :]
    # A scatter that is itself estimated from few stretches makes Student's distribution, with this variance.
    student = freedom / (freedom - 2.0) if freedom >= FEWEST_FREE else FEWEST_FREE
    middles, lasting = student * middles, np.sqrt(student) * lasting
    middle = middles.sum(axis=0) + lasting.T @ lasting
    middle.flat[:: len(middle) + 1] += prior_information
    covariance = inverse @ middle @ inverse
    pull = np.add.reduceat(weighted * residual_px, at_edge, axis=1).T
    normal = NormalEquations(seen, pull, stiffness * information, middles, lasting)
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


def contradictions_without(edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings) -> Array:
    fits = []
    for left_out in edgels.prediction.layout.edges.tolist():
        rest = _without(edgels, left_out)
        fits.append(assess(rest, fit_irls(rest, prior, start, settings), prior.information))
    return np.array([fit.contradiction for fit in fits])
