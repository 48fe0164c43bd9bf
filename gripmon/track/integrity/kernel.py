"""The arithmetic behind a frame's protection level, compiled: fits under h hypotheses, alone and with the anchor,
knocks since, and the bank of filters behind the anchor.

h hypotheses, v edges, f parts of the gripper, m unknowns of which the first n are asked for, g averages; lengths in m
and rad.  What they are for stands in :mod:`~gripmon.track.integrity.separation`.  Tests hold each against the function
of its name in ``tests/support/by_numpy/integrity.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gripmon.model.compiled import compiled
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@compiled
def _root(matrix: Array, root: Array) -> bool:
    """Cholesky's lower ``root`` (m, m), its diagonal inverted; False for a matrix that isn't positive definite."""
    for i in range(len(root)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest * root[j, j]
            elif rest > 0.0:
                root[i, i] = 1.0 / math.sqrt(rest)
            else:
                return False
    return True


@compiled
def _invert(root: Array, inverse: Array, upper: Array) -> None:
    """``inverse`` (m, m) of the matrix that has the ``root``, and its root: U U' of ``upper`` U (m, m)."""
    m = len(root)
    for j in range(m):
        upper[j, j] = root[j, j]
        for i in range(j):
            upper[j, i] = 0.0
        for i in range(j + 1, m):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * upper[j, k]
            upper[j, i] = total * root[i, i]
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, m):
                total += upper[i, k] * upper[j, k]
            inverse[i, j] = inverse[j, i] = total


@compiled
def _inverse(matrix: Array, inverse: Array, root: Array, upper: Array) -> bool:
    """``inverse`` of a symmetric matrix, (m, m) each: by Cholesky's root, as :func:`_invert`; False, and ``upper`` the
    inverse, too, where rounding has left none, by elimination.  LinAlgError for a singular one.
    """
    if _root(matrix, root):
        _invert(root, inverse, upper)
        return True
    inverted = np.linalg.inv(matrix)
    for i in range(len(inverted)):
        for k in range(len(inverted)):
            inverse[i, k] = upper[i, k] = inverted[i, k]
    return False


@compiled
def square(covariance: Array, values: Array, root: Array, white: Array) -> float:
    """Normalised square v' C^-1 v of ``values`` (m,) by their covariance (m, m), as :func:`_inverse` has it; ``root``
    and ``white`` (m,) are overwritten.
    """
    total = 0.0
    if not _root(covariance, root):
        inverse = np.linalg.inv(covariance)
        for i in range(len(white)):
            white[i] = 0.0
            for k in range(len(white)):
                white[i] += inverse[i, k] * values[k]
            total += values[i] * white[i]
        return total
    for i in range(len(root)):
        rest = values[i]
        for k in range(i):
            rest -= root[i, k] * white[k]
        white[i] = rest * root[i, i]
        total += white[i] * white[i]
    return total


@compiled
def add_up(
    pull: Array,
    information: Array,
    middle: Array,
    model: Array,
    part: Ints,
    parts: int,
    keep: Array,
    known: Array,
    known_pull: Array,
) -> tuple[Array, Array, Array, Array]:
    """Sums over the kept edges, ``keep`` (h, v) of 0 and 1, and what is known besides: pull (h, m), normal matrix and
    spread (h, m, m), and pulls by the model (h, f, m): each edge's ``model`` (p, v, m) by the ``part`` (p, v) of it.
    """
    count, (edges, m) = len(keep), pull.shape
    sums, normal, spread = known_pull.copy(), known.copy(), known.copy()
    of_model, kept = np.zeros((count, parts, m)), np.empty(edges, np.intp)
    for h in range(count):
        number = 0
        for v in range(edges):
            if keep[h, v] == 0.0:
                continue
            kept[number], number = v, number + 1
            for i in range(m):
                sums[h, i] += pull[v, i]
                for p in range(len(part)):
                    of_model[h, part[p, v], i] += model[p, v, i]
        for i in range(m):
            for j in range(i + 1):
                one, other = normal[h, i, j], spread[h, i, j]
                for k in range(number):
                    one, other = one + information[kept[k], i, j], other + middle[kept[k], i, j]
                normal[h, i, j] = normal[h, j, i] = one
                spread[h, i, j] = spread[h, j, i] = other
    return sums, normal, spread, of_model


@compiled
def _around(matrix: Array, middle: Array, half: Array, out: Array) -> None:
    """``out`` = A' B A of a ``matrix`` A and a symmetric ``middle`` B, (m, m) each; ``half`` is overwritten."""
    m = len(matrix)
    for i in range(m):
        for j in range(m):
            total = 0.0
            for k in range(m):
                total += matrix[k, i] * middle[k, j]
            half[i, j] = total
        for j in range(i + 1):
            total = 0.0
            for k in range(m):
                total += half[i, k] * matrix[k, j]
            out[i, j] = out[j, i] = total


@compiled
def separate(sums: Array, normal: Array, spread: Array, of_model: Array, unknowns: int) -> tuple[Array, Array, Array]:
    """The fits from their sums, N^-1 of the normal matrices N being the first n = ``unknowns`` rows of their inverses:
    shift N^-1 pull (h, n), covariance N^-1 spread N^-1 (h, n, n), and error by the model N^-1 of_model (h, f, n).
    """
    (count, m), n, fingers = sums.shape, unknowns, of_model.shape[1]
    shift, covariance, off = np.zeros((count, n)), np.empty((count, n, n)), np.zeros((count, fingers, n))
    inverse, root, upper = np.empty((m, m)), np.empty((m, m)), np.empty((m, m))
    for h in range(count):
        rooted = _inverse(normal[h], inverse, root, upper)
        for i in range(n):
            total = 0.0
            for j in range(m):
                total += inverse[i, j] * sums[h, j]
            shift[h, i] = total
        for f in range(fingers):
            if of_model[h, f].any():  # most edges of a gripper are seen in no frame
                for i in range(n):
                    total = 0.0
                    for j in range(m):
                        total += inverse[i, j] * of_model[h, f, j]
                    off[h, f, i] = total
        # U (U' spread U) U': multiplied by N^-1 itself, an open direction takes the digits of all others.
        middle, half = spread[h], root
        if rooted:
            _around(upper, spread[h], half, inverse)
            middle = inverse
        for i in range(n):
            for j in range(m):
                total = 0.0
                for k in range(m):
                    total += upper[i, k] * middle[k, j]
                half[i, j] = total
            for j in range(i + 1):
                total = 0.0
                for k in range(m):
                    total += half[i, k] * upper[j, k]
                covariance[h, i, j] = covariance[h, j, i] = total
    return shift, covariance, off


@compiled
def with_pose(
    sums: Array, normal: Array, spread: Array, of_model: Array, at: Array, covariance: Array, off: Array
) -> tuple[Array, Array, Array, Array]:
    """The sums with a pose that is known besides: ``at`` (6,), its ``covariance`` C (6, 6), ``off`` (f or 1, 6) by the
    model.  C^-1 at, C^-1 and C^-1 off are added to the pulls, to the matrices, and to the pulls by the model.
    """
    sums, normal, spread, of_model = sums.copy(), normal.copy(), spread.copy(), of_model.copy()
    root, information, between = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    _inverse(covariance, information, root, between)
    for i in range(6):
        pull = 0.0
        for j in range(6):
            pull += information[i, j] * at[j]
        for h in range(len(sums)):
            sums[h, i] += pull
            for j in range(6):
                normal[h, i, j] += information[i, j]
                spread[h, i, j] += information[i, j]
        for f in range(of_model.shape[1]):
            pull = 0.0
            for j in range(6):
                pull += off[min(f, len(off) - 1), j] * information[j, i]
            for h in range(len(sums)):
                of_model[h, f, i] += pull
    return sums, normal, spread, of_model


@compiled
def between(covariance: Array, off: Array, more: Array, other: Array, times: float, out: Array) -> None:
    """``out`` (6, 6): covariance of the difference of two poses, ``times`` the one's ``covariance`` and ``more``, and
    what their errors by the model, ``off`` (f, 6) and ``other`` (f or 1, 6), have not in common.
    """
    for i in range(6):
        for j in range(i + 1):
            out[i, j] = times * covariance[i, j] + more[i, j]
    for f in range(len(off)):
        g = min(f, len(other) - 1)
        if off[f].any() or other[g].any():
            for i in range(6):
                for j in range(i + 1):
                    out[i, j] += (off[f, i] - other[g, i]) * (off[f, j] - other[g, j])
    for i in range(6):
        for j in range(i):
            out[j, i] = out[i, j]


@compiled
def squares(shift: Array, at: Array, covariance: Array, off: Array, times: float, more: Array, other: Array) -> Array:
    """Normalised squares (h,) of shifts (h, 6) from ``at`` (6,), by :func:`between`."""
    out, root, white, both = np.empty(len(shift)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    for h in range(len(shift)):
        between(covariance[h], off[h], more, other, times, both)
        out[h] = square(both, shift[h] - at, root, white)
    return out


@compiled
def refitted(
    predicted_T: Array,
    xi: Array,
    pull: Array,
    information: Array,
    middle: Array,
    lasting: Array,
    edge: Ints,
    finger: Ints,
    fingers: int,
    longer: Array,
    keep: Array,
    opening: Bools,
    vague: Array,
    way_m: float,
    sigma_m: float,
    anchor_T: Array,
    known: Array,
    known_off: Array,
    times: float,
    together: bool,
) -> tuple[Array, Array, tuple[Array, Array, Array], tuple[Array, Array, Array], Array]:
    """A frame's fit under h hypotheses: its pose (4, 4), ``xi`` (m,) from the prediction, and where ``anchor_T`` (4, 4)
    is from there (6,); then the fits' shifts, covariances and errors by the model by the kept edges alone, the same
    with the anchor's pose, of a covariance ``known`` (6, 6) and errors by the model ``known_off`` (f or 1, 6), none of
    these if they aren't asked for ``together``, and the normalised squares (h,) of the former's distances from it.

    ``pull`` to ``lasting``, of the edges ``edge`` (v,): as the fit has them; ``finger`` (e,) of each edge, of so many
    ``fingers``, and by how much one may be ``longer`` (3,), gripper frame, m: it pulls at a fit by all its edges
    together, an edge that lies beside its place by itself, alike in every frame.  ``vague`` (m,): information that
    keeps the unknowns solvable whatever is seen; an opening that is known is off the fit's by ``way_m``, with the
    standard deviation ``sigma_m``, but for the hypotheses that doubt it, ``opening`` (h,).
    """
    count, (edges, m) = len(keep), pull.shape
    fit_T = perturb(predicted_T, xi[:6])
    at = perturbation_between(fit_T, anchor_T)
    held, held_pull = np.zeros((count, m, m)), np.zeros((count, m))
    for h in range(count):
        for i in range(m):
            held[h, i, i] = vague[i]
        if m == 7:
            if not opening[h]:
                held[h, 6, 6] = max(sigma_m, 1e-6) ** -2
            held_pull[h, 6] = held[h, 6, 6] * way_m
    model, part, tip = np.empty((2, edges, m)), np.empty((2, edges), np.intp), np.zeros(3)
    for i in range(3):
        for k in range(3):
            tip[i] += fit_T[i, k] * longer[k]
    for v in range(edges):
        part[0, v], part[1, v] = finger[edge[v]], fingers + edge[v]
        for i in range(m):
            model[0, v, i], model[1, v, i] = 0.0, lasting[v, i]
            for k in range(3):
                model[0, v, i] += information[v, i, k] * tip[k]
    parts = fingers + len(finger)
    sums, normal, spread, of_model = add_up(
        pull, information, middle, model, part, parts, keep, held, held_pull
    )  # fmt: skip
    alone = separate(sums, normal, spread, of_model, 6)
    asked = len(sums) if together else 0
    sums, normal, spread, of_model = with_pose(
        sums[:asked], normal[:asked], spread[:asked], of_model[:asked], at, known, known_off
    )  # fmt: skip
    with_it = separate(sums, normal, spread, of_model, 6)
    return fit_T, at, alone, with_it, squares(alone[0], at, alone[1], alone[2], times, known, known_off)


@compiled
def _blend(mean: Array, other: Array, gain: Array, backward: bool, out: Array) -> None:
    """``out`` (6,): mean + K (other - mean), ``gain`` K'; the roles swapped if ``backward``."""
    first, last = (other, mean) if backward else (mean, other)
    for i in range(6):
        out[i] = first[i]
    for k in range(6):
        way = last[k] - first[k]
        for i in range(6):
            out[i] += gain[k, i] * way


@compiled
def join(
    mean: Array,
    before: Array,
    off: Array,
    measured: tuple[Array, Array, Array],
    out: tuple[Array, Array, Array],
    work: Array,
) -> float:
    """One more measurement of a pose, as in a Kalman filter; the trace of its gain.  With P = ``before`` (6, 6), the
    covariance R of what was ``measured`` and the gain K = P (P + R)^-1, ``out`` is mean + K (shift - mean) (6,), the
    covariance K R (6, 6) and the errors by the model off + K (of_model - off) (f, 6), ``off`` (f or 1, 6).
    ``work`` (4, 6, 6) is overwritten.

    P, R or both may leave directions open: a product of K and R, large each, has lost the other directions' digits.
    With the smaller one C of P and R, L L' = P + R and V = L^-1 C, K R is C - V' V, and K' is L'^-1 V: symmetric, no
    variance larger than before, and off by no more than C is by rounding.
    """
    shift, covariance, of_model = measured
    new_mean, new_covariance, new_off = out
    both, root, white, gain = work[0], work[1], work[2], work[3]
    larger = 0.0
    for i in range(6):
        for j in range(6):
            both[i, j] = before[i, j] + covariance[i, j]
        if both[i, i] > 0.0:
            larger += (before[i, i] - covariance[i, i]) / both[i, i]
    backward = larger > 0.0  # from what was measured to the mean, which is known less well
    for i in range(6):
        for j in range(6):
            new_covariance[i, j] = gain[i, j] = covariance[i, j] if backward else before[i, j]
    if _root(both, root):
        for i in range(6):
            for k in range(i):
                for j in range(6):
                    gain[i, j] -= root[i, k] * gain[k, j]
            for j in range(6):
                gain[i, j] *= root[i, i]
                white[i, j] = gain[i, j]
        for k in range(6):
            for i in range(6):
                for j in range(i + 1):
                    new_covariance[i, j] -= white[k, i] * white[k, j]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                for j in range(6):
                    gain[i, j] -= root[k, i] * gain[k, j]
            for j in range(6):
                gain[i, j] *= root[i, i]
    else:
        smaller, inverse = new_covariance.copy(), np.linalg.inv(both)
        for i in range(6):
            for j in range(6):
                gain[i, j] = 0.0
                for k in range(6):
                    gain[i, j] += inverse[i, k] * smaller[k, j]
        for i in range(6):
            for j in range(i + 1):
                for k in range(6):
                    new_covariance[i, j] -= smaller[i, k] * gain[k, j]
    taken = 0.0
    for i in range(6):
        taken += gain[i, i]
        for j in range(i):
            new_covariance[j, i] = new_covariance[i, j]
    _blend(mean, shift, gain, backward, new_mean)
    for f in range(len(new_off)):
        before_off = off[min(f, len(off) - 1)]
        if before_off.any() or of_model[f].any():
            _blend(before_off, of_model[f], gain, backward, new_off[f])
        else:
            for i in range(6):
                new_off[f, i] = 0.0
    return 6.0 - taken if backward else taken


@compiled
def jumped(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    prior: Array,
    stays: Bools,
    times: float,
    enough: Array,
) -> Array:
    """Probabilities (h, c) of the jumps that may have carried a pose away from where it is known to have been, given
    a frame's fits ``shift`` (h, 6) with their ``covariance`` R (h, 6, 6) and errors by the model, ``off`` (h, f, 6).

    ``at`` (6,) with its covariance ``known`` C (6, 6) and ``known_off`` (f or 1, 6): the pose before; ``jumps`` J
    (c, 6, 6), of the probability ``prior`` (h, c) each; ``stays`` (h,): whether it may as well have stayed.  By Bayes a
    jump's probability is its prior times the normal density of the fit with ``times`` R + C + J (and :func:`between`),
    over the sum of these and of having stayed.  Where they are together no more than ``enough`` (h,) though the fit
    were in the middle of the wider densities, which are nowhere higher than the middle of the narrowest: that.
    """
    count, kinds = prior.shape
    root, white, way, log_density = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty(kinds + 1)
    apart, both, out = np.empty((6, 6)), np.empty((6, 6)), np.zeros((count, kinds))
    for h in range(count):
        ever = prior[h].sum()
        if ever == 0.0:
            continue
        between(covariance[h], off[h], known, known_off, times, apart)
        for i in range(6):
            way[i] = shift[h, i] - at[i]
        highest, stay, likelier, solved = -math.inf, max(1.0 - ever, 0.0), 0.0, True
        for c in range(kinds, -1, -1):
            log_density[c] = -math.inf
            if solved and (stays[h] if c == kinds else prior[h, c] > 0.0):
                for i in range(6):
                    for j in range(6):
                        both[i, j] = apart[i, j] + (jumps[c, i, j] if c < kinds else 0.0)
                normalised, scale = square(both, way, root, white), 1.0
                for i in range(6):
                    scale *= root[i, i]
                log_density[c] = math.log(scale) - 0.5 * normalised
                if c == kinds:
                    likelier = math.exp(0.5 * normalised) / stay
                    solved = ever * likelier > enough[h]
            highest = max(highest, log_density[c])
        total = 0.0
        for c in range(kinds):
            out[h, c] = prior[h, c] * (math.exp(log_density[c] - highest) if solved else likelier)
            total += out[h, c]
        if stays[h]:
            total += stay * math.exp(log_density[kinds] - highest)
        for c in range(kinds):
            if solved and total > 0.0:
                out[h, c] /= total
    return out


@compiled
def after_jumps(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    fit: Ints,
    jump: Ints,
    probability: Array,
    share: float,
) -> tuple[Array, Array, Array]:
    """The poses after r of the jumps of :func:`jumped`, by the fits and what was known: :func:`join` of the latter,
    with C + J, and the former, shift (r, 6), covariance (r, 6, 6), and errors by the model (r, f, 6), ``off`` (h, f, 6)
    and ``known_off`` (f or 1, 6).  ``fit`` and ``jump`` (r,): the number of each.  Zeros for those of a
    ``probability`` (r,) of no more than a ``share``.
    """
    count, parts = len(fit), off.shape[1]
    shifts, covariances, offs = np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, parts, 6))
    before, work = np.empty((6, 6)), np.empty((4, 6, 6))
    for r in range(count):
        if probability[r] <= share:
            continue
        h, c = fit[r], jump[r]
        for i in range(6):
            for j in range(6):
                before[i, j] = known[i, j] + jumps[c, i, j]
        of = shift[h], covariance[h], off[h]
        join(at, before, known_off, of, (shifts[r], covariances[r], offs[r]), work)
    return shifts, covariances, offs


@compiled
def knocked(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    share: Array,
    along: Bools,
    prior: Array,
    seen: float,
    unseen: float,
    stays: Bools,
    endless: Bools,
    least: float,
    times: float,
) -> tuple[Ints, Ints, Array, float]:
    """The r fits and jumps that are more probable together than ``least``: numbers of the fits (r,) and of the jumps
    (r,), their probabilities (r,), and that of all others.

    ``share`` (c,): how probable each of the ``jumps`` (c, 6, 6) is once there is one, ``along`` (c,): those that an
    ``endless`` (h,) fit doesn't show, so that nothing is held against them: that no end of a finger is left; ``prior``
    (h,): of the fits; ``unseen``: of a jump under these, ``seen``: under the others.  The rest as for :func:`jumped`.
    """
    count, kinds = len(prior), len(share)
    weight, total, before, enough = np.zeros((count, kinds)), 0, np.zeros((count, kinds)), np.zeros(count)
    for h in range(count):
        enough[h] = least / prior[h]
        for c in range(kinds):
            before[h, c] = (unseen if endless[h] else seen) * share[c] if prior[h] > 0.0 else 0.0
    given = jumped(shift, covariance, off, at, known, known_off, jumps, before, stays, times, enough)
    left_out = 0.0
    for h in range(count):
        for c in range(kinds):
            most = max(given[h, c], before[h, c]) if endless[h] and along[c] else given[h, c]
            weight[h, c] = prior[h] * most
            if weight[h, c] > least:
                total += 1
            else:
                left_out += weight[h, c]
    fit, jump, probability, r = np.empty(total, np.intp), np.empty(total, np.intp), np.empty(total), 0
    for h in range(count):
        for c in range(kinds):
            if weight[h, c] > least:
                fit[r], jump[r], probability[r] = h, c, weight[h, c]
                r += 1
    return fit, jump, probability, left_out


@compiled
def follow(
    mean: Array, covariance: Array, off: Array, shift: Array, of_frame: Array, of_model: Array, creep: Array
) -> tuple[Array, Array, Array, Array]:
    """One more measurement for each of g Kalman filters, :func:`join`: their means (g, 6), covariances (g, 6, 6) and
    errors by the model (g, f, 6) after it, and the traces of their gains (g,).  ``creep`` (6,): variances that the
    filters' covariances have grown by.
    """
    count = len(mean)
    new_mean, new_covariance, new_off, taken = mean.copy(), covariance.copy(), off.copy(), np.empty(count)
    before, work = np.empty((6, 6)), np.empty((4, 6, 6))
    for g in range(count):
        for i in range(6):
            for j in range(6):
                before[i, j] = covariance[g, i, j] + (creep[i] if i == j else 0.0)
        of, out = (shift[g], of_frame[g], of_model[g]), (new_mean[g], new_covariance[g], new_off[g])
        taken[g] = join(mean[g], before, off[g], of, out, work)
    return new_mean, new_covariance, new_off, taken


@compiled
def with_known(shift: Array, covariance: Array, off: Array, at: Array, known: Array) -> tuple[Array, Array, Array]:
    """Poses (h, 6) with their covariances (h, 6, 6) and errors by the model (h, f, 6), each joined with what is known
    of all of them besides: ``at`` (6,) but for a covariance ``known`` (6, 6).
    """
    new_shift, new_covariance, new_off = shift.copy(), covariance.copy(), off.copy()
    none, work = np.zeros((off.shape[1], 6)), np.empty((4, 6, 6))
    for h in range(len(shift)):
        out = new_shift[h], new_covariance[h], new_off[h]
        join(shift[h], covariance[h], off[h], (at, known, none), out, work)
    return new_shift, new_covariance, new_off


@compiled
def telling(
    mean: Array,
    covariance: Array,
    off: Array,
    at: Array,
    wander: Array,
    shift: Array,
    of_frame: Array,
    of_model: Array,
    rows: Ints,
    limit: float,
) -> tuple[Array, Array, Array]:
    """Of g averages, from ``at`` (6,) and after a way with the variances ``wander`` (6,), and the fits of a frame that
    are their ``rows`` (g,) the ones that know more, but the frame where they differ by more than a normalised square of
    ``limit``: shift (g, 6), covariance (g, 6, 6) and error by the model (g, f, 6).  A negative row is none.
    """
    away, spread, error = mean - at, covariance.copy(), off.copy()
    root, white = np.empty((6, 6)), np.empty(6)
    for g in range(len(mean)):
        for i in range(6):
            spread[g, i, i] += wander[i]
        h = rows[g]
        if h < 0:
            continue
        own = of_frame[h, 0, 0] + of_frame[h, 1, 1] + of_frame[h, 2, 2]
        surer = own < spread[g, 0, 0] + spread[g, 1, 1] + spread[g, 2, 2]
        if surer or square(of_frame[h] + spread[g], shift[h] - away[g], root, white) > limit:
            for i in range(6):
                away[g, i] = shift[h, i]
                for k in range(6):
                    spread[g, i, k] = of_frame[h, i, k]
                for f in range(off.shape[1]):
                    error[g, f, i] = of_model[h, f, i]
    return away, spread, error
