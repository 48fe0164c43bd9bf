"""The arithmetic of a frame's protection level, compiled: fits under h hypotheses, alone and with the anchor, the bank
of filters behind the anchor, and the root of the sum over the hypotheses' tails.

h hypotheses, v edges, f parts of the gripper, m unknowns of which the first n are asked for, g averages; lengths in m
and rad.  What they are for stands in :mod:`~gripmon.track.integrity.separation`.  Tests hold each against the function
of its name in ``tests/support/by_numpy/integrity.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gripmon.model.compiled import compiled
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
def _square(covariance: Array, values: Array, root: Array, white: Array) -> float:
    """Normalised square v' C^-1 v of ``values`` (m,) by their covariance (m, m), as :func:`_inverse` has it; ``root``
    and ``white`` (m,) are overwritten.
    """
    total = 0.0
    if not _root(covariance, root):
        solved = np.linalg.solve(covariance, values)
        for i in range(len(white)):
            white[i] = solved[i]
            total += values[i] * solved[i]
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
    of_model = np.zeros((count, parts, m))
    for h in range(count):
        for v in range(edges):
            if keep[h, v] == 0.0:
                continue
            for i in range(m):
                sums[h, i] += pull[v, i]
                for p in range(len(part)):
                    of_model[h, part[p, v], i] += model[p, v, i]
                for j in range(i + 1):
                    normal[h, i, j] += information[v, i, j]
                    spread[h, i, j] += middle[v, i, j]
        for i in range(m):
            for j in range(i):
                normal[h, j, i], spread[h, j, i] = normal[h, i, j], spread[h, i, j]
    return sums, normal, spread, of_model


@compiled
def _around(matrix: Array, middle: Array, half: Array, out: Array) -> None:
    """``out`` = A' B A of a ``matrix`` A and a symmetric ``middle`` B, (m, m) each; ``half`` is overwritten."""
    m = len(matrix)
    for i in range(m):
        for j in range(m):
            half[i, j] = 0.0
            for k in range(m):
                half[i, j] += matrix[k, i] * middle[k, j]
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
            for j in range(m):
                shift[h, i] += inverse[i, j] * sums[h, j]
                for f in range(fingers):
                    off[h, f, i] += inverse[i, j] * of_model[h, f, j]
        # U (U' spread U) U': multiplied by N^-1 itself, an open direction takes the digits of all others.
        middle, half = spread[h], root
        if rooted:
            _around(upper, spread[h], half, inverse)
            middle = inverse
        for i in range(n):
            for j in range(m):
                half[i, j] = 0.0
                for k in range(m):
                    half[i, j] += upper[i, k] * middle[k, j]
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
                out[i, j] += (off[f, i] - other[g, i]) * (off[f, j] - other[g, j])
            out[j, i] = out[i, j]


@compiled
def squares(shift: Array, at: Array, covariance: Array, off: Array, times: float, more: Array, other: Array) -> Array:
    """Normalised squares (h,) of shifts (h, 6) from ``at`` (6,), by :func:`between`."""
    out, root, white, both = np.empty(len(shift)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    for h in range(len(shift)):
        between(covariance[h], off[h], more, other, times, both)
        out[h] = _square(both, shift[h] - at, root, white)
    return out


@compiled
def with_and_without(
    pull: Array,
    information: Array,
    middle: Array,
    model: Array,
    part: Ints,
    parts: int,
    keep: Array,
    known: Array,
    known_pull: Array,
    at: Array,
    covariance: Array,
    off: Array,
    times: float,
    together: bool,
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array], Array]:
    """The fits' shifts, covariances and errors by the model by the kept edges alone, the same with a pose that is known
    besides, none of these if they aren't asked for ``together``, and the normalised squares (h,) of the former's
    distance from that.
    """
    sums, normal, spread, of_model = add_up(
        pull, information, middle, model, part, parts, keep, known, known_pull
    )  # fmt: skip
    alone = separate(sums, normal, spread, of_model, 6)
    asked = len(sums) if together else 0
    sums, normal, spread, of_model = with_pose(
        sums[:asked], normal[:asked], spread[:asked], of_model[:asked], at, covariance, off
    )  # fmt: skip
    with_it = separate(sums, normal, spread, of_model, 6)
    return alone, with_it, squares(alone[0], at, alone[1], alone[2], times, covariance, off)


@compiled
def _blend(mean: Array, other: Array, share: Array, upper: Array, backward: bool, out: Array) -> None:
    """``out`` (6,): mean + S U' (other - mean), S = ``share`` and U = ``upper``; the roles swapped if ``backward``."""
    for i in range(6):
        out[i] = other[i] if backward else mean[i]
    for k in range(6):
        white = 0.0
        for j in range(6):
            white += upper[j, k] * (mean[j] - other[j] if backward else other[j] - mean[j])
        for i in range(6):
            out[i] += share[i, k] * white


@compiled
def _join(
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
    ``work`` (5, 6, 6) is overwritten.

    P, R or both may leave directions open: a product of K and R, large each, has lost the other directions' digits.
    With the smaller one C of P and R and U U' = (P + R)^-1, K R is C - (C U) (C U)': symmetric, no variance larger than
    before, and off by no more than C is by rounding.
    """
    shift, covariance, of_model = measured
    new_mean, new_covariance, new_off = out
    both, upper, white, smaller = work[0], work[1], work[2], work[3]
    larger = 0.0
    for i in range(6):
        for j in range(6):
            both[i, j] = before[i, j] + covariance[i, j]
        if both[i, i] > 0.0:
            larger += (before[i, i] - covariance[i, i]) / both[i, i]
    backward = larger > 0.0  # from what was measured to the mean, which is known less well
    for i in range(6):
        for j in range(6):
            smaller[i, j] = covariance[i, j] if backward else before[i, j]
    rooted = _inverse(both, white, work[4], upper)
    for i in range(6):
        for j in range(6):
            white[i, j] = 0.0
            for k in range(6):
                white[i, j] += smaller[i, k] * upper[k, j]
    share, taken = white if rooted else smaller, 0.0
    for i in range(6):
        for j in range(6):
            taken += share[i, j] * upper[i, j]
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += share[i, k] * white[j, k]
            new_covariance[i, j] = new_covariance[j, i] = smaller[i, j] - total
    _blend(mean, shift, share, upper, backward, new_mean)
    for f in range(len(new_off)):
        _blend(off[min(f, len(off) - 1)], of_model[f], share, upper, backward, new_off[f])
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
) -> Array:
    """Probabilities (h, c) of the jumps that may have carried a pose away from where it is known to have been, given
    a frame's fits ``shift`` (h, 6) with their ``covariance`` R (h, 6, 6) and errors by the model, ``off`` (h, f, 6).

    ``at`` (6,) with its covariance ``known`` C (6, 6) and ``known_off`` (f or 1, 6): the pose before; ``jumps`` J
    (c, 6, 6), of the probability ``prior`` (h, c) each; ``stays`` (h,): whether it may as well have stayed.  By Bayes a
    jump's probability is its prior times the normal density of the fit with ``times`` R + C + J (and :func:`between`),
    over the sum of these and of having stayed.
    """
    count, kinds = prior.shape
    root, white, apart, both = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    log_density, out = np.empty(kinds + 1), np.zeros((count, kinds))
    for h in range(count):
        highest, stay = -math.inf, 1.0
        between(covariance[h], off[h], known, known_off, times, apart)
        for c in range(kinds + 1):
            log_density[c] = -math.inf
            if stays[h] if c == kinds else prior[h, c] > 0.0:
                for i in range(6):
                    for j in range(6):
                        both[i, j] = apart[i, j] + (jumps[c, i, j] if c < kinds else 0.0)
                log_density[c] = -0.5 * _square(both, shift[h] - at, root, white)
                for i in range(6):
                    log_density[c] += math.log(root[i, i])
            highest = max(highest, log_density[c])
        total = 0.0
        for c in range(kinds):
            stay -= prior[h, c]
            if prior[h, c] > 0.0:
                out[h, c] = prior[h, c] * math.exp(log_density[c] - highest)
                total += out[h, c]
        if stays[h]:
            total += max(stay, 0.0) * math.exp(log_density[kinds] - highest)
        if total > 0.0:
            out[h] /= total
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
) -> tuple[Array, Array, Array]:
    """The poses after r of the jumps of :func:`jumped`, by the fits and what was known: :func:`_join` of the latter,
    with C + J, and the former, shift (r, 6), covariance (r, 6, 6), and errors by the model (r, f, 6), ``off`` (h, f, 6)
    and ``known_off`` (f or 1, 6).  ``fit`` and ``jump`` (r,): the number of each.
    """
    count, parts = len(fit), off.shape[1]
    shifts, covariances, offs = np.empty((count, 6)), np.empty((count, 6, 6)), np.empty((count, parts, 6))
    before, work = np.empty((6, 6)), np.empty((5, 6, 6))
    for r in range(count):
        h, c = fit[r], jump[r]
        for i in range(6):
            for j in range(6):
                before[i, j] = known[i, j] + jumps[c, i, j]
        of = shift[h], covariance[h], off[h]
        _join(at, before, known_off, of, (shifts[r], covariances[r], offs[r]), work)
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
    probable: Array,
    stays: Bools,
    endless: Bools,
    least: float,
    times: float,
) -> tuple[Ints, Array, float, Array, Array, Array]:
    """The r fits and jumps that are more probable together than ``least``: numbers of the fits (r,), probabilities
    (r,), that of all others, and the poses then as by :func:`after_jumps`.

    ``share`` (c,): how probable each of the ``jumps`` (c, 6, 6) is once there is one, ``along`` (c,): those that an
    ``endless`` (h,) fit doesn't show, so that nothing is held against them; ``prior`` (h,): of the fits; ``probable``
    (h,): of a jump under each.  The others as for :func:`jumped`.
    """
    count, kinds = len(prior), len(share)
    weight, total, before = np.zeros((count, kinds)), 0, np.zeros((count, kinds))
    for h in range(count):
        for c in range(kinds):
            before[h, c] = probable[h] * share[c] if prior[h] > 0.0 else 0.0
    given = jumped(shift, covariance, off, at, known, known_off, jumps, before, stays, times)
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
    shifts, covariances, offs = after_jumps(shift, covariance, off, at, known, known_off, jumps, fit, jump)
    return fit, probability, left_out, shifts, covariances, offs


@compiled
def _tail(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> tuple[float, float]:
    """Standard deviation along the longest axis of a covariance, and the factor of the two others on that one's tail.

    The eigenvalues of B = (C - q) / p, with p so that B has the determinant 2 r and the squares 6, are
    2 cos(phi + 2 pi k / 3), cos(3 phi) = r (Smith 1961); the product of the largest one's distances to the others is
    3 (x² - 1), the derivative of the characteristic polynomial.
    """
    q = (xx + yy + zz) / 3.0
    a, b, c = xx - q, yy - q, zz - q
    p = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    x = 0.0
    if p > 0.0:
        a, b, c, d, e, f = a / p, b / p, c / p, xy / p, xz / p, yz / p
        half_determinant = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
        x = 2.0 * math.cos(math.acos(min(max(half_determinant, -1.0), 1.0)) / 3.0)
    largest = max(q + p * x, 1e-300)
    if q <= 0.0:
        return math.sqrt(largest), 0.0
    left = min(max(3.0 * (p / largest) ** 2 * (x * x - 1.0), 1e-24), 1.0)
    return math.sqrt(largest), -0.5 * math.log10(left)


@compiled
def tails(shift: Array, covariance: Array, of_model: Array, inflation: float) -> tuple[Array, Array, Array]:
    """Lengths (2, h) of shifts (h, 6), in position and in rotation, and the tails of their errors: sigma and factor
    (2, h), with the covariances (h, 6, 6) and errors by the model (h, f, 6).
    """
    count = len(shift)
    away, sigma, factor = np.empty((2, count)), np.empty((2, count)), np.empty((2, count))
    block = np.empty((3, 3))
    for part in range(2):
        first = 3 * part
        for h in range(count):
            total = 0.0
            for i in range(3):
                total += shift[h, first + i] ** 2
                for j in range(i + 1):
                    block[i, j] = inflation**2 * covariance[h, first + i, first + j]
                    for f in range(of_model.shape[1]):
                        block[i, j] += of_model[h, f, first + i] * of_model[h, f, first + j]
            away[part, h] = math.sqrt(total)
            sigma[part, h], factor[part, h] = _tail(
                block[0, 0], block[1, 1], block[2, 2], block[1, 0], block[2, 0], block[2, 1]
            )
    return away, sigma, factor


@compiled
def _radius(log_risk: float, factor: float, squares: Array, spacing: float) -> float:
    """Length over sigma that is exceeded with a probability (power of ten)."""
    last = squares.shape[1] - 1
    out = math.inf
    for table in range(2):
        place = -(log_risk - factor if table == 0 else log_risk) / spacing
        if place >= last:
            value = squares[table, last]
        elif place <= 0.0:
            value = squares[table, 0]
        else:
            k = int(place)
            value = squares[table, k] + (place - k) * (squares[table, k + 1] - squares[table, k])
        out = min(out, value)
    return math.sqrt(out)


@compiled
def _beyond(square: float, factor: float, squares: Array, spacing: float, guide: Ints, step: float) -> float:
    """Probability of a normalised square: ``guide`` (2, n) is where to begin in the table for each ``step``."""
    last = squares.shape[1] - 1
    out = 0.0
    for table in range(2):
        place = float(last)
        if square < squares[table, last]:
            k = guide[table, int(square / step)]
            while squares[table, k + 1] <= square:
                k += 1
            place = k + (square - squares[table, k]) / (squares[table, k + 1] - squares[table, k])
        log_tail = -spacing * place
        out = min(out, log_tail + factor) if table == 0 else min(out, log_tail)
    return math.exp(out * math.log(10.0))


@compiled
def levels(
    prior: Array,
    away: Array,
    sigma: Array,
    factor: Array,
    risk: float,
    near: float,
    squares: Array,
    spacing: float,
    guide: Ints,
    step: float,
) -> tuple[float, float, int]:
    """Protection levels of position and of rotation, m and rad, and the number of the hypothesis that the position's
    owes most to; -1 where all together are less probable than the risk.

    The levels are where the sum over the hypotheses of ``prior`` (h,) times the tail beyond level - ``away`` (2, h) is
    ``risk``, found between bounds by halving their ratio's logarithm down to a factor ``near``; the larger end counts.
    Those of less than an equal share of the risk take their ``prior`` off it.  ``squares`` to ``step``: the tables of
    :mod:`~gripmon.track.integrity.quantiles`.
    """
    share, left, count = risk / len(prior), risk, 0
    for h in range(len(prior)):
        if prior[h] > share:
            count += 1
        else:
            left -= prior[h]
    if not count:
        return 0.0, 0.0, -1
    least, most = np.zeros(2), np.zeros(2)
    for h in range(len(prior)):
        if prior[h] <= share:
            continue
        alone = math.log10(max(left / prior[h], 1e-300))
        equally = math.log10(max(left / count / prior[h], 1e-300))
        for part in range(2):
            s, f = sigma[part, h], factor[part, h]
            if alone < 0.0:  # what is less probable than the risk may lie beyond the level altogether
                least[part] = max(least[part], away[part, h] + s * _radius(alone, f, squares, spacing))
            most[part] = max(most[part], away[part, h] + s * _radius(equally, f, squares, spacing))
    # Each needs as much as if it had the whole risk alone; an equal share is enough for all.
    for part in range(2):
        least[part] = max(least[part], 1e-3 * most[part])
    while most[0] > near * least[0] or most[1] > near * least[1]:
        for part in range(2):
            middle = math.sqrt(least[part] * most[part])
            total = 0.0
            for h in range(len(prior)):
                if prior[h] > share:
                    length = max(middle - away[part, h], 0.0) / sigma[part, h]
                    total += prior[h] * _beyond(length * length, factor[part, h], squares, spacing, guide, step)
            if total <= left:
                most[part] = middle
            else:
                least[part] = middle
    largest, owed = -1.0, -1
    for h in range(len(prior)):
        if prior[h] > share:
            length = max(most[0] - away[0, h], 0.0) / sigma[0, h]
            part_of_it = prior[h] * _beyond(length * length, factor[0, h], squares, spacing, guide, step)
            if part_of_it > largest:
                largest, owed = part_of_it, h
    return most[0], most[1], owed


@compiled
def follow(
    mean: Array, covariance: Array, off: Array, shift: Array, of_frame: Array, of_model: Array, creep: Array
) -> tuple[Array, Array, Array, Array]:
    """One more measurement for each of g Kalman filters, :func:`_join`: their means (g, 6), covariances (g, 6, 6) and
    errors by the model (g, f, 6) after it, and the traces of their gains (g,).  ``creep`` (6,): variances that the
    filters' covariances have grown by.
    """
    count = len(mean)
    new_mean, new_covariance, new_off, taken = mean.copy(), covariance.copy(), off.copy(), np.empty(count)
    before, work = np.empty((6, 6)), np.empty((5, 6, 6))
    for g in range(count):
        for i in range(6):
            for j in range(6):
                before[i, j] = covariance[g, i, j] + (creep[i] if i == j else 0.0)
        of, out = (shift[g], of_frame[g], of_model[g]), (new_mean[g], new_covariance[g], new_off[g])
        taken[g] = _join(mean[g], before, off[g], of, out, work)
    return new_mean, new_covariance, new_off, taken


@compiled
def with_known(shift: Array, covariance: Array, off: Array, at: Array, known: Array) -> tuple[Array, Array, Array]:
    """Poses (h, 6) with their covariances (h, 6, 6) and errors by the model (h, f, 6), each joined with what is known
    of all of them besides: ``at`` (6,) but for a covariance ``known`` (6, 6).
    """
    new_shift, new_covariance, new_off = shift.copy(), covariance.copy(), off.copy()
    none, work = np.zeros((off.shape[1], 6)), np.empty((5, 6, 6))
    for h in range(len(shift)):
        out = new_shift[h], new_covariance[h], new_off[h]
        _join(shift[h], covariance[h], off[h], (at, known, none), out, work)
    return new_shift, new_covariance, new_off


@compiled
def _seen_from(covariance: Array, jacobian: Array, half: Array, out: Array) -> None:
    """``out`` += J C J', each (6, 6); ``half`` (6, 6) is overwritten."""
    for i in range(6):
        for j in range(6):
            half[i, j] = 0.0
            for k in range(6):
                half[i, j] += jacobian[i, k] * covariance[k, j]
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += half[i, k] * jacobian[j, k]
            out[i, j] += total
            if j < i:
                out[j, i] += total


@compiled
def of_motion(
    shift: Array,
    covariance: Array,
    off: Array,
    first: Ints,
    first_shift: Array,
    first_covariance: Array,
    first_off: Array,
    lever: Array,
    turn: Array,
    more: Array,
) -> tuple[Array, Array, Array]:
    """Fits x (h, 6) with their covariances (h, 6, 6) and errors by the model (h, f, 6), made those of the motion since
    the ``first`` (h,) of g fits b: the differences L (x - T b), with the Jacobians ``lever`` L and ``turn`` T (6, 6),
    covariances L (C_x + T C_b T' + M) L', M = ``more`` (6, 6), and differences of the errors by the model.
    """
    count, parts = len(first), off.shape[1]
    shifts, covariances, offs = np.empty((count, 6)), np.zeros((count, 6, 6)), np.empty((count, parts, 6))
    half, turned = np.empty((6, 6)), lever @ turn
    begun, begun_off = np.zeros((len(first_shift), 7, 6)), np.empty((len(first_shift), parts, 6))
    for g in range(len(first_shift)):
        _seen_from(first_covariance[g], turned, half, begun[g, :6])
        _seen_from(more, lever, half, begun[g, :6])
        for i in range(6):
            for k in range(6):
                begun[g, 6, i] += turned[i, k] * first_shift[g, k]
            for f in range(parts):
                begun_off[g, f, i] = 0.0
                for k in range(6):
                    begun_off[g, f, i] += turned[i, k] * first_off[g, f, k]
    for h in range(count):
        g = first[h]
        _seen_from(covariance[h], lever, half, covariances[h])
        for i in range(6):
            shifts[h, i] = -begun[g, 6, i]
            for k in range(6):
                covariances[h, i, k] += begun[g, i, k]
                shifts[h, i] += lever[i, k] * shift[h, k]
        for f in range(parts):
            for i in range(6):
                total = -begun_off[g, f, i]
                for k in range(6):
                    total += lever[i, k] * off[h, f, k]
                offs[h, f, i] = total
    return shifts, covariances, offs


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
        if surer or _square(of_frame[h] + spread[g], shift[h] - away[g], root, white) > limit:
            away[g], spread[g], error[g] = shift[h], of_frame[h], of_model[h]
    return away, spread, error
