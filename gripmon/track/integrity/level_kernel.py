"""The arithmetic of protection levels, compiled: how far off a pose may be under each of r hypotheses, or the motion
since the reference, and the root of the sum over the hypotheses' tails.

h fits, f parts of the gripper, g lasting hypotheses; lengths in m and rad.  What they are for stands in
:mod:`~gripmon.track.integrity.separation`.  Tests hold each against the function of its name in
``tests/support/by_numpy/integrity.py``.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.compiled import compiled
from gripmon.model.records import Array
from gripmon.track.integrity.kernel import Ints, join, square

MOST_SIGMAS = 2.0
"""Standard deviations by which what is of second order is off at most: a plane's tilt is known to 15 degrees, and
fingers that are tilted by 30 degrees more, or less, point across the view, or at the camera.
"""

Limits = tuple[float, float, float, Array, float, Ints, float]
"""The risk, the factor on standard deviations, the tolerance of a level and its tables, for :func:`levels`."""

Bound = tuple[float, float, int]
"""Protection levels of position and rotation, m and rad, and the number of the name of what the position's owes most
to; -1: all is less probable than the risk.
"""


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
def _enter(
    shift: Array, covariance: Array, off: Array, alike: Array, inflation: float, table: Array, number: int
) -> None:
    """Into the column ``number`` of a ``table`` (7, n), from its second row on: lengths of a ``shift`` (6,), in
    position and in rotation, and the tails of its error, sigma twice and factor twice, with its ``covariance`` (6, 6)
    and the errors by the model, ``off`` (f, 6) and ``alike`` (p, 6).
    """
    more = inflation**2
    for x in range(0, 6, 3):
        y, z, part = x + 1, x + 2, x // 3
        xx, yy, zz = more * covariance[x, x], more * covariance[y, y], more * covariance[z, z]
        xy, xz, yz = more * covariance[y, x], more * covariance[z, x], more * covariance[z, y]
        for error in (off, alike):
            for f in range(len(error)):
                a, b, c = error[f, x], error[f, y], error[f, z]
                xx, yy, zz = xx + a * a, yy + b * b, zz + c * c
                xy, xz, yz = xy + b * a, xz + c * a, yz + c * b
        table[1 + part, number] = math.sqrt(shift[x] ** 2 + shift[y] ** 2 + shift[z] ** 2)
        table[3 + part, number], table[5 + part, number] = _tail(xx, yy, zz, xy, xz, yz)


@compiled
def doubted(
    shift: Array,
    covariance: Array,
    off: Array,
    prior: Array,
    alike: Array,
    farther: Array,
    inflation: float,
    share: float,
    table: Array,
) -> None:
    """Columns of a ``table`` (7, r): ``prior`` (r,) of fits, and, where it is more than a ``share``, how far they are
    away, ``shift`` (r, 6), position and rotation, each ``farther`` (2,), and the tails of their errors, sigma twice and
    factor twice: by ``covariance`` (r, 6, 6) and errors by the model ``off`` (r, f, 6), with those that all have,
    ``alike`` (p, 6).
    """
    for r in range(len(prior)):
        table[0, r] = prior[r]
        if prior[r] > share:
            _enter(shift[r], covariance[r], off[r], alike, inflation, table, r)
            for part in range(2):
                table[1 + part, r] += farther[part]


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
def levels(table: Array, called: Ints, limits: Limits) -> Bound:
    """The bound by a table's columns, as of :func:`doubted`, which are ``called`` (h,) by these numbers.

    The levels are where the sum over the hypotheses of their priors times the tail beyond level - away is the risk,
    found between bounds by halving their ratio's logarithm down to the tolerance, a factor; the larger end counts.
    Those of less than an equal share of the risk take their prior off it.
    """
    prior, away, sigma, factor = table[0], table[1:3], table[3:5], table[5:7]
    risk, _, near, squares, spacing, guide, step = limits
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
                    if total > left:
                        break
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
    return most[0], most[1], called[owed]


@compiled
def _by_motion(by_motion: Array, travel: Array, moved: Array, at: Array, shift: Array, out: Array) -> None:
    """``out`` (k² + k, 6): errors by a motion of which k directions make ``by_motion`` (k, 6, 3) each, of the second
    order and of the first, with that of the jaws' ``travel`` (6,).  Each by the motion that a fit has, ``shift`` (6,)
    from one of the camera's origin by ``moved`` (3,) with the TCP ``at`` (3,): such an error is in the motion as
    published, too, which fits are reckoned from.
    """
    count, way = len(by_motion), np.empty(3)
    for k in range(count + 1):
        # By what moves the origin: the fit itself, and then its errors.
        error = shift if k == 0 else out[count * count + k - 1]
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3
            way[j] = (moved[j] if k == 0 else 0.0) + error[j] - (error[3 + a] * at[b] - error[3 + b] * at[a])
        for m in range(count):
            row = count * count + m if k == 0 else m * count + k - 1
            for i in range(6):
                out[row, i] = 0.0
                for j in range(3):
                    out[row, i] += by_motion[m, i, j] * way[j]
                if k > 0:
                    out[row, i] *= MOST_SIGMAS
    if count:
        for i in range(6):
            out[count * count, i] += travel[i]


@compiled
def _levered(covariance: Array, lever: Array, out: Array) -> None:
    """``out`` = L C L', each (6, 6), of a ``lever`` L that is one but for the positions by the rotation."""
    half = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            total = covariance[i, j]
            if i < 3:
                for k in range(3, 6):
                    total += lever[i, k] * covariance[k, j]
            half[i, j] = total
    for i in range(6):
        for j in range(i + 1):
            total = half[i, j]
            if j < 3:
                for k in range(3, 6):
                    total += half[i, k] * lever[j, k]
            out[i, j] = out[j, i] = total


@compiled
def _stayed(
    way: Array,
    scatter: Array,
    error: Array,
    stays_at: Array,
    usual: Array,
    knock: Array,
    odds: float,
    mean: Array,
    covariance: Array,
    work: Array,
) -> float:
    """A true motion, ``mean`` (6,) with its ``covariance`` (6, 6), by what fits say of it, ``way`` (6,) but for a
    ``scatter`` (6, 6) and the errors (f, 6), and by what a mount that isn't knocked moves, the covariance ``usual``
    (6, 6) about ``stays_at`` (6,).  Returns the probability, by Bayes, that it was knocked, with ``knock`` (6, 6)
    besides, of ``odds`` before; no less than these.
    """
    whole, root, white, apart = scatter.copy(), np.empty((6, 6)), np.empty(6), np.empty(6)
    for f in range(len(error)):
        for i in range(6):
            for j in range(6):
                whole[i, j] += error[f, i] * error[f, j]
    for i in range(6):
        apart[i] = way[i] - stays_at[i]
    none = np.zeros((0, 6))
    join(way, whole, none, (stays_at, usual, none), (mean, covariance, none), work)
    log_density = np.empty(2)
    for k in range(2):
        both = whole + usual if k == 0 else whole + usual + knock
        log_density[k] = -0.5 * square(both, apart, root, white)
        for i in range(6):
            log_density[k] += math.log(root[i, i])
    likelier = math.exp(min(log_density[1] - log_density[0], 700.0)) * odds
    return max(odds, likelier / (likelier + 1.0 - odds))


@compiled
def _by_origin(by_motion: Array, covariance: Array, at: Array, out: Array) -> None:
    """``out`` (6, 6) += B O B' of the errors B by a motion of the camera's origin, ``by_motion`` (k, 6, 3), with the
    covariance O of that of a motion with a ``covariance`` (6, 6) and the TCP ``at`` (3,).
    """
    lever, half = np.zeros((3, 6)), np.zeros((3, 6))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        lever[i, i], lever[i, 3 + a], lever[i, 3 + b] = 1.0, -at[b], at[a]
    origin = lever @ covariance @ lever.T
    for m in range(len(by_motion)):
        half = by_motion[m] @ origin
        for i in range(6):
            for j in range(6):
                for k in range(3):
                    out[i, j] += half[i, k] * by_motion[m, j, k]


@compiled
def moved(
    shift: Array,
    covariance: Array,
    off: Array,
    prior: Array,
    which: Ints,
    from_shift: Array,
    from_covariance: Array,
    from_off: Array,
    lever: Array,
    by_motion: Array,
    travel: Array,
    origin: Array,
    tcp: Array,
    stays_at: Array,
    staying: Array,
    usual: Array,
    knock: Array,
    odds: float,
    inflation: float,
    share: float,
    table: Array,
    first: int,
) -> None:
    """As :func:`doubted`, of the motion since the reference: the differences L (x - T b) of the fits x and those at the
    reference that are their ``which`` (r,) of g, as :func:`begun` has them, ``from_shift`` (g, 6), ``from_covariance``
    (g, 6, 6) and ``from_off`` (g, f, 6); L is ``lever`` (6, 6), one but for the positions by the rotation.  The others
    as for :func:`_by_motion`, ``origin`` (3,) the way of the camera's origin.

    ``staying`` (6, 6): covariance of a motion from ``stays_at`` (6,) that is known besides, :func:`join`; (0, 6): none.

    ``usual`` (6, 6), where it isn't (0, 6): errors ``by_motion`` are by the true motion, of a mount that moves from
    ``stays_at`` by that covariance, or, with ``odds`` above zero, was knocked by ``knock`` (6, 6) as well, of a
    probability by these, :func:`_stayed`: then they are by all of what fits show.
    """
    parts, kinds = off.shape[1], len(by_motion)
    errors = parts + kinds * kinds + kinds
    half, none = np.empty((6, 6)), np.zeros((0, 6))
    way, scatter, error = np.empty(6), np.empty((6, 6)), np.empty((errors, 6))
    joined, work = (np.empty(6), np.empty((6, 6)), np.empty((errors, 6))), np.empty((4, 6, 6))
    exact, true_way, unsure = np.zeros((errors, 6)), np.empty(6), np.empty((6, 6))
    for r in range(len(prior)):
        g, number = which[r], first + r
        table[0, number] = prior[r]
        if prior[r] <= share:
            continue
        _levered(covariance[r], lever, half)
        for i in range(6):
            way[i] = -from_shift[g, i] + shift[r, i]
            for k in range(3, 6):
                if i < 3:
                    way[i] += lever[i, k] * shift[r, k]
            for j in range(6):
                scatter[i, j] = half[i, j] + from_covariance[g, i, j]
        for f in range(parts):
            for i in range(6):
                error[f, i] = -from_off[g, f, i] + off[r, f, i]
            if off[r, f].any():
                for i in range(3):
                    for k in range(3, 6):
                        error[f, i] += lever[i, k] * off[r, f, k]
        of_motion = way
        if len(usual):
            knocked = _stayed(way, scatter, error[:parts], stays_at, usual, knock, odds, true_way, unsure, work)
            if odds > 0.0:
                table[0, number] *= knocked
                if table[0, number] <= share:
                    continue
            else:
                of_motion = true_way
                _by_origin(by_motion, unsure, tcp, scatter)
        _by_motion(by_motion, travel, origin, tcp, of_motion, error[parts:])
        if len(staying):
            join(way, scatter, error, (stays_at, staying, exact), joined, work)
            _enter(joined[0], joined[1], joined[2], none, inflation, table, number)
        else:
            _enter(way, scatter, error, none, inflation, table, number)
