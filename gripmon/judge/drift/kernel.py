"""The arithmetic of the sequential test, compiled: k lengths of windows, s streams, six axes.

Values are m and rad or, after a whitening W of their covariance C with W C W' = 1, standard deviations.  What they are
for stands in :mod:`~gripmon.judge.drift.sequential` and :mod:`~gripmon.judge.drift.statistics`.  What is learnt is
changed in place.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gripmon.model.compiled import compiled
from gripmon.model.records import Array
from gripmon.model.symmetric import diagonalise

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@compiled
def _root(matrix: Array, root: Array) -> bool:
    """Cholesky's lower ``root`` (6, 6); False for a matrix that isn't positive definite."""
    root[:] = 0.0
    for i in range(6):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@compiled
def _invert_root(root: Array, inverse: Array) -> None:
    """``inverse`` (6, 6) of a lower triangle."""
    inverse[:] = 0.0
    for j in range(6):
        inverse[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, 6):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * inverse[k, j]
            inverse[i, j] = total / root[i, i]


@compiled
def _whiten(matrix: Array, root: Array, whitening: Array) -> None:
    """W with ``W C W' = 1``, lower triangular; LinAlgError for a matrix that isn't positive definite."""
    if not _root(matrix, root):
        raise np.linalg.LinAlgError("a covariance of the drift test isn't positive definite")
    _invert_root(root, whitening)


@compiled
def _square(whitening: Array, values: Array) -> float:
    """Normalised square of ``values`` (6,) by a lower triangle."""
    total = 0.0
    for i in range(6):
        white = 0.0
        for j in range(i + 1):
            white += whitening[i, j] * values[j]
        total += white * white
    return total


@compiled
def squares(whitening: Array, values: Array) -> Array:
    """(k, s) normalised squares of values (k, s, 6), by lower triangles (k, s, 6, 6)."""
    out = np.empty(values.shape[:2])
    for k in range(values.shape[0]):
        for s in range(values.shape[1]):
            out[k, s] = _square(whitening[k, s], values[k, s])
    return out


@compiled
def _square_beyond(whitening: Array, shift: Array, tolerated: Array, sweeps: int) -> float:
    """Smallest normalised square of ``shift`` (6,) less a shift within ``tolerated`` (6,) on every axis.

    Errors of the axes belong together: what is tolerated on each axis by itself must not be taken off by itself, or
    what is left would be a shift that C takes to be impossible.  Coordinate descent from both ends, nothing taken off
    and all of it; never more than the square of the shift itself.
    """
    precision, left, best = np.zeros((6, 6)), np.empty(6), math.inf
    for i in range(6):
        for j in range(6):
            for k in range(max(i, j), 6):
                precision[i, j] += whitening[k, i] * whitening[k, j]
    for start in range(2):
        for i in range(6):
            taken = min(max(shift[i], -tolerated[i]), tolerated[i]) if start == 1 else 0.0
            left[i] = shift[i] - taken
        for _ in range(sweeps):
            for axis in range(6):
                pull = 0.0
                for j in range(6):
                    pull += precision[axis, j] * left[j]
                taken = shift[axis] - left[axis] + pull / precision[axis, axis]
                left[axis] = shift[axis] - min(max(taken, -tolerated[axis]), tolerated[axis])
        best = min(best, _square(whitening, left))
    return best


@compiled
def square_beyond(covariance: Array, shift: Array, tolerated: Array, sweeps: int) -> float:
    """Normalised square of what of a shift (6,) with a covariance (6, 6) isn't tolerated."""
    root, whitening = np.empty((6, 6)), np.empty((6, 6))
    _whiten(covariance, root, whitening)
    return _square_beyond(whitening, shift, tolerated, sweeps)


@compiled
def _report(reported: Array, covariance: Array, memory: float) -> Array:
    """Follow the reported covariances (s, 6, 6); the usual variances over this frame's, 1 at most, on average (s,)."""
    usual = np.empty(len(reported))
    for s in range(len(reported)):
        share = 0.0
        for i in range(6):
            for j in range(6):
                reported[s, i, j] += memory * (covariance[s, i, j] - reported[s, i, j])
            share += covariance[s, i, i] / reported[s, i, i]
        usual[s] = 1.0 / max(share / 6.0, 1.0)
    return usual


@compiled
def steady(
    shift: Array,
    covariance: Array,
    memory: float,
    reported: Array,
    seen: Ints,
    sure: Array,
    last_two: Array,
    to_reported: Array,
    from_reported: Array,
) -> Array:
    """Shifts (s, 6) with their covariances as far as they are sure, beside those reported with a ``memory``; of those
    the median of three frames, in axes that err independently.
    """
    usual = _report(reported, covariance, memory)
    out, white = np.zeros((len(shift), 6)), np.zeros((3, 6))
    for s in range(len(shift)):
        for i in range(6):
            if seen[s] == 0:
                sure[s, i] = last_two[0, s, i] = last_two[1, s, i] = shift[s, i]
            else:
                sure[s, i] += usual[s] * (shift[s, i] - sure[s, i])
        for i in range(6):
            white[:, i] = 0.0
            for j in range(6):
                white[0, i] += to_reported[s, i, j] * last_two[0, s, j]
                white[1, i] += to_reported[s, i, j] * last_two[1, s, j]
                white[2, i] += to_reported[s, i, j] * sure[s, j]
        for i in range(6):
            low, high = min(white[0, i], white[1, i]), max(white[0, i], white[1, i])
            middle = max(low, min(high, white[2, i]))
            for j in range(6):
                out[s, j] += from_reported[s, j, i] * middle
            last_two[0, s, i], last_two[1, s, i] = last_two[1, s, i], sure[s, i]
        seen[s] += 1
    return out


@compiled
def slide(ring: Array, newest: int, values: Array, lengths: Ints) -> tuple[Array, Array]:
    """Means (k, s, 6) over the last n frames, and those less the means over the n before, from a ring of sums that has
    the ``newest`` place for one frame's values (s, 6).
    """
    streams = ring.shape[1]
    for s in range(streams):
        for i in range(6):
            ring[newest, s, i] = ring[(newest - 1) % len(ring), s, i] + values[s, i]
    mean, difference = np.empty((len(lengths), streams, 6)), np.empty((len(lengths), streams, 6))
    for k in range(len(lengths)):
        n = lengths[k]
        once, twice = (newest - n) % len(ring), (newest - 2 * n) % len(ring)
        for s in range(streams):
            for i in range(6):
                mean[k, s, i] = (ring[newest, s, i] - ring[once, s, i]) / n
                difference[k, s, i] = mean[k, s, i] - (ring[once, s, i] - ring[twice, s, i]) / n
    return mean, difference


@compiled
def decide(
    mean: Array,
    difference: Array,
    frames: Ints,
    lengths: Ints,
    whitening: Array,
    limit: Array,
    most_tolerated: Array,
    tolerated: Array,
    worth: float,
    sweeps: int,
    first: int,
) -> tuple[Array, tuple[Bools, Ints, Bools, Array]]:
    """(2, k, s) squares of means, but for what is tolerated, and of differences, over their limits; 0 for windows that
    reach back too far.  And what a :class:`~gripmon.judge.drift.sequential.Finding` holds, by windows from the number
    ``first`` on.
    """
    beyond, streams = np.zeros(limit.shape), len(frames)
    for k in range(len(lengths)):
        for s in range(streams):
            if frames[s] >= lengths[k]:
                found, least = _square(whitening[0, k, s], mean[k, s]), limit[0, k, s]
                surely = math.sqrt(least) + most_tolerated[k, s]
                # What is tolerated can only matter between these two.
                if worth * least < found <= surely * surely:
                    found = _square_beyond(whitening[0, k, s], mean[k, s], tolerated, sweeps)
                beyond[0, k, s] = found / least
            if frames[s] >= 2 * lengths[k]:
                beyond[1, k, s] = _square(whitening[1, k, s], difference[k, s]) / limit[1, k, s]
    moved, stepped = np.zeros(streams, dtype=np.bool_), np.zeros(streams, dtype=np.bool_)
    length, excess = np.full(streams, lengths[first]), np.zeros(streams)
    for s in range(streams):
        # The shortest window that is beyond its threshold dates the motion best.
        for k in range(len(lengths) - 1, first - 1, -1):
            largest = max(beyond[0, k, s], beyond[1, k, s])
            excess[s] = max(excess[s], largest)
            if largest > 1.0:
                moved[s], length[s], stepped[s] = True, lengths[k], beyond[1, k, s] > 1.0
    return beyond, (moved, length, stepped, excess)


@compiled
def extremes(
    mean: Array, difference: Array, middle: Array, whitening: Array, limit: Array, known: Bools, far: float
) -> Array:
    """(2, k, s) squares of the short windows' means about the ``middle`` (s, 6), and of their differences, each up to
    ``far`` times the limit where that is known.
    """
    lengths, streams = whitening.shape[1], whitening.shape[2]
    out = np.empty((2, lengths, streams))
    for k in range(lengths):
        for s in range(streams):
            out[0, k, s] = _square(whitening[0, k, s], mean[k, s] - middle[s])
            out[1, k, s] = _square(whitening[1, k, s], difference[k, s])
            for kind in range(2):
                if known[kind, k, s]:
                    out[kind, k, s] = min(out[kind, k, s], far * limit[kind, k, s])
    return out


@compiled
def learn(
    difference: Array,
    normalised: Array,
    usable: Bools,
    of_difference: Array,
    windows: Array,
    share: Array,
    most_windows: Array,
    largest: float,
) -> None:
    """Covariances of differences (k, s, 6, 6) and the ``windows`` (k, s) that they rest on, after one difference more
    of the usable ones, of which ``share`` (k, 1) is a window that is independent.
    """
    for k in range(usable.shape[0]):
        for s in range(usable.shape[1]):
            if not usable[k, s]:
                continue
            windows[k, s] = min(windows[k, s] + share[k, 0], most_windows[k, 0])
            tame, gain = min(1.0, largest / max(normalised[k, s], 1e-12)), share[k, 0] / windows[k, s]
            for i in range(6):
                for j in range(6):
                    outer = tame * difference[k, s, i] * difference[k, s, j]
                    of_difference[k, s, i, j] += gain * (outer - of_difference[k, s, i, j])


@compiled
def _exceeding(matrix: Array, vectors: Array, out: Array) -> None:
    """The positive part ``out`` of a symmetric (6, 6) matrix, which is overwritten."""
    diagonalise(matrix, vectors)
    out[:] = 0.0
    for k in range(6):
        if matrix[k, k] > 0.0:
            for i in range(6):
                for j in range(6):
                    out[i, j] += matrix[k, k] * vectors[i, k] * vectors[j, k]


@compiled
def _between_triangles(root: Array, matrix: Array, between: Array, out: Array) -> None:
    """``out`` = L M L' with a lower triangle, (6, 6) each."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(i + 1):
                total += root[i, k] * matrix[k, j]
            between[i, j] = total
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(j + 1):
                total += between[i, k] * root[j, k]
            out[i, j] = out[j, i] = total


@compiled
def _missing(seen: Array, root: Array, inverse: Array, out: Array) -> None:
    """The part ``out`` of a claimed covariance, with its ``root`` and that one's ``inverse``, direction by direction,
    that exceeds what was ``seen``, (6, 6) each.
    """
    short, part, between = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    _between_triangles(inverse, seen, between, short)
    for i in range(6):
        for j in range(6):
            short[i, j] = (1.0 if i == j else 0.0) - short[i, j]
    if _root(short, part):  # all of it exceeds
        for i in range(6):
            for j in range(6):
                part[i, j] = short[i, j]
    else:
        _exceeding(short, between, part)
    _between_triangles(root, part, between, out)


@compiled
def _add(factor: float, matrix: Array, rest: Array, out: Array) -> None:
    """``out`` = factor M + R, (6, 6) each."""
    for i in range(6):
        for j in range(6):
            out[i, j] = factor * matrix[i, j] + rest[i, j]


@compiled
def refresh(
    reported: Array,
    of_difference: Array,
    learnt: Array,
    times: Array,
    rare: Ints,
    reference: Array,
    known: Bools,
    plain: Array,
    mean_covariance: Array,
    whitening: Array,
    learnt_whitening: Array,
    to_reported: Array,
    from_reported: Array,
) -> None:
    """Covariances of means and of differences again, and their whitening.

    With A(n) ``of_difference`` that of a mean is the sum of A(n), A(2 n), A(4 n) ... over four, but of what was seen so
    often as to be always there what is missing of ``reported`` (s, 6, 6) comes on top, direction by direction.
    ``times`` (3, k, s): by how much the variance of what was seen counts for the limits that are assumed, for standard
    deviations, and for the limits that are learnt; ``learnt`` (k, s): part of it that the stream has shown; ``rare``
    (k,): length from which on noise is rare.  The rest is overwritten.  LinAlgError if rounding leaves no root.
    """
    lengths, streams = learnt.shape
    total, seen = np.zeros((3, lengths, 6, 6)), np.zeros((lengths + 1, 6, 6))
    root, part, whole = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    never, missing, nothing = np.empty((6, 6)), np.empty((6, 6)), np.zeros((6, 6))
    for s in range(streams):
        for k in range(lengths - 1, -1, -1):
            # Beyond the longest, windows count as independent.
            _add(0.5 if k == lengths - 1 else 0.25, of_difference[k, s], nothing, part)
            _add(learnt[k, s], part, seen[k + 1], seen[k])
            for way in range(3):
                _add(times[way, k, s], part, total[way, k + 1] if k < lengths - 1 else nothing, total[way, k])
        _whiten(reported[s], from_reported[s], to_reported[s])
        _missing(seen[0], from_reported[s], to_reported[s], never)
        for k in range(lengths):
            _add(-1.0, seen[rare[k]], seen[0], part)
            _missing(part, from_reported[s], to_reported[s], missing)
            _add(1.0, total[1, k], never, part)
            _add(1.0, part, reference[s], mean_covariance[k, s])
            _add(1.0, total[2 if known[0, k, s] else 0, k], never, part)
            _add(1.0, part, reference[s], whole)
            _whiten(whole, root, whitening[0, k, s])
            missing[:] = 2.0 * missing
            _add(times[2 if known[1, k, s] else 0, k, s], of_difference[k, s], missing, whole)
            _whiten(whole, root, whitening[1, k, s])
            _whiten(of_difference[k, s], root, learnt_whitening[k, s])
            if k < plain.shape[1]:
                _add(1.0, total[2, k], never, whole)
                _whiten(whole, root, plain[0, k, s])
                _add(times[2, k, s], of_difference[k, s], missing, whole)
                _whiten(whole, root, plain[1, k, s])
