"""What ``judge.drift.kernel`` compiles, function by function, by NumPy."""

from __future__ import annotations

import numpy as np

from gripmon.judge.drift.kernel import Bools, Ints
from gripmon.model.records import Array


def whitening_of(covariance: Array) -> Array:
    """(..., 6, 6) W with ``W C W' = 1``."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _apply(matrix: Array, values: Array) -> Array:
    return np.asarray((matrix @ values[..., None])[..., 0])


def squares(whitening: Array, values: Array) -> Array:
    white = _apply(whitening, values)
    return np.asarray((white * white).sum(axis=-1))


def least_squares(whitening: Array, shift: Array, tolerated: Array, sweeps: int) -> Array:
    """(...) smallest normalised square of ``shift`` (..., 6) less a shift within ``tolerated`` (6,) on every axis.

    ``whitening`` (..., 6, 6) is W with ``W C W' = 1``.  Errors of the axes belong together: what is tolerated on each
    axis by itself must not be taken off by itself, or what is left would be a shift that C takes to be impossible.
    Coordinate descent from both ends, nothing taken off and all of it; never more than the square of the shift itself.
    """
    precision = np.swapaxes(whitening, -1, -2) @ whitening
    best = np.full(shift.shape[:-1], np.inf)
    for start in (np.zeros_like(shift), np.clip(shift, -tolerated, tolerated)):
        taken = start
        for _ in range(sweeps):
            for axis in range(6):
                pull = (precision[..., axis, :] * (shift - taken)).sum(axis=-1) / precision[..., axis, axis]
                taken[..., axis] = np.clip(taken[..., axis] + pull, -tolerated[axis], tolerated[axis])
        best = np.minimum(best, squares(whitening, shift - taken))
    return best


def square_beyond(covariance: Array, shift: Array, tolerated: Array, sweeps: int) -> float:
    return float(least_squares(whitening_of(covariance), shift, tolerated, sweeps))


def _report(reported: Array, covariance: Array, memory: float) -> Array:
    reported += memory * (covariance - reported)
    variances = np.einsum("sii->si", covariance) / np.einsum("sii->si", reported)
    return np.asarray(1.0 / np.maximum(variances.mean(axis=1), 1.0))


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
    usual = _report(reported, covariance, memory)
    fresh = (seen == 0)[:, None]
    sure[:] = np.where(fresh, shift, sure + usual[:, None] * (shift - sure))
    last = np.where(fresh, sure, last_two)
    last_two[:] = last[1], sure
    seen += 1
    one, two, three = (_apply(to_reported, each) for each in (*last, sure))
    return _apply(from_reported, np.maximum(np.minimum(one, two), np.minimum(np.maximum(one, two), three)))


def slide(ring: Array, newest: int, values: Array, lengths: Ints) -> tuple[Array, Array]:
    np.add(ring[newest - 1], values, out=ring[newest])
    ago, twice_ago = ring[(newest - lengths) % len(ring)], ring[(newest - 2 * lengths) % len(ring)]
    count = lengths[:, None, None]
    mean = (ring[newest] - ago) / count
    return mean, mean - (ago - twice_ago) / count


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
    full = np.stack([frames >= lengths[:, None], frames >= 2 * lengths[:, None]])
    found = np.stack([squares(whitening[0], mean), squares(whitening[1], difference)])
    # What is tolerated can only matter between these two.
    surely = np.sqrt(limit[0]) + most_tolerated
    some = full[0] & (found[0] > worth * limit[0]) & (found[0] <= surely * surely)
    if some.any():
        found[0, some] = least_squares(whitening[0, some], mean[some], tolerated, sweeps)
    every = np.where(full, found / limit, 0.0)
    beyond = every[:, first:]
    excess = beyond.max(axis=(0, 1))
    # The shortest window that is beyond its threshold dates the motion best.
    index = (beyond.max(axis=0) > 1.0).argmax(axis=0)
    stepped = beyond[1, index, np.arange(beyond.shape[2])] > 1.0
    return every, (excess > 1.0, lengths[first:][index], stepped, excess)


def extremes(
    mean: Array, difference: Array, middle: Array, whitening: Array, limit: Array, known: Bools, far: float
) -> Array:
    short = whitening.shape[1]
    values = np.stack([mean[:short] - middle, difference[:short]])
    most = np.where(known[:, :short], far * limit[:, :short], np.inf)
    return np.minimum(squares(whitening, values), most)


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
    windows[:] = np.where(usable, np.minimum(windows + share, most_windows), windows)
    tame = np.minimum(1.0, largest / np.maximum(normalised, 1e-12))
    gain = np.where(usable, share / windows, 0.0)
    outer = (tame[..., None] * difference)[..., :, None] * difference[..., None, :]
    of_difference += gain[..., None, None] * (outer - of_difference)


def covariances(reported: Array, of_difference: Array, learnt: Array, times: Array, rare: Ints) -> tuple[Array, Array]:
    """(..., k, s, 6, 6) each: of the means of windows, and of the differences between neighbouring ones, where the
    variance of what was seen counts ``times`` (..., k, s); the rest as in ``kernel.refresh``.
    """
    parts = 0.25 * of_difference
    parts[-1] *= 2.0  # beyond the longest, windows count as independent
    inflated = times[..., None, None]
    total = np.flip(np.cumsum(np.flip(inflated * parts, axis=-4), axis=-4), axis=-4)
    seen = np.cumsum((learnt[..., None, None] * parts)[::-1], axis=0)[::-1]
    rarely = np.concatenate([seen, np.zeros_like(seen[:1])])[rare]
    # All lengths at once: what is missing of the claim altogether, and of what is seen often enough.
    missing = _what_is_missing(np.concatenate([seen[:1], seen[:1] - rarely]), reported)
    return total + missing[0], inflated * of_difference + 2.0 * missing[1:]


def _what_is_missing(seen: Array, claimed: Array) -> Array:
    """The part of a claimed covariance (s, 6, 6), direction by direction, that exceeds what was seen (..., s, 6, 6)."""
    root = np.linalg.cholesky(claimed)
    inverse = np.linalg.inv(root)
    share, directions = np.linalg.eigh(inverse @ seen @ np.swapaxes(inverse, -1, -2))
    towards = root @ directions
    return np.asarray((towards * np.maximum(1.0 - share, 0.0)[..., None, :]) @ np.swapaxes(towards, -1, -2))


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
    from_reported[:] = np.linalg.cholesky(reported)
    to_reported[:] = np.linalg.inv(from_reported)
    of_mean, of_differences = covariances(reported, of_difference, learnt, times, rare)
    short = plain.shape[1]
    plain[:] = whitening_of(np.stack([of_mean[2, :short], of_differences[2, :short]]))
    of_mean += reference
    mean_covariance[:] = of_mean[1]
    of_both = np.stack([of_mean[::2], of_differences[::2]])  # (2 statistics, assumed and learnt, k, s, 6, 6)
    whitening[:] = whitening_of(np.where(known[..., None, None], of_both[:, 1], of_both[:, 0]))
    learnt_whitening[:] = whitening_of(of_difference)
