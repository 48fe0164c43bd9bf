"""Average of the transform over time: a Kalman filter on the manifold, for a camera that stands still or creeps.

The state is the pose, its covariance that of ``xi = (rho, omega)``; between frames the pose follows a random walk.  The
filter learns its noise from quiet time, axis by axis, by covariance matching (Mehra, "On the identification of
variances and adaptive Kalman filtering", 1970):

- the scatter of frames about the average, as a share of their reported covariance.  Part of a frame's error is the same
  in all frames, because the same background stands still behind the same edges.  Averaging removes only the part that
  scatters; the rest of the reported variance stays in the variance of the average.  Scatter above the reported
  covariance is vibration, which the average must not hide;
- the random walk of the average itself: the process noise.

Two frames in a row outside the gate restart the average.  While frames lie farther from the average than noise
explains, the transform follows the frames instead.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.compiled import compiled
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array

GATE_SQUARE = chi_square_limit(1e-6)
"""Gate on the squared normalised innovation: normal errors exceed it once in a million frames."""

SETTLING_FRAMES, SETTLING_GATE_SQUARE = 20, chi_square_limit(0.03)
"""Number of frames after a start during which the gate is this narrower value, which 3 % of frames with normal errors
exceed, and one frame outside it restarts the average: the mount may still be ringing, and a restart costs little."""

LEAST_KEPT_RATIO = 0.4
"""Least variance of the average, over the variance of what scatters about it.  Some errors change too slowly to be seen
in quiet time: in front of moving background about a third of the whole error lasts for ten seconds or longer."""

FOLLOW_MEMORY, LAG_SCATTER_RATIO = 0.25, 2.5
"""Weight of the newest frame in the running mean of its squared distance from the average; and the multiple of the
usual scatter above which the average lags: the transform then follows the frames, and the average catches up."""
SETTLING_LAG = 0.7
"""While the average settles, the transform follows the frames from this part of the limit: averaging gains little.
Without it errors right after a knock are 1 to 4 % larger (docs/results/drift.md)."""
LAG_VARIANCE_FACTOR = 0.5
"""Variance that a lag adds to the average's, over the square of the lag."""

PRIOR_SCATTER, LEAST_SCATTER, MOST_SCATTER = 0.5, 0.1, 9.0
"""Share of the reported variance that scatters: the value assumed before it is learnt; the least value that a lag is
compared with; and the largest value that a single frame contributes."""
VIBRATION_SCATTER = 1.25
"""Scatter over reported variance above which frames vibrate: more than the reported covariance may be wrong by."""
PRIOR_FRAMES, SCATTER_FRAMES = 30.0, 1200.0
"""Number of frames that the assumed share is worth, and number of frames that are remembered."""
LEARN_EVERY = 4
"""Only every fourth frame is learnt from: neighbouring frames carry nearly the same information."""
LEAST_SHOWN_SCATTER = 0.6
"""Part of the scatter that an average must show before it is learnt from: an average of fewer than three frames shows
less."""

WALK_S = 4.0
"""Time over which the displacement of the average is measured; the process noise is learnt from it."""
PRIOR_WALKS, MOST_WALKS = 0.25, 64.0
"""Number of such displacements that the setting is worth, and number that are remembered."""
WALK_BOUNDS = (1e-3, 10.0)
"""Bounds on the learnt process noise (variance), over that of the settings."""

KEPT_FRAMES = 64
"""Newest frames that are kept, so that the average can restart at the onset of a step."""


class SmoothingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the mount may creep between frames, until that is learnt; the learnt creep stays between 1/30 and three
    times the setting.
    """

    creep_m_per_sqrt_s: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="random walk of the TCP's position, per axis (m per square root of a second)"),
    ] = 1e-5
    creep_rad_per_sqrt_s: Annotated[
        float,
        Meta(ge=0.0, le=1.0, description="random walk of the rotation, per axis (rad per square root of a second)"),
    ] = 1e-4


class QuietTime:
    """What was learnt in quiet time: ``scatter`` (6,), the variance of frames about the average over their reported
    variance, and ``walk`` (6,), the variance of the pose's random walk in one second, m² and rad².
    """

    def __init__(self, settings: SmoothingSettings):
        rates = [settings.creep_m_per_sqrt_s] * 3 + [settings.creep_rad_per_sqrt_s] * 3
        self._prior_walk = np.square(rates)
        self.walk: Array = self._prior_walk
        self._scatter_frames = PRIOR_FRAMES
        self._set_scatter(np.full(6, PRIOR_SCATTER))
        self._walks = PRIOR_WALKS
        self._way_square: Array | None = None
        self._start_T: Array | None = None
        self._since_s = 0.0

    def _set_scatter(self, scatter: Array) -> None:
        """Set the scatter and what follows from it for every frame: ``vibrates``, whether frames scatter more than
        reported on some axis, and ``vibration`` (6,), by what share of the reported variance.
        """
        self.scatter = scatter
        self.vibrates = bool(scatter.max() > VIBRATION_SCATTER)
        self.vibration: Array = np.where(scatter > VIBRATION_SCATTER, scatter - 1.0, 0.0)
        # Before the scatter is learnt, up to all of the reported variance may scatter.
        unknown = (1.0 - PRIOR_SCATTER) * PRIOR_FRAMES / self._scatter_frames
        self.lag_from: Array = LAG_SCATTER_RATIO * np.maximum(scatter + unknown, LEAST_SCATTER)
        self._least_kept = LEAST_KEPT_RATIO * np.minimum(scatter, 1.0)

    def kept(self, ripe: Array | float) -> Array:
        """Share (6,) of a frame's reported variance that stays in the average's; all of it at ``ripe`` = 0."""
        out: Array = np.maximum(1.0 - ripe * self.scatter, self._least_kept)
        return out

    def wait(self, elapsed_s: float) -> None:
        """Let time pass."""
        self._since_s += elapsed_s

    def interrupt(self) -> None:
        """The average was restarted, or time isn't quiet: start the measurement of a displacement again."""
        self._start_T = None

    def add(self, share: Array, ripe: Array, mean_T: Array, variance: Array) -> None:
        """Learn from a quiet frame.  ``share`` (6,) is its squared distance from the average ``mean_T`` over its
        ``variance`` (6,); a young average shows only the part ``ripe`` (6,) of the scatter.
        """
        if ripe.min() > LEAST_SHOWN_SCATTER:
            self._scatter_frames = min(self._scatter_frames + LEARN_EVERY, SCATTER_FRAMES)
            news = np.minimum(share, MOST_SCATTER) / ripe - self.scatter
            self._set_scatter(self.scatter + LEARN_EVERY / self._scatter_frames * news)
        if self._start_T is None:
            self._start_T, self._since_s = mean_T, 0.0
        elif self._since_s >= WALK_S:
            self._walked(np.square(perturbation_between(self._start_T, mean_T)), variance)
            self._start_T, self._since_s = mean_T, 0.0

    def _walked(self, way_square: Array, variance: Array) -> None:
        """The mean square of a displacement is twice the variance of the average's own error, which is known, plus the
        random walk's.
        """
        error = 2.0 * self.kept(1.0) * variance
        if self._way_square is None:
            self._way_square = self._prior_walk * WALK_S + error
        self._walks = min(self._walks + 1.0, MOST_WALKS)
        self._way_square = self._way_square + (way_square - self._way_square) / self._walks
        least, most = WALK_BOUNDS
        walk = (self._way_square - error) / self._since_s
        self.walk = np.minimum(np.maximum(walk, least * self._prior_walk), most * self._prior_walk)


class PoseFilter:
    """A Kalman filter whose state is a pose: ``mean_T`` (4, 4) and the ``covariance`` (6, 6) of its error."""

    def __init__(self, cam_T_grip: Array, covariance: Array):
        self.mean_T, self.covariance = cam_T_grip, covariance.copy()
        self.frames = 1

    def wander(self, variance: Array) -> None:
        """Predict: add the variances (6,) of the random walk to the covariance."""
        self.covariance.flat[::7] += variance

    def weigh(self, cam_T_grip: Array, covariance: Array) -> tuple[Array, Array, float]:
        """Innovation (6,) of a measurement (4, 4) with the covariance (6, 6), its gain (6, 6), and the squared
        normalised innovation.  ValueError for covariances that aren't positive definite.
        """
        innovation = perturbation_between(self.mean_T, cam_T_grip)
        gain, surprise = _gain(self.covariance, covariance, innovation)
        if not surprise >= 0.0:
            raise ValueError("a covariance that is not positive definite")
        return innovation, gain, surprise

    def correct(self, innovation: Array, gain: Array) -> Array:
        """Update with the measurement given to :meth:`weigh`; returns the residual (6,) after it."""
        way, self.covariance = _corrected(self.covariance, gain, innovation)
        self.mean_T = perturb(self.mean_T, way)
        self.frames += 1
        return innovation - way


@compiled
def _gain(mine: Array, other: Array, innovation: Array) -> tuple[Array, float]:
    """Gain P (P + R)^-1 (6, 6) of a measurement with the covariance R, ``other``, to a state with P, ``mine``; and the
    normalised square of the ``innovation`` (6,), negative where P + R isn't positive definite.  By Cholesky's
    decomposition.
    """
    root, gain, white, surprise = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), 0.0
    for i in range(6):
        for j in range(i + 1):
            rest = mine[i, j] + other[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
            else:
                return gain, -1.0
    for column in range(7):
        for i in range(6):
            rest = mine[i, column] if column < 6 else innovation[i]
            for k in range(i):
                rest -= root[i, k] * white[k]
            white[i] = rest / root[i, i]
        if column == 6:
            for i in range(6):
                surprise += white[i] * white[i]
            break
        for i in range(5, -1, -1):
            rest = white[i]
            for k in range(i + 1, 6):
                rest -= root[k, i] * gain[column, k]
            gain[column, i] = rest / root[i, i]
    return gain, surprise


@compiled
def _corrected(covariance: Array, gain: Array, innovation: Array) -> tuple[Array, Array]:
    """The way (6,) of the state, K times the innovation, and its covariance (6, 6) after that, (1 - K) P."""
    way, left, out = np.zeros(6), covariance.copy(), np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            way[i] += gain[i, j] * innovation[j]
            for k in range(6):
                left[i, j] -= gain[i, k] * covariance[k, j]
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.5 * (left[i, j] + left[j, i])
    return way, out


@compiled
def _scaled(covariance: Array, share: Array) -> Array:
    """A covariance (6, 6) with the ``share`` (6,) of its variances, as correlated as before."""
    out = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            out[i, j] = covariance[i, j] * math.sqrt(share[i]) * math.sqrt(share[j])
    return out


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    average = PoseAverage(SmoothingSettings())
    for _ in range(3):
        average.add(np.eye(4), np.eye(6))


class PoseAverage:
    """Running average of ``cam_T_grip``; ``cam_T_grip`` is None until the first measurement.

    ``claimed_covariance`` (6, 6) is that of its error; ``learnt`` what was learnt in quiet time.
    """

    def __init__(self, settings: SmoothingSettings):
        self.learnt = QuietTime(settings)
        self.cam_T_grip: Array | None = None
        self.claimed_covariance: Array = np.zeros((6, 6))
        self._filter = PoseFilter(np.eye(4), np.eye(6))
        self._newest: deque[tuple[Array, Array]] = deque(maxlen=KEPT_FRAMES)
        self._suspicions = 0
        self._recent: Array = np.zeros(6)
        self._stays: Array = np.ones(6)

    def forget(self) -> None:
        """Restart with the next measurement; what was learnt in quiet time stays."""
        self.cam_T_grip = None
        self._newest.clear()
        self.learnt.interrupt()

    def step(self, frames: int) -> None:
        """The pose has stepped, and the newest ``frames`` measurements were made after the step: restart from them."""
        since = list(self._newest)[-min(frames, KEPT_FRAMES) :] if frames > 0 else []
        self.forget()
        for cam_T_grip, covariance in since:
            self.add(cam_T_grip, covariance, quiet=False)

    def wander(self, elapsed_s: float) -> None:
        """Let time pass: the covariance grows by the random walk."""
        self._filter.wander(self.learnt.walk * elapsed_s)
        self.learnt.wait(elapsed_s)

    def add(self, cam_T_grip: Array, covariance: Array, quiet: bool = True) -> None:
        """Add one measurement (4, 4) with the covariance (6, 6) of its error.  ``quiet``: nothing indicates a motion,
        so the frame may be learnt from.  ValueError for a covariance that isn't positive definite.
        """
        covariance = np.ascontiguousarray(covariance)
        self._newest.append((cam_T_grip, covariance))
        if self.cam_T_grip is None:
            self._restart()
            return
        settled = self._filter.frames >= SETTLING_FRAMES
        innovation, gain, surprise = self._filter.weigh(cam_T_grip, self._as_it_scatters(covariance))
        if surprise <= (GATE_SQUARE if settled else SETTLING_GATE_SQUARE):
            self._suspicions = 0
            self._conclude(self._filter.correct(innovation, gain), covariance, quiet, settled)
            return
        self._suspicions += 1
        if self._suspicions >= 2 or not settled:
            self._restart()
        else:
            # One frame outside the gate is not used, but it may be the first after a step.
            self.claimed_covariance = self.claimed_covariance + np.outer(innovation, innovation)

    def _restart(self) -> None:
        """Restart from the newest measurement, and from the one before if that was outside the gate and agrees."""
        self.learnt.interrupt()
        self.cam_T_grip, self.claimed_covariance = self._newest[-1]
        self._filter = PoseFilter(*self._newest[-1])
        if self._suspicions >= 2:
            innovation, gain, surprise = self._filter.weigh(*self._newest[-2])
            if surprise < SETTLING_GATE_SQUARE:
                self._filter.correct(innovation, gain)
                self.cam_T_grip = self._filter.mean_T
        self._recent, self._suspicions = self.learnt.scatter, 0

    def _as_it_scatters(self, covariance: Array) -> Array:
        """A frame's covariance (6, 6), enlarged on axes that vibrate: the average doesn't follow vibration."""
        if not self.learnt.vibrates:
            return covariance
        return _scaled(covariance, 1.0 + self.learnt.vibration)

    def _conclude(self, distance: Array, covariance: Array, quiet: bool, settled: bool) -> None:
        """Set the transform and its covariance; ``distance`` (6,) is from the average to the frame."""
        learnt, mean_T, variance = self.learnt, self._filter.mean_T, covariance.diagonal()
        share = distance * distance / variance
        if self._filter.frames % LEARN_EVERY == 0 or not settled:
            # In effect one over the number of averaged frames.  Lasting errors average out more slowly than
            # independent ones; the distance shows all of them but this part.
            young = np.minimum(self._filter.covariance.diagonal() / variance, 1.0)
            self._stays = learnt.kept(1.0 - np.sqrt(young))
            if quiet:
                learnt.add(share, 1.0 - young, mean_T, variance)
        if not quiet:
            learnt.interrupt()
        stays = self._stays
        self._recent = self._recent + FOLLOW_MEMORY * (share - self._recent)
        lag = self._recent - (learnt.lag_from if settled else SETTLING_LAG * learnt.lag_from)
        self.cam_T_grip = mean_T
        if learnt.vibrates or lag.max() > 0.0:
            catch_up = np.maximum(self._recent - learnt.lag_from, 0.0)
            self._filter.wander(LAG_VARIANCE_FACTOR * catch_up * variance)
            # The distance holds motion and the frame's error; the transform follows it by the share of the motion.
            motion = learnt.vibration + np.maximum(lag, 0.0)
            follow = motion / (motion + 1.0)
            self.cam_T_grip = perturb(mean_T, follow * distance)
            left = 1.0 - follow
            stays = left * left * (stays + motion) + follow * (follow + 2.0 * left * stays)
        self.claimed_covariance = _scaled(covariance, stays)
