"""The joint fit and its covariance in machine code.

k edgel hypotheses sorted by search line, n search lines, e edges of the gripper, g stretches of agreed points, m
unknowns (m, rad).  Inside, everything has :data:`SIZE` unknowns: without a jaw the seventh has no derivative, and a
prior that holds it at zero.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gripmon.model.compiled import compiled
from gripmon.model.least_squares import TUKEY

SIZE = 7
"""Unknowns of a gripper with a jaw: sums of a size that is known beforehand are compiled without loops."""

WIDTH_DECAY = 0.4
"""What is left of the width that covers the start's error, from round to round."""

CONVERGED_SQUARED_STEP = 0.04
"""Squared step over its covariance, a fifth of a standard deviation, below which one of the last three rounds ends the
fit; what is still to come is less.
"""

LARGEST_SPREAD_PX = 1.0
"""Robust spread (px) beyond which edge points are not believed to show the gripper's edges."""

LARGEST_SPREAD, SMALLEST_SPREAD_PX, FEWEST_SPREAD = 3.0, 0.05, 12
"""Bounds of the robust spread, in standard deviations and px, and the least number of residuals that it is estimated
from.
"""

INNER_SIGMAS, INNER_PX = 4.0, 0.3
"""The robust spread is estimated from residuals within 4 standard deviations and 0.3 px, however wide the weight is."""

SMALLEST_STIFFNESS = 0.2
"""Least stiffness (no unit; 0.83 for normal residuals): where most points lie half way out it nears zero, and the
covariance would grow without bound.
"""

FEWEST_EDGES = 3
"""Edges that must be seen for a fit to be believed at all."""

FEWEST_AGREEING = 5
"""Search lines of an edge that must agree for it to count as seen."""

LEAST_SCATTER = 0.1
"""Factor by which the scatter of the stretches may lower the points' variances at most."""

FEWEST_FREE = 3
"""Degrees of freedom from which the scatter of stretches is judged: Student's distribution has no variance with
fewer.
"""


@compiled
def fit(
    sample: Any, offset_px: Any, weight: Any, jacobian: Any, edge: Any, ok: Any, independence: Any, edge_spread_px: Any,
    mean: Any, prior: Any, start: Any, width_px: float, rounds: int, start_width_px: float, gate_px: float,
    support_sigmas: float, support_share: float,
) -> Any:  # fmt: skip
    """``robust_fit.fit_irls``: whether it could be solved, then the fields of ``RobustFit`` in their order."""
    count = len(start)
    near = _near(sample, offset_px, weight, jacobian, edge, start, max(width_px, TUKEY * LARGEST_SPREAD_PX))
    unknowns, wanted, held = np.zeros(SIZE), np.zeros(SIZE), np.ones(SIZE)
    for i in range(count):
        unknowns[i], wanted[i], held[i] = start[i], mean[i], prior[i]
    solved, final, information, spread_px, stiffness = _irls(
        near, edge_spread_px, wanted, held, unknowns, width_px, rounds, start_width_px
    )
    every, residual_px = np.zeros(len(sample)), np.empty(len(sample))
    place = near[0]
    for j in range(len(place)):
        every[place[j]] = final[j]
    for k in range(len(sample)):
        residual_px[k] = offset_px[k]
        for i in range(count):
            residual_px[k] -= unknowns[i] * jacobian[sample[k], i]
    supported, share, seen, believed = _judge(
        sample, offset_px, weight, residual_px, edge, ok, independence,
        start_width_px, gate_px, support_sigmas, support_share,
    )  # fmt: skip
    own, own_information = unknowns[:count].copy(), information[:count, :count].copy()
    fitted = own, every, residual_px, own_information, spread_px, stiffness, supported, share, seen, believed
    return solved, fitted


@compiled
def _near(
    sample: Any, offset_px: Any, weight: Any, jacobian: Any, edge: Any, start: Any, reach_px: float
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """The j edgel hypotheses with a weight within ``reach_px`` of where ``start`` (m,) puts the edges: place among all,
    jacobian (j, SIZE), offset, sigma, weight and edge.
    """
    place = np.empty(len(sample), np.intp)
    count = 0
    for k in range(len(sample)):
        moved = 0.0
        for i in range(len(start)):
            moved += jacobian[sample[k], i] * start[i]
        if abs(offset_px[k] - moved) < reach_px and weight[k] > 0.0:
            place[count] = k
            count += 1
    place = place[:count]
    own_jacobian = np.zeros((count, SIZE))
    offset, sigma, own_weight = np.empty(count), np.empty(count), np.empty(count)
    own_edge = np.empty(count, np.intp)
    for j in range(count):
        k = place[j]
        offset[j], own_weight[j], own_edge[j] = offset_px[k], weight[k], edge[sample[k]]
        sigma[j] = 1.0 / math.sqrt(weight[k])
        for i in range(len(start)):
            own_jacobian[j, i] = jacobian[sample[k], i]
    return place, own_jacobian, offset, sigma, own_weight, own_edge


@compiled
def _irls(
    near: Any, edge_spread_px: Any, mean: Any, prior: Any, xi: Any, width: float, rounds: int, start_width_px: float,
) -> tuple[bool, Any, Any, float, float]:  # fmt: skip
    """Iteratively re-weighted least squares; ``xi`` (SIZE,) is moved from the start to the fit.  Whether all could be
    solved, weights of the edgel hypotheses near by, 1/px², information (SIZE, SIZE), spread (px) and stiffness.

    From round to round the width, at first that of the start's error, decays, and the robust spread s of the residuals
    takes over: an edgel hypothesis counts by Tukey's weight (1 - (r / reach)²)², zero beyond its reach, which is the
    root of width² + (TUKEY s sigma)², at most max(width, TUKEY times the spread in px).  All points of an edge together
    are worth no more than one with the spread that they share: w / (1 + spread² sum w).
    """
    _, jacobian, offset, sigma, base, edge = near
    count = len(offset)
    residual, reach, weight, buffer = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    on_edge = np.empty(len(edge_spread_px))
    information, normal, step = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(SIZE)
    spread, spread_px, solved = 1.0, LARGEST_SPREAD_PX, True
    _residuals(jacobian, offset, xi, residual)
    for round_ in range(rounds):
        if round_:
            width *= WIDTH_DECAY
            spread, spread_px = _spread(residual, sigma, start_width_px, buffer)
        on_edge[:] = 0.0
        farthest = max(width, TUKEY * spread_px)
        for j in range(count):
            own = TUKEY * spread * sigma[j]
            reach[j] = min(math.sqrt(width * width + own * own), farthest)
            inside = residual[j] / reach[j]
            inside = max(1.0 - inside * inside, 0.0)
            weight[j] = inside * inside * base[j]
        for j in range(count):
            on_edge[edge[j]] += weight[j]
        for e in range(len(on_edge)):
            on_edge[e] = 1.0 / (1.0 + edge_spread_px[e] ** 2 * on_edge[e])
        for j in range(count):
            weight[j] *= on_edge[edge[j]]
        # One Gauss-Newton step: (J' W J + P) step = J' W r + P (mean - xi).
        information[:], step[:] = 0.0, 0.0
        for j in range(count):
            if weight[j] == 0.0:
                continue
            for i in range(SIZE):
                weighted = weight[j] * jacobian[j, i]
                step[i] += weighted * residual[j]
                for k in range(i + 1):
                    information[i, k] += weighted * jacobian[j, k]
        for i in range(SIZE):
            for k in range(SIZE):
                normal[i, k] = information[i, k]
            normal[i, i] += prior[i]
            step[i] += prior[i] * (mean[i] - xi[i])
        solved = _factorise(normal)
        if not solved:
            break
        _solve(normal, step)
        length = 0.0
        for i in range(SIZE):
            for k in range(i):
                information[k, i] = information[i, k]
                length += 2.0 * step[i] * information[i, k] * step[k]
            length += step[i] * information[i, i] * step[i]
            xi[i] += step[i]
        _residuals(jacobian, offset, xi, residual)
        if round_ >= rounds - 3 and length < CONVERGED_SQUARED_STEP:
            break
    return solved, weight, information, spread_px, _stiffness(weight, residual, reach)


@compiled
def _residuals(jacobian: Any, offset: Any, xi: Any, residual: Any) -> None:
    for j in range(len(offset)):
        predicted = 0.0
        for i in range(SIZE):
            predicted += jacobian[j, i] * xi[i]
        residual[j] = offset[j] - predicted


@compiled
def _spread(residual: Any, sigma: Any, width: float, buffer: Any) -> tuple[float, float]:
    """Robust size of the residuals that may belong to the fit, 1.4826 times the median of their absolute values:
    over their standard deviations, at least 1, and in px.  ``buffer`` (j,) is overwritten.
    """
    count = 0
    for j in range(len(residual)):
        if abs(residual[j]) < min(width, INNER_SIGMAS * sigma[j] + INNER_PX):
            buffer[count] = abs(residual[j])
            count += 1
    if count < FEWEST_SPREAD:
        return 1.0, LARGEST_SPREAD_PX
    spread_px = 1.4826 * _nth(buffer, count, count // 2)
    count = 0
    for j in range(len(residual)):
        if abs(residual[j]) < min(width, INNER_SIGMAS * sigma[j] + INNER_PX):
            buffer[count] = abs(residual[j]) / sigma[j]
            count += 1
    spread = 1.4826 * _nth(buffer, count, count // 2)
    return min(max(spread, 1.0), LARGEST_SPREAD), min(max(spread_px, SMALLEST_SPREAD_PX), LARGEST_SPREAD_PX)


@compiled
def _nth(values: Any, count: int, nth: int) -> float:
    """The value that would stand at ``nth`` if the first ``count`` were sorted; moves them about (Hoare's "find")."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[nth], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < nth:
            low = i
        if nth < i:
            high = j
    return float(values[nth])


@compiled
def _stiffness(weight: Any, residual: Any, reach: Any) -> float:
    """How much the biweight's pull really grows with the residuals, over what its weights say: the mean of its
    derivative, (1 - u²) (1 - 5 u²) with u = r / reach, over that of (1 - u²)².

    0.83 for normal residuals; less where many points lie half way out and pull the less the farther they go.
    """
    pull, growth = 0.0, 0.0
    for j in range(len(weight)):
        if weight[j] != 0.0:
            square = min((residual[j] / reach[j]) ** 2, 1.0)
            inside = (1.0 - square) ** 2
            base = weight[j] / max(inside, 1e-6)
            pull += base * inside
            growth += base * (1.0 - square) * (1.0 - 5.0 * square)
    return max(growth / pull, SMALLEST_STIFFNESS) if pull > 0.0 else 1.0


@compiled
def _judge(
    sample: Any, offset_px: Any, weight: Any, residual_px: Any, edge: Any, ok: Any, independence: Any,
    start_width_px: float, gate_px: float, support_sigmas: float, support_share: float,
) -> tuple[Any, Any, Any, float]:  # fmt: skip
    """The inliers: search lines (n,), each edge's ratio and whether it is seen (e,), and the ratio of pairs.

    Held against chance: the density of edgel hypotheses tells how many would lie in the gate anyway, of N independent
    search lines N p +- sqrt(N p (1 - p)); search lines that see the same pixels agree by the same chance.  Edge
    responses end before the search lines do: what was found tells how far edgel hypotheses reach.  What chance supports
    is scattered, what the gripper supports comes in runs: neighbours are counted, not search lines.
    """
    supported, edges = np.zeros(len(edge), np.bool_), len(independence)
    profiles, agreeing, others = np.zeros(edges), np.zeros(edges), np.zeros(edges)
    reach_px = start_width_px
    for k in range(len(sample)):
        reach_px = max(reach_px, abs(offset_px[k]))
        if weight[k] > 0.0:
            if abs(residual_px[k]) < gate_px:
                supported[sample[k]] = True
            else:
                others[edge[sample[k]]] += 1.0
    for n in range(len(edge)):
        profiles[edge[n]] += ok[n]
        agreeing[edge[n]] += supported[n]
    share, seen, seen_edges = np.empty(edges), np.zeros(edges, np.bool_), 0
    for e in range(edges):
        some = max(profiles[e], 1.0)
        chance = 1.0 - math.exp(others[e] * (-gate_px / max(reach_px - gate_px, 0.5)) / some)
        variance = profiles[e] * chance * (1.0 - chance) / independence[e]
        needed = profiles[e] * chance + support_sigmas * math.sqrt(variance)
        share[e] = agreeing[e] / some
        seen[e] = agreeing[e] >= FEWEST_AGREEING and agreeing[e] > needed and share[e] >= support_share
        seen_edges += seen[e]
    pairs, agreeing_pairs = 0, 0
    for n in range(1, len(edge)):
        if edge[n] == edge[n - 1] and ok[n] and ok[n - 1]:
            pairs += 1
            agreeing_pairs += supported[n] and supported[n - 1] and seen[edge[n]]
    believed = agreeing_pairs / pairs if pairs and seen_edges >= FEWEST_EDGES else 0.0
    return supported, share, seen, believed


@compiled
def _factorise(matrix: Any) -> bool:
    """Cholesky's factor (lower) in place of a matrix (SIZE, SIZE); whether it is positive definite."""
    for i in range(SIZE):
        for k in range(i + 1):
            total = matrix[i, k]
            for j in range(k):
                total -= matrix[i, j] * matrix[k, j]
            if k < i:
                matrix[i, k] = total / matrix[k, k]
            elif total > 0.0:
                matrix[i, i] = math.sqrt(total)
            else:
                return False
    return True


@compiled
def _solve(factor: Any, vector: Any) -> None:
    """Solve with Cholesky's factor, in place of ``vector`` (SIZE,)."""
    for i in range(SIZE):
        for j in range(i):
            vector[i] -= factor[i, j] * vector[j]
        vector[i] /= factor[i, i]
    for i in range(SIZE - 1, -1, -1):
        for j in range(i + 1, SIZE):
            vector[i] -= factor[j, i] * vector[j]
        vector[i] /= factor[i, i]


@compiled
def assess(
    sample: Any, weight: Any, residual_px: Any, information: Any, stiffness: float, jacobian: Any, edge: Any,
    stretch: Any, edge_spread_px: Any, cut_off_px: Any, prior: Any, expected_shared_px: float,
) -> Any:  # fmt: skip
    """The covariance of ``robust_fit.assess``, which gives the equation: whether it could be solved, then
    covariance, line weights, shared spread and contradiction, and edge, pull, information, middle and lasting of
    the ``NormalEquations``.
    """
    unknowns, line_weight = len(prior), np.zeros(len(weight))
    worth = _worth(sample, weight, edge, edge_spread_px)
    first, total, moment, pulls = _stretches(sample, weight, residual_px, jacobian, edge, stretch, worth)
    contradiction = _contradiction(total, moment, unknowns)
    freedom = len(total) - unknowns
    scatter, shared = max(min(contradiction, 1.0), LEAST_SCATTER), 0.0
    if contradiction > 1.0:
        shared = (contradiction - 1.0) * len(total) / total.sum()
    if len(total):
        shared = max(shared, (stiffness * expected_shared_px) ** 2)
    # A scatter that is itself estimated from few stretches makes Student's distribution, with this variance.
    student = freedom / (freedom - 2.0) if freedom >= FEWEST_FREE else float(FEWEST_FREE)
    # Sums over each edge: of points, of stretches, and of the edge as a whole.
    of_edge, seen, last = np.empty(len(first), np.intp), np.empty(len(first), np.intp), 0
    for g in range(len(first)):
        at = edge[sample[first[g]]]
        if g == 0 or at != seen[last - 1]:
            seen[last] = at
            last += 1
        of_edge[g] = last - 1
    seen = seen[:last]
    pull, whole = np.zeros((last, unknowns)), np.zeros((last, unknowns))
    of_points, middle = np.zeros((last, unknowns, unknowns)), np.zeros((last, unknowns, unknowns))
    g = -1
    for k in range(len(sample)):
        if weight[k] != 0.0:
            if g + 1 < len(first) and first[g + 1] == k:
                g += 1
            v, n = of_edge[g], sample[k]
            for i in range(unknowns):
                weighted = weight[k] * jacobian[n, i]
                pull[v, i] += weighted * residual_px[k]
                for j in range(i + 1):
                    of_points[v, i, j] += weighted * jacobian[n, j]
            line_weight[k] = weight[k] / worth[edge[n]] * stiffness**2 / (scatter + shared * total[g])
    for g in range(len(first)):
        for i in range(unknowns):
            whole[of_edge[g], i] += pulls[g, i]
            for j in range(i + 1):
                middle[of_edge[g], i, j] += shared * pulls[g, i] * pulls[g, j]
    for v in range(last):
        for i in range(unknowns):
            for j in range(i + 1):
                of_whole = (stiffness * cut_off_px[seen[v]]) ** 2 * whole[v, i] * whole[v, j]
                middle[v, i, j] += scatter * worth[seen[v]] * of_points[v, i, j] + of_whole
                middle[v, i, j] *= student
                of_points[v, i, j] *= stiffness
                middle[v, j, i], of_points[v, j, i] = middle[v, i, j], of_points[v, i, j]
        for i in range(unknowns):
            whole[v, i] *= math.sqrt(student) * stiffness * edge_spread_px[seen[v]]
    filled = middle.copy()
    for v in range(last):
        for i in range(unknowns):
            for j in range(unknowns):
                filled[v, i, j] += whole[v, i] * whole[v, j]
    solved, covariance = _sandwich(stiffness, information, prior, filled)
    shared_px = math.sqrt(shared) / stiffness
    return solved, (covariance, line_weight, shared_px, contradiction), (seen, pull, of_points, middle, whole)


@compiled
def _worth(sample: Any, weight: Any, edge: Any, edge_spread_px: Any) -> Any:
    """(e,) 1 - spread² sum w: by what the weights of an edge's points were limited for what they share; w over this is
    what a point is worth alone.
    """
    worth = np.zeros(len(edge_spread_px))
    for k in range(len(sample)):
        worth[edge[sample[k]]] += weight[k]
    return 1.0 - edge_spread_px**2 * worth


@compiled
def _stretches(
    sample: Any, weight: Any, residual_px: Any, jacobian: Any, edge: Any, stretch: Any, worth: Any
) -> tuple[Any, Any, Any, Any]:
    """For each stretch with agreed points its first one, the sums of their weights alone and with the residuals, and
    (g, m) of weight times Jacobian.
    """
    first, count, now = np.empty(len(sample), np.intp), 0, -1
    for k in range(len(sample)):
        if weight[k] != 0.0 and stretch[sample[k]] != now:
            now = stretch[sample[k]]
            first[count] = k
            count += 1
    first = first[:count]
    total, moment, pulls = np.zeros(count), np.zeros(count), np.zeros((count, jacobian.shape[1]))
    for g in range(count):
        for k in range(first[g], first[g + 1] if g + 1 < count else len(sample)):
            n = sample[k]
            alone = weight[k] / worth[edge[n]]
            total[g] += alone
            moment[g] += alone * residual_px[k]
            for i in range(jacobian.shape[1]):
                pulls[g, i] += weight[k] * jacobian[n, i]
    return first, total, moment, pulls


@compiled
def _contradiction(total: Any, moment: Any, unknowns: int) -> float:
    """Weighted squares of the stretches' means over their degrees of freedom; 1 where too few stretches are left.

    Above 1 it gives tau² = (contradiction - 1) * stretches / sum of their weights.
    """
    freedom = len(total) - unknowns
    if freedom < FEWEST_FREE:
        return 1.0
    squares = 0.0
    for g in range(len(total)):
        squares += moment[g] ** 2 / total[g]
    return squares / freedom


@compiled
def _sandwich(stiffness: float, information: Any, prior: Any, middle: Any) -> tuple[bool, Any]:
    """H^-1 (sum of ``middle`` + P) H^-1 with H = k N + P, (m, m); and whether H is positive definite."""
    count = len(prior)
    bread, filling = np.eye(SIZE), np.zeros((SIZE, SIZE))
    for i in range(count):
        filling[i, i] = prior[i]
        for j in range(count):
            bread[i, j] = stiffness * information[i, j]
            for v in range(len(middle)):
                filling[i, j] += middle[v, i, j]
        bread[i, i] += prior[i]
    if not _factorise(bread):
        return False, filling[:count, :count].copy()
    for _ in range(2):
        for i in range(SIZE):
            _solve(bread, filling[i])
        filling = filling.T.copy()
    return True, 0.5 * (filling + filling.T)[:count, :count].copy()


@compiled
def contradictions_without(
    left_out: Any, sample: Any, offset_px: Any, weight: Any, jacobian: Any, edge: Any, stretch: Any,
    edge_spread_px: Any, mean: Any, prior: Any, start: Any, width_px: float, rounds: int,
) -> Any:  # fmt: skip
    """(v,) contradiction that stays in a fit from ``start`` without each of the edges ``left_out`` (v,); NaN where it
    can't be solved.
    """
    count = len(start)
    out = np.full(len(left_out), np.nan)
    wanted, held = np.zeros(SIZE), np.ones(SIZE)
    for i in range(count):
        wanted[i], held[i] = mean[i], prior[i]
    for v in range(len(left_out)):
        rest = weight.copy()
        for k in range(len(sample)):
            if edge[sample[k]] == left_out[v]:
                rest[k] = 0.0
        near = _near(sample, offset_px, rest, jacobian, edge, start, max(width_px, TUKEY * LARGEST_SPREAD_PX))
        xi = np.zeros(SIZE)
        for i in range(count):
            xi[i] = start[i]
        solved, final, _, _, _ = _irls(near, edge_spread_px, wanted, held, xi, width_px, rounds, width_px)
        residual_px, place = np.empty(len(final)), near[0]
        _residuals(near[1], near[2], xi, residual_px)
        own_sample = sample[place]
        worth = _worth(own_sample, final, edge, edge_spread_px)
        _, total, moment, _ = _stretches(own_sample, final, residual_px, jacobian, edge, stretch, worth)
        if solved:
            out[v] = _contradiction(total, moment, count)
    return out
