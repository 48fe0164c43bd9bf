"""The best transform for every instant of a recording, from all frames before and after it.

The pose stands still or walks between change points (:mod:`.change_points`).  Means of blocks of frames are smoothed
forwards and backwards (:mod:`.smoothing`), on vectors about one pose (:mod:`.vectors`), axis by axis after whitening by
the reported covariance.  Quick motion is added from the residuals (:mod:`.quick_motion`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.change_points import FoundChange, find, largest_background_change, outlier_frames
from gripmon.analyse.quick_motion import swings, vibration
from gripmon.analyse.smoothing import BLOCK_S, Blocks, Smoothed, smooth_blocks
from gripmon.analyse.vectors import Ints, Run, covariances_to_poses, prepare, to_poses, to_vectors
from gripmon.model.records import Array

MIN_CHANGE_CHI2 = 4.0
"""Squared size of a change after smoothing, in reported variances, below which it was no lasting one."""

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

    ``learnt``: what was estimated from the recording, (6,) each by whitened axis in units of the reported variance:
    ``frame``, ``white`` and ``slow``, a frame's error about its block, a block's own, and the lasting one;
    ``turn_per_s3``, the walk of the pose's rate.  ``undecided_ns``: when the pose or the background changed, which
    can't be told; the covariance includes both.  ``missable_m``: a step by which the TCP moves no farther may be among
    these, or not be found at all.
    """

    stamp_ns: Ints
    cam_T_grip: Array
    covariance: Array
    segment: Ints
    source: NDArray[np.int8]
    change_points: tuple[ChangePoint, ...]
    learnt: dict[str, Array]
    undecided_ns: tuple[int, ...]
    missable_m: float
    faults: tuple[str, ...] = ()


STAGES = 3


def correct(
    stamp_ns: Ints,
    cam_T_grip: Array,
    covariance: Array,
    measured: NDArray[np.bool_],
    progress: Callable[[], None] = lambda: None,
) -> Correction:
    """Correct one run: ``stamp_ns`` (n,), transforms (n, 4, 4) and covariances (n, 6, 6) as recorded, and which were
    ``measured`` (n,); the others are not used.  ``progress`` is called :data:`STAGES` times.

    Raises ValueError if fewer than :data:`.vectors.MIN_FRAMES` frames were measured.
    """
    stamp_ns = np.asarray(stamp_ns, np.int64)
    run = prepare(stamp_ns, cam_T_grip, covariance, measured)
    outliers = outlier_frames(run)
    run.usable &= ~outliers
    found, undecided = find(run)
    progress()
    fit = _Fit(run, found, np.zeros_like(run.y))
    progress()
    kept = [change for k, change in enumerate(found) if (fit.around(k)[0] ** 2).sum() > MIN_CHANGE_CHI2]
    fit = _Fit(run, kept, fit.swing)
    progress()
    x, spread, source = fit.instants()
    if undecided:
        # Neither is preferred: the pose changed in all of them, or in none.
        other = _Fit(run, sorted([*kept, *undecided], key=lambda change: change.index), fit.swing)
        away = other.x - fit.x
        spread += 0.5 * away[:, :, None] * away[:, None, :]
    source[outliers] = DISBELIEVED
    points = [_point(fit, k, stamp_ns) for k in range(len(kept))]
    vectors = x @ run.root.T
    error = np.einsum("ij,njk,lk->nil", run.root, spread, run.root, optimize=True)
    error = covariances_to_poses(error, vectors)
    learnt = {"frame": fit.blocks.frame, "white": fit.blocks.white}
    learnt |= {"slow": fit.smoothed.slow, "turn_per_s3": fit.smoothed.turn}
    return Correction(
        stamp_ns,
        to_poses(run.origin_T, vectors),
        0.5 * (error + np.swapaxes(error, -1, -2)),
        fit.segment,
        source,
        tuple(points),
        learnt,
        tuple(stamp_ns[[change.index for change in undecided]].tolist()),
        float(np.linalg.norm(run.root[:3], 2) * np.sqrt(largest_background_change(run))),
        run.faults,
    )


class _Fit:
    """Smoothed blocks between changes, and the frames' quick motion; ``swing`` (n, 6): variance of frames' swinging,
    with which they are weighted at first, then as the residuals show it.
    """

    def __init__(self, run: Run, found: list[FoundChange], swing: Array):
        self.run, self.found = run, found
        self.segment: Ints = np.cumsum(np.bincount([f.index for f in found], minlength=len(run.y))).astype(np.int64)
        self.blocks = Blocks(run, self.segment, swing)
        self.smoothed: Smoothed = smooth_blocks(self.blocks)
        self.x, self.variance = self.smoothed.at(run.time_s, self.segment)
        good = run.usable
        self.rest = run.y[good] - self.x[good]
        self.quick, self.quick_error = vibration(self.rest, run.frame_s / BLOCK_S)
        self.swing = np.zeros_like(run.y)
        self.swing[good] = swings(self.rest - self.quick, run.claimed[good])

    def around(self, number: int) -> tuple[Array, Array]:
        """The jump (6,) in a change, and the variance (6,) of its error."""
        at_s = self.run.time_s[[self.found[number].index] * 2]
        x, variance = self.smoothed.at(at_s, np.array([number, number + 1]))
        return x[1] - x[0], variance.sum(axis=0)

    def instants(self) -> tuple[Array, Array, NDArray[np.int8]]:
        """Of all frames: vectors (n, 6), their covariances (n, 6, 6), source (n,)."""
        good = np.flatnonzero(self.run.usable)
        x, variance = self.x.copy(), np.maximum(self.variance, self.smoothed.least_variance)
        # As far as frames scatter by swinging rather than by their own errors.
        own = (self.blocks.frame + self.blocks.white) * self.run.claimed[good]
        follow = self.swing[good] / (self.swing[good] + own + 1e-12)
        x[good] += self.quick + follow * (self.rest - self.quick)
        variance[good] += self.quick_error + (1.0 - follow) ** 2 * self.swing[good] + follow**2 * own
        source = np.full(len(x), GAP, np.int8)
        source[good] = np.where((follow > 0.5).any(axis=1), FOLLOWED, SMOOTHED)
        spread = variance[:, :, None] * np.eye(6)
        for number, change in enumerate(self.found):
            self._unsure(number, change, x, spread)
        return x, spread, source

    def _unsure(self, number: int, change: FoundChange, x: Array, spread: Array) -> None:
        """In a gap before a change, the change may have happened at any moment with equal probability."""
        before = np.flatnonzero(self.run.usable[: change.index])[-1]
        gap = np.arange(before + 1, change.index)
        if not len(gap):
            return
        begin_s, end_s = self.run.time_s[before], self.run.time_s[change.index]
        passed = ((self.run.time_s[gap] - begin_s) / max(end_s - begin_s, 1e-9))[:, None]
        later, variance = self.smoothed.at(self.run.time_s[gap], np.full(len(gap), number + 1))
        jump = later - x[gap]
        x[gap] += passed * jump
        apart = (passed * (1.0 - passed))[:, :, None] * (jump[:, :, None] * jump[:, None, :])
        spread[gap] += apart + passed[:, :, None] * (variance[:, :, None] * np.eye(6))


def _point(fit: _Fit, number: int, stamp_ns: Ints) -> ChangePoint:
    change, run = fit.found[number], fit.run
    at_s = run.time_s[[change.index] * 2]
    before_T, after_T = to_poses(run.origin_T, fit.smoothed.at(at_s, np.array([number, number + 1]))[0] @ run.root.T)
    return ChangePoint(
        change.index,
        int(stamp_ns[change.index]),
        int(stamp_ns[np.flatnonzero(run.usable[: change.first])[-1]]),
        int(stamp_ns[change.last]),
        to_vectors(before_T, after_T[None])[0],
        run.root @ (fit.around(number)[1][:, None] * run.root.T),
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
