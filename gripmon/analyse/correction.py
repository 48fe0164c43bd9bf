"""The best transform for every instant of a recording, from all frames before and after it.

The pose is a random walk with a rate, restarted at change points (:mod:`.quick_motion`); frames measure it with errors
that are new in each of them, last for half a second, or last as long as a background stays.  Means of blocks of frames
are smoothed forwards and backwards (:mod:`.smoothing`), on vectors about one pose (:mod:`.vectors`), axis by axis after
whitening by the reported covariance.  Quick motion is added from the residuals (:mod:`.quick_motion`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.quick_motion import BURST_MARGIN, MIN_CHANGE_CHI2, FoundChange, find, swings, vibration
from gripmon.analyse.smoothing import (
    Bools,
    Dynamics,
    Ints,
    Smoothed,
    VarianceShares,
    learn_shares,
    likeliest_dynamics,
    smooth,
)
from gripmon.analyse.vectors import (
    Blocks,
    Run,
    at,
    covariances_to_poses,
    outlier_frames,
    prepare,
    to_poses,
    to_vectors,
    with_gaps,
)
from gripmon.model.records import Array

BLOCK_S = 0.13
BLOCK_DOF = 12.0
"""Student's degrees of freedom of a block's error."""
SURE_CHANGE_CHI2 = 60.0
"""Squared size of a change, in reported variances, that no background explains."""
MIN_VARIANCE = 0.3
"""Least variance over the reported one: the error of a background that never changes can't be seen."""
RAMP_FRAMES = 32
FIT_PASSES = 2

SMOOTHED, FOLLOWED, DISBELIEVED, GAP = range(4)
SOURCES = ("smoothed", "followed", "disbelieved", "gap")
"""How an instant's transform was obtained: smoothed; smoothed and following the frames' quick motion; smoothed without
its own frame, which is an outlier; no frame there."""


@dataclass(frozen=True)
class ChangePoint:
    """The pose changed between the frames ``index - 1`` and ``index``, or in a gap before it.

    ``size`` (6,): the perturbation from before to after, m and rad in camera axes; ``size_covariance`` (6, 6): of its
    error.  With 95 % probability it happened between ``earliest_ns`` and ``latest_ns``.
    """

    index: int
    stamp_ns: int
    earliest_ns: int
    latest_ns: int
    size: Array
    size_covariance: Array


@dataclass(frozen=True)
class Correction:
    """One row per frame: ``cam_T_grip`` (n, 4, 4), its error's ``covariance`` (n, 6, 6) in the published convention,
    ``segment`` (n,) between changes, ``source`` (n,) index into :data:`SOURCES`.

    ``learnt``: error variances estimated from the recording, in units of the reported variance.
    """

    stamp_ns: Ints
    cam_T_grip: Array
    covariance: Array
    segment: Ints
    source: NDArray[np.int8]
    change_points: tuple[ChangePoint, ...]
    learnt: VarianceShares
    dynamics: Dynamics
    faults: tuple[str, ...] = ()


def correct(
    stamp_ns: Ints,
    cam_T_grip: Array,
    covariance: Array,
    measured: Bools,
    progress: Callable[[], None] = lambda: None,
) -> Correction:
    """Correct one run: ``stamp_ns`` (n,), transforms (n, 4, 4) and covariances (n, 6, 6) as recorded, and which were
    ``measured`` (n,); the others are not used.  ``progress`` is called :data:`STAGES` times.

    Raises ValueError if fewer than :data:`.vectors.MIN_FRAMES` frames were measured.
    """
    run = prepare(stamp_ns, cam_T_grip, covariance, measured)
    outliers = outlier_frames(run)
    run.usable &= ~outliers
    progress()
    found = _changes(run)
    progress()
    fit = _fit(run, found)
    jumps = [np.diff(_around(run, fit, k)[0], axis=0) for k in range(len(found))]
    kept = [f for f, jump in zip(found, jumps, strict=True) if float((jump**2).sum()) > MIN_CHANGE_CHI2]
    if len(kept) < len(found):
        fit = _fit(run, kept)
    progress()
    return _conclude(run, fit, stamp_ns, outliers)


STAGES = 3


def _changes(run: Run) -> list[FoundChange]:
    """Change points by frame index; a gap before a change is part of its interval."""
    good = np.flatnonzero(run.usable)
    y = run.y[good]
    return [
        FoundChange(int(good[found.index]), int(good[found.first]), int(good[found.last]), found.excess)
        for found in find(y, 3600.0 / run.frame_s)
        if (found.excess > BURST_MARGIN or _surely_moved(y, found.index)) and _is_sharp(y, found.index)
    ]


def _surely_moved(y: Array, index: int) -> bool:
    before, after = y[max(index - RAMP_FRAMES, 0) : index].mean(axis=0), y[index : index + RAMP_FRAMES].mean(axis=0)
    return float(((after - before) ** 2).sum()) > SURE_CHANGE_CHI2


def _is_sharp(y: Array, index: int) -> bool:
    """Whether it is a step, rather than a ramp from one background to the next."""
    half = 2 * RAMP_FRAMES
    part = y[max(index - half, 0) : index + half]
    middle = index - max(index - half, 0)
    place = np.arange(len(part))
    step = (place >= middle).astype(float)
    ramps = [
        np.clip((place - middle - shift * ramp) / ramp + 0.5, 0.0, 1.0)
        for ramp in (RAMP_FRAMES, 2 * RAMP_FRAMES)
        for shift in (-0.33, 0.0, 0.33)
    ]
    left = [_unexplained(part, law) for law in (step, *ramps)]
    return left[0] <= min(left[1:]) or _surely_moved(y, index)


def _unexplained(part: Array, law: Array) -> float:
    """Residual sum of squares of a fit of each axis by a constant and a multiple of ``law``."""
    basis = np.stack([np.ones(len(law)), law], axis=1)
    noise = np.sqrt(np.median(np.diff(part, axis=0) ** 2, axis=0)) + 1e-9
    scaled = part / noise
    rest = scaled - basis @ np.linalg.lstsq(basis, scaled, rcond=None)[0]
    return float((rest * rest).sum())


@dataclass
class _Fit:
    """Smoothed blocks at ``time_s`` (m,) with their ``segment`` (m,); error variances; quick motion per frame."""

    found: list[FoundChange]
    time_s: Array
    segment: Ints
    smoothed: Smoothed
    shares: VarianceShares
    dynamics: Dynamics
    swing: Array
    quick: Array
    quick_error: Array


def _segments(run: Run, found: list[FoundChange]) -> Ints:
    out = np.zeros(len(run.y), np.int64)
    out[[f.index for f in found]] = 1
    return np.cumsum(out)


def _fit(run: Run, found: list[FoundChange]) -> _Fit:
    segment = _segments(run, found)
    good = np.flatnonzero(run.usable)
    swing: Array = np.zeros((len(good), 6))
    quick: Array = np.zeros((len(good), 6))
    quick_error: Array = np.zeros_like(quick)
    extra = np.ones(0)
    size = int(np.clip(round(BLOCK_S / run.frame_s), 1, 16))
    for number in range(FIT_PASSES + 1):
        blocks = Blocks(run, good, segment[good], size, run.y[good] - quick, swing)
        if number == 0:
            extra = np.ones(len(blocks.time_s))
        if number < FIT_PASSES:
            trimmed = number > 0 or not found
            shares = learn_shares(blocks.time_s, blocks.mean, blocks.segment, blocks.frame_variance(), trimmed)
        variance = blocks.variance(shares.white) * extra[:, None]
        restarts = np.diff(blocks.segment, prepend=0) > 0
        if number < FIT_PASSES:
            dynamics, kinks_s = likeliest_dynamics(blocks.time_s, blocks.mean, variance, restarts, shares)
        time_s, where = with_gaps(run, blocks.time_s)
        y, noise = np.full((len(time_s), 6), np.nan), np.full((len(time_s), 6), np.inf)
        y[where], noise[where] = blocks.mean, variance
        begins, kinks = np.zeros((2, len(time_s)), bool)
        begins[where[restarts]] = True
        kinks[np.minimum(np.searchsorted(time_s, kinks_s), len(time_s) - 1)] = True
        smoothed = smooth(time_s, y, noise, begins, kinks, dynamics)
        index = np.zeros(len(time_s), np.int64)
        index[where] = np.arange(len(where))
        block_segment = blocks.segment[np.maximum.accumulate(index)]
        x = at(time_s, block_segment, smoothed, run.time_s[good], segment[good])[0]
        rest = run.y[good] - x
        off = (blocks.mean - smoothed.x[where]) ** 2 / (variance + shares.mid + shares.slow)
        extra = np.maximum((BLOCK_DOF + off.sum(axis=1)) / (BLOCK_DOF + 6.0), 1.0)
        quick, quick_error = vibration(rest)
        swing = swings(rest - quick, run.claimed[good])
    return _Fit(found, time_s, block_segment, smoothed, shares, dynamics, swing, quick, quick_error)


def _around(run: Run, fit: _Fit, number: int) -> tuple[Array, Array]:
    """x just before and after a change (2, 6), and the variance (6,) of the difference."""
    at_s = run.time_s[[fit.found[number].index] * 2]
    x, variance = at(fit.time_s, fit.segment, fit.smoothed, at_s, np.array([number, number + 1]))
    return x, variance.sum(axis=0)


def _conclude(run: Run, fit: _Fit, stamp_ns: Ints, outliers: Bools) -> Correction:
    segment = _segments(run, fit.found)
    x, variance = at(fit.time_s, fit.segment, fit.smoothed, run.time_s, segment)
    variance = np.maximum(variance + fit.shares.unseen, MIN_VARIANCE)
    good = np.flatnonzero(run.usable)
    source = np.full(len(x), GAP, np.int8)
    source[good], source[outliers] = SMOOTHED, DISBELIEVED
    # Quick motion: vibration from the spectrum, swinging as far as frames scatter more than usual.
    frame = (fit.shares.frame + fit.shares.white + fit.shares.mid) * run.claimed[good]
    follow = fit.swing / (fit.swing + frame)
    rest = run.y[good] - x[good] - fit.quick
    x[good] += fit.quick + follow * rest
    variance[good] += fit.quick_error + (1.0 - follow) ** 2 * fit.swing + follow**2 * frame
    source[good[(follow > 0.5).any(axis=1)]] = FOLLOWED
    spread = variance[:, :, None] * np.eye(6)
    points = []
    for k, found in enumerate(fit.found):
        points.append(_point(run, fit, k, stamp_ns))
        _unsure_in_gap(run, fit, k, found, x, spread)
    vectors = x @ run.root.T
    covariance = np.einsum("ij,njk,lk->nil", run.root, spread, run.root, optimize=True)
    poses = to_poses(run.origin_T, vectors)
    covariance = covariances_to_poses(covariance, vectors)
    return Correction(
        np.asarray(stamp_ns, np.int64),
        poses,
        0.5 * (covariance + np.swapaxes(covariance, -1, -2)),
        segment,
        source,
        tuple(points),
        fit.shares,
        fit.dynamics,
        tuple(run.faults),
    )


def _unsure_in_gap(run: Run, fit: _Fit, number: int, found: FoundChange, x: Array, spread: Array) -> None:
    """In a gap before a change, the change may have happened at any moment with equal probability."""
    before = np.flatnonzero(run.usable[: found.index])[-1]
    gap = np.arange(before + 1, found.index)
    if not len(gap):
        return
    begin_s, end_s = run.time_s[before], run.time_s[found.index]
    passed = ((run.time_s[gap] - begin_s) / max(end_s - begin_s, 1e-9))[:, None]
    later, variance = at(fit.time_s, fit.segment, fit.smoothed, run.time_s[gap], np.full(len(gap), number + 1))
    jump = later - x[gap]
    x[gap] += passed * jump
    apart = (passed * (1.0 - passed))[:, :, None] * (jump[:, :, None] * jump[:, None, :])
    spread[gap] += apart + passed[:, :, None] * (variance[:, :, None] * np.eye(6))


def _point(run: Run, fit: _Fit, number: int, stamp_ns: Ints) -> ChangePoint:
    found = fit.found[number]
    x, variance = _around(run, fit, number)
    before_T, after_T = to_poses(run.origin_T, x @ run.root.T)
    return ChangePoint(
        found.index,
        int(stamp_ns[found.index]),
        int(stamp_ns[np.flatnonzero(run.usable[: found.first])[-1]]),
        int(stamp_ns[found.last]),
        to_vectors(before_T, after_T[None])[0],
        run.root @ (variance[:, None] * run.root.T),
    )


def sample(correction: Correction, wanted_ns: Ints) -> tuple[Array, Array, Ints]:
    """Transforms (k, 4, 4), their errors' covariances (k, 6, 6) and segments (k,) at the capture times ``wanted_ns``.

    At a frame's time it is the frame's transform.  Between two frames it is interpolated, and the covariance includes
    that the change may have happened at any moment between them.  NaN, and segment -1, before the first frame and after
    the last.  Raises ValueError for a recording in which time runs backwards.
    """
    stamps = correction.stamp_ns
    if (np.diff(stamps) < 0).any():
        raise ValueError("time runs backwards in the recording: an instant may lie in several places")
    wanted_ns = np.asarray(wanted_ns, np.int64)
    after = np.clip(np.searchsorted(stamps, wanted_ns, side="left"), 0, len(stamps) - 1)
    before = np.where(stamps[after] == wanted_ns, after, np.maximum(after - 1, 0))
    outside = (wanted_ns < stamps[0]) | (wanted_ns > stamps[-1])
    span = np.maximum(stamps[after] - stamps[before], 1)
    f = np.clip((wanted_ns - stamps[before]) / span, 0.0, 1.0)
    poses, covariances = np.full((len(f), 4, 4), np.nan), np.full((len(f), 6, 6), np.nan)
    for k in np.flatnonzero(~outside).tolist():
        from_T, to_T = correction.cam_T_grip[before[k]], correction.cam_T_grip[after[k]]
        motion = to_vectors(from_T, to_T[None])[0]
        poses[k] = to_poses(from_T, f[k] * motion[None])[0]
        own = (1.0 - f[k]) * correction.covariance[before[k]] + f[k] * correction.covariance[after[k]]
        covariances[k] = own + f[k] * (1.0 - f[k]) * np.outer(motion, motion)
    segment = np.where(f < 0.5, correction.segment[before], correction.segment[after])
    return poses, covariances, np.where(outside, -1, segment)
