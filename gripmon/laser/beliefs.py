"""Motion test: Shiryaev-Roberts procedure over normal beliefs, with a stated false-alarm rate.

A belief describes a set-up: the error of its calibration, its motion since then, and the errors of arm and lens at the
poses where pulses come from.  The calibration's error is common to all pulses; the errors of arm and lens are common to
pulses from one pose.  Both are unknowns with a known covariance here, so that repeated pulses don't count as
independent measurements.

Each pulse starts new alternatives: "something moved just now", for each part that can move and for small and large
motions.  Each belief predicts the next spot with a covariance; the likelihood ratio of an alternative is the product of
its predictions' likelihoods over those of the reigning belief.  Under the reigning belief the sum R of the ratios less
the number of pulses is a martingale, so that R exceeds K at most once in K pulses on average, whatever the alternatives
are and however few of them are kept (Pollak, Ann. Statist. 13, 1985).

A spot may be wrong: a reflection, or speckle beside it.  Half of the wrong spots are assumed uniform over the image,
the other half centred on the right spot and uniform in the logarithm of the distance.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from gripmon.laser.world import CAMERA, COUNT, LASER, PLANE, Calibrated, predict_moved
from gripmon.model.geometry import rotation_angle
from gripmon.model.records import Array, Cause

PLACES = 12
"""Number of poses with an offset of their own; a new pose replaces the least recently visited one."""
MOVED = slice(COUNT, 2 * COUNT)
SIZE = 2 * COUNT + 2 * PLACES
_FAR = 0.2
"""Error of linearisation, in standard deviations of a spot, up to which the Jacobian at the calibration is used."""
_ITERATIONS = 4
SAME_M, SAME_RAD = 5e-3, 0.02
"""Largest distance between poses of one place (m, rad): the arm's error doesn't change noticeably over it."""


@dataclass(slots=True)
class Beliefs:
    """A set of n beliefs: ``mean`` (n, 50) of the calibration's error (13), the motion since (13), and the places'
    offsets (12 times 2, px), with ``covariance`` (n, 50, 50); ``weight`` (n,): logarithm of the likelihood ratio
    against the reigning belief; ``kind`` and ``scale`` (n,): what moved last and the order of magnitude; ``pulses``
    (n,): inlier pulses since then; ``born`` (n,): number of pulses before; ``prior`` (n, 13, 13): assumed covariance of
    that motion; ``motions`` (n,): number of motions.
    """

    mean: Array
    covariance: Array
    weight: Array
    kind: NDArray[np.intp]
    scale: NDArray[np.intp]
    pulses: NDArray[np.intp]
    born: NDArray[np.intp]
    prior: Array
    motions: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.weight)

    def picked(self, which: NDArray[np.intp] | NDArray[np.bool_]) -> Beliefs:
        """Copy of a subset."""
        return Beliefs(*(getattr(self, field.name)[which] for field in fields(self)))

    def joined(self, others: Beliefs) -> Beliefs:
        """All of both sets."""
        return Beliefs(
            *(np.concatenate([getattr(self, field.name), getattr(others, field.name)]) for field in fields(self))
        )

    def at_new_place(self, place: int, covariance_px: Array) -> None:
        """Reset a place's offset (by its index): it stands for another pose now."""
        rows = slice(2 * COUNT + 2 * place, 2 * COUNT + 2 * place + 2)
        self.mean[:, rows] = 0.0
        self.covariance[:, rows, :] = 0.0
        self.covariance[:, :, rows] = 0.0
        self.covariance[:, rows, rows] = covariance_px


def as_calibrated(calibrated: Calibrated) -> Beliefs:
    """A single belief: nothing has moved."""
    covariance = np.zeros((1, SIZE, SIZE))
    covariance[0, :COUNT, :COUNT] = calibrated.covariance
    none = np.zeros(1, dtype=np.intp)
    return Beliefs(
        np.zeros((1, SIZE)), covariance, np.zeros(1), none - 1, none.copy(), none.copy(), none.copy(),
        np.zeros((1, COUNT, COUNT)), none.copy(),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Pulse:
    """A pulse: ``uv_px`` (k, 2) of the candidate spots with ``covariance_px`` (k, 2, 2), seen at a pose (4, 4) of a
    ``place``; the calibration predicts ``predicted_px`` (2,) with derivatives ``rows`` (2, 13).
    """

    base_T_ee: Array
    place: int
    uv_px: Array
    covariance_px: Array
    predicted_px: Array
    rows: Array


class Bank:
    """Predicts pulses from beliefs and updates the beliefs."""

    def __init__(self, calibrated: Calibrated):
        self._calibrated = calibrated
        self._focal_px = 0.5 * (calibrated.camera.fx_px + calibrated.camera.fy_px)

    def predicted(self, beliefs: Beliefs, pulse: Pulse) -> tuple[Array, Array]:
        """Predicted pixels (n, 2), NaN where there is no spot, and derivatives (n, 2, 50) by the beliefs' means."""
        change = beliefs.mean[:, :COUNT] + beliefs.mean[:, MOVED]
        shifts = change[:, None, :] * pulse.rows
        uv_px = pulse.predicted_px + shifts.sum(axis=2)
        rows = np.tile(pulse.rows, (len(beliefs), 1, 1))
        reach = np.sqrt(_FAR * self._calibrated.sigma_px * self._focal_px)
        left = np.flatnonzero(np.abs(shifts).sum(axis=2).max(axis=1) > reach)
        while len(left):
            # Reuse the derivatives at one of them for all beliefs near it.
            found = predict_moved(self._calibrated, change[left[0]], pulse.base_T_ee)
            shifts = (change[left] - change[left[0]])[:, None, :] * found.rows
            near = np.abs(shifts).sum(axis=2).max(axis=1) <= reach
            near[0] = True
            uv_px[left[near]] = found.uv_px + shifts[near].sum(axis=2) if found.finite else np.nan
            rows[left[near]] = found.rows if found.finite else 0.0
            left = left[~near]
        return self._with_place(beliefs, pulse, uv_px, rows)

    @staticmethod
    def _with_place(beliefs: Beliefs, pulse: Pulse, uv_px: Array, rows: Array) -> tuple[Array, Array]:
        first = 2 * COUNT + 2 * pulse.place
        out = np.zeros((len(beliefs), 2, SIZE))
        out[:, :, :COUNT] = out[:, :, MOVED] = rows
        out[:, :, first : first + 2] = np.eye(2)
        return uv_px + beliefs.mean[:, first : first + 2], out

    def weigh(
        self, beliefs: Beliefs, pulse: Pulse, wrong: Array, share: float
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
        """Likelihood of a pulse under each belief; also updates the beliefs with it.

        ``wrong`` (k,): density of a wrong spot at each candidate (1/px²), ``share``: probability that a pulse has only
        wrong candidates.  Returns the log likelihoods (n,) of the candidates, relative to all of them being wrong; the
        candidate (n,) taken for the spot; and whether any is accepted (n,).
        """
        uv_px, rows = self.predicted(beliefs, pulse)
        spread = beliefs.covariance @ rows.transpose(0, 2, 1)
        own = rows @ spread
        total = own[:, None] + pulse.covariance_px + self._bent(own)[:, None]  # (n, k, 2, 2)
        off = pulse.uv_px - uv_px[:, None, :]
        square, determinant = _squares(off, total)
        density = np.exp(-0.5 * square) / (2.0 * np.pi * np.sqrt(determinant)) / wrong
        density = np.where(np.isfinite(density), density, 0.0)
        best = density.argmax(axis=1)
        every = np.arange(len(beliefs))
        right = (1.0 - share) / len(pulse.uv_px) * density[every, best]
        believed = right > share
        self._learn(beliefs, pulse, believed, best, off[every, best], rows, spread, total[every, best])
        beliefs.pulses += believed
        return np.log(share + right), best, believed

    def _bent(self, own: Array) -> Array:
        """Covariance (n, 2, 2) of the linearisation error for an uncertain prediction: a central projection is
        non-linear by the square of a shift over the focal length.
        """
        bent: Array = np.square(0.5 * np.trace(own, axis1=1, axis2=2) / self._focal_px)[:, None, None] * np.eye(2)
        return bent

    def _learn(
        self,
        beliefs: Beliefs,
        pulse: Pulse,
        believed: NDArray[np.bool_],
        best: NDArray[np.intp],
        off: Array,
        rows: Array,
        spread: Array,
        total: Array,
    ) -> None:
        gain = spread @ np.linalg.inv(np.where(believed[:, None, None], total, np.eye(2)))
        off = np.where(believed[:, None], off, 0.0)
        step = (gain @ off[:, :, None])[:, :, 0]
        before = beliefs.mean.copy()
        beliefs.mean += step
        gain[~believed] = 0.0
        after = gain @ spread.transpose(0, 2, 1)
        beliefs.covariance -= after
        moved = np.abs(rows[:, :, : 2 * COUNT] * step[:, None, : 2 * COUNT]).sum(axis=2).max(axis=1)
        reach = np.sqrt(_FAR * self._calibrated.sigma_px * self._focal_px)
        for k in np.flatnonzero(believed & (moved > reach)):
            self._iterate(beliefs, int(k), before[k], spread, rows, pulse, int(best[k]), after[k])

    def _iterate(
        self, beliefs: Beliefs, k: int, before: Array, spread: Array, rows: Array, pulse: Pulse, best: int, taken: Array
    ) -> None:
        """After a large step: relinearise at the new mean, Gauss-Newton (the iterated extended Kalman filter)."""
        one = np.array([k])
        prior = beliefs.covariance[k] + taken
        for _ in range(_ITERATIONS):
            uv_px, there = self.predicted(beliefs.picked(one), pulse)
            if not np.isfinite(uv_px).all():
                return
            h = there[0]
            own = prior @ h.T
            seen = h @ own
            gain = own @ np.linalg.inv(seen + pulse.covariance_px[best] + self._bent(seen[None])[0])
            mean = before + gain @ (pulse.uv_px[best] - uv_px[0] - h @ (before - beliefs.mean[k]))
            small = np.abs(h @ (mean - beliefs.mean[k])).max() < 0.1 * self._calibrated.sigma_px
            beliefs.mean[k] = mean
            beliefs.covariance[k] = prior - gain @ own.T
            if small:
                return


def _squares(off: Array, covariance: Array) -> tuple[Array, Array]:
    """Normalised squares (n, k) of (n, k, 2), and the determinants (n, k) of (n, k, 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    determinant = a * c - b * b
    x, y = off[..., 0], off[..., 1]
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinant, determinant


class Places:
    """The most recent places, each with the first pose (4, 4) that was seen there."""

    def __init__(self) -> None:
        self._poses: dict[int, Array] = {}  # least recently visited first

    @property
    def poses(self) -> tuple[Array, ...]:
        """Poses of all places, the last visited one last."""
        return tuple(self._poses.values())

    def find(self, base_T_ee: Array) -> int | None:
        """The index of a pose's place, which becomes the last visited one; None if there is none."""
        for place, pose in reversed(self._poses.items()):
            near = float(np.linalg.norm(pose[:3, 3] - base_T_ee[:3, 3])) <= SAME_M
            if near and rotation_angle(pose[:3, :3].T @ base_T_ee[:3, :3]) <= SAME_RAD:
                self._poses[place] = self._poses.pop(place)
                return place
        return None

    def take(self, base_T_ee: Array) -> int:
        """A place for a new pose; if none is free, the least recently visited one is reused."""
        place = len(self._poses) if len(self._poses) < PLACES else next(iter(self._poses))
        self._poses.pop(place, None)
        self._poses[place] = base_T_ee.copy()
        return place


KINDS: tuple[tuple[Cause, slice, float], ...] = (
    (Cause.CAMERA_MOUNT, CAMERA, 0.3),
    (Cause.PLANE_MOVED, PLANE, 0.3),
    (Cause.LASER_MOVED, LASER, 0.3),
    (Cause.UNKNOWN, slice(0, COUNT), 0.1),
)
"""Cause, which parameters move, and prior probability; the last is a motion of several at once, which is also what an
arm looks like that was moved or has lost its zero.
"""

BACK = len(KINDS)
"""Kind of a belief that everything is back where it was calibrated."""

SCALES = ((1e-3, 1.5e-3), (1e-2, 1.5e-2), (1e-1, 1.5e-1))
"""Standard deviations (m, rad) of the tested motions: a loosening mount, a knock, a fall."""

_RAD = np.array([False] * 3 + [True] * 3 + [True, True, False] + [True, True, False, False])


def assumed(kind: int, scale: int) -> Array:
    """(13, 13): prior covariance of a motion."""
    metres, radians = SCALES[scale]
    variance = np.zeros(COUNT)
    moves = KINDS[kind][1]
    variance[moves] = np.square(np.where(_RAD, radians, metres))[moves]
    return np.diag(variance)


def newborn() -> tuple[Array, Array, Array, Array]:
    """For all kinds and scales: kind (m,), scale (m,), logarithm of the prior share (m,), covariance (m, 13, 13)."""
    pairs = [(kind, scale) for kind in range(len(KINDS)) for scale in range(len(SCALES))]
    shares = np.array([KINDS[kind][2] / len(SCALES) for kind, _ in pairs])
    return (
        np.array([kind for kind, _ in pairs]),
        np.array([scale for _, scale in pairs]),
        np.log(shares),
        np.stack([assumed(kind, scale) for kind, scale in pairs]),
    )


LEAST_PULSES = 3
"""Minimum number of inlier pulses since a motion before it is reported: two wrong spots may look like a motion."""
BACK_AGAIN = 100.0
"""Odds above which moved parts count as back in place."""
_KEPT = 32
_REMEMBERED = 64
"""Number of past pulses whose prior belief is remembered."""
_REIGNING = 12
_HOPELESS = math.log(1e-6)
"""Log weight below which an alternative is dropped: new ones overtake it."""
_NEGLIGIBLE = math.log(1e-5)
"""Log weight relative to the best belief's, below which a reigning belief is dropped."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The test's result for a pulse.  ``odds``: R over the limit for an alarm.  ``candidate``: the one that the best
    belief takes for the spot, ``believed``: whether it accepts it.
    """

    odds: float
    candidate: int
    believed: bool


class MotionTest:
    """The motion test.  ``reigning``: the accepted beliefs; their weights are logarithms of probabilities that add up
    to one.  Until something moves there is only one.
    """

    def __init__(self, calibrated: Calibrated, false_alarms_per_1000: float, wrong_spots: float):
        self._calibrated, self._share = calibrated, wrong_spots
        self._limit = 1000.0 / false_alarms_per_1000
        self._bank = Bank(calibrated)
        self._kinds, self._scales, self._shares, self._assumed = newborn()
        self._diagonal_px = math.hypot(calibrated.camera.width_px, calibrated.camera.height_px)
        self.reset()

    def reset(self) -> None:
        """Start again: everything is as calibrated."""
        self.reigning = as_calibrated(self._calibrated)
        self._others = self.reigning.picked(np.array([], dtype=np.intp))
        self._pulses = 0
        self._history: deque[Beliefs] = deque(maxlen=_REMEMBERED)
        self._before = self.reigning
        self.moved = False

    @property
    def best(self) -> int:
        """Index of the most probable reigning belief."""
        return int(self.reigning.weight.argmax())

    def at_new_place(self, place: int, covariance_px: Array) -> None:
        """A place (by its index) now stands for another pose."""
        for beliefs in (self.reigning, self._others, self._before, *self._history):
            beliefs.at_new_place(place, covariance_px)

    def add(self, pulse: Pulse) -> Finding:
        """Process one pulse, which has at least one candidate."""
        wrong = self._wrong(pulse)
        others = self._others.joined(self._begun())
        if not self.moved:
            self._history.append(self.reigning.picked(np.array([self.best])))
        self._pulses += 1
        gained, candidates, believed = self._bank.weigh(self.reigning, pulse, wrong, self._share)
        weight = self.reigning.weight + gained
        total = float(np.logaddexp.reduce(weight))
        self.reigning.weight = weight - total
        best = self.best
        others.weight = others.weight + self._bank.weigh(others, pulse, wrong, self._share)[0] - total
        self._others = _kept(others, _KEPT, _HOPELESS)
        self._prune()
        odds, back_odds = self._odds()
        candidate, is_believed = int(candidates[best]), bool(believed[best])
        if odds >= 1.0 or back_odds >= 1.0:
            self._others, self.reigning = self._crowned(back=back_odds > odds)
            if not self.moved:
                self._remember(int(self.reigning.born[self.best]))
            self.moved = back_odds <= odds
            candidate, is_believed = self._chosen(pulse)
        return Finding(max(odds, 0.0), candidate, is_believed)

    def _wrong(self, pulse: Pulse) -> Array:
        """(k,) density of wrong spots around the best belief's prediction; 1/px²."""
        best = self.reigning.picked(np.array([self.best]))
        uv_px, rows = self._bank.predicted(best, pulse)
        camera = self._calibrated.camera
        anywhere = 1.0 / (camera.width_px * camera.height_px)
        if not np.isfinite(uv_px).all():
            return np.full(len(pulse.uv_px), anywhere)
        own = rows[0] @ best.covariance[0] @ rows[0].T
        near = math.sqrt(0.5 * float(np.trace(own)) + self._calibrated.sigma_px**2)
        near = min(3.0 * near, 0.1 * self._diagonal_px)
        distance = np.maximum(np.linalg.norm(pulse.uv_px - uv_px[0], axis=1), near)
        around = 1.0 / (2.0 * np.pi * distance**2 * (0.5 + math.log(self._diagonal_px / near)))
        out: Array = 0.5 * (anywhere + around)
        return out

    def _begun(self) -> Beliefs:
        """New alternatives to the best reigning belief: something moved just now, or, after a motion, it is back."""
        count = len(self._kinds)
        out = self.reigning.picked(np.full(count, self.best))
        out.covariance[:, MOVED, MOVED] += self._assumed
        out.weight[:] = self._shares
        out.kind[:], out.scale[:], out.prior[:] = self._kinds, self._scales, self._assumed
        out.pulses[:] = 0
        out.born[:] = self._pulses
        out.motions += 1
        if not self.moved:
            return out
        back = self._before.picked(np.zeros(1, dtype=np.intp))
        back.kind[:], back.weight[:], back.pulses[:], back.born[:] = BACK, 0.0, 0, self._pulses
        return out.joined(back)

    def _remember(self, born: int) -> None:
        """Keep the belief from before the motion, without the influence of later pulses."""
        ago = min(self._pulses - born, len(self._history))
        self._before = self._history[-ago]
        self._history.clear()

    def _prune(self) -> None:
        """Drop reigning beliefs that have become negligible."""
        keep = self.reigning.weight > self.reigning.weight.max() + _NEGLIGIBLE
        if not keep.all():
            self.reigning = self.reigning.picked(keep)

    def _odds(self) -> tuple[float, float]:
        """Odds of a motion and of everything being back, each over its limit."""
        others = self._others
        enough = others.pulses >= LEAST_PULSES
        back = others.kind == BACK
        sums = [float(np.exp(np.minimum(others.weight[enough & which], 700.0)).sum()) for which in (~back, back)]
        return sums[0] / self._limit, sums[1] / BACK_AGAIN

    def _crowned(self, *, back: bool) -> tuple[Beliefs, Beliefs]:
        """An empty set of alternatives, and the beliefs that reign from now on."""
        others = self._others
        right = (others.pulses >= LEAST_PULSES) & ((others.kind == BACK) == back)
        chosen = _kept(others.picked(right), 1 if back else _REIGNING)
        chosen.weight = chosen.weight - np.logaddexp.reduce(chosen.weight)
        if back:
            chosen.kind[:] = -1
        return others.picked(np.array([], dtype=np.intp)), chosen

    def _chosen(self, pulse: Pulse) -> tuple[int, bool]:
        """The candidate that the best belief takes, and whether it accepts it, after an update with it."""
        best = self.reigning.picked(np.array([self.best]))
        _, candidates, believed = self._bank.weigh(best, pulse, self._wrong(pulse), self._share)
        return int(candidates[0]), bool(believed[0])


def _kept(beliefs: Beliefs, most: int, least: float = -math.inf) -> Beliefs:
    """The beliefs with the largest weights, at most ``most``, of those with weight above ``least``."""
    heavy = np.argsort(-beliefs.weight, kind="stable")[:most]
    return beliefs.picked(np.sort(heavy[beliefs.weight[heavy] > least]))
