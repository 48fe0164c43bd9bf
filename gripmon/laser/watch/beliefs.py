"""Normal beliefs about a set-up, many beside one another: how it was calibrated, by how much it has moved since, and by
how much the arm and the lens are off at the poses where pulses come from.

What the calibration is off by is the same for all pulses; what the arm and the lens are off by is the same for pulses
from one pose.  Both are unknowns with a known covariance here, so that no number of pulses is mistaken for as many
independent witnesses.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from gripmon.laser.watch.world import COUNT, Calibrated, foresee_moved
from gripmon.model.geometry import rotation_angle
from gripmon.model.records import Array

PLACES = 12
"""Poses whose own offset is remembered; the one that was least recently visited is forgotten for a new one."""
MOVED = slice(COUNT, 2 * COUNT)
SIZE = 2 * COUNT + 2 * PLACES
_FAR = 0.2
"""Curvature, in standard deviations of a spot, up to which the calibration's own derivatives serve."""
_ITERATIONS = 4
SAME_M, SAME_RAD = 5e-3, 0.02
"""How far apart poses of one place are at most: less than what an arm's error changes over."""


@dataclass(slots=True)
class Beliefs:
    """n of them: ``mean`` (n, 50) of the calibration's error (13), the motion since (13), and the places' offsets (12
    times 2, px), with ``covariance`` (n, 50, 50); ``weight`` (n,) logarithm of how much better than the reigning belief
    it has foreseen the pulses; ``kind`` and ``scale`` (n,) what moved in it at last and by what order, ``pulses`` (n,)
    which of them were believed since, ``born`` (n,) how many there were before, ``prior`` (n, 13, 13) what was assumed
    of that motion and ``motions`` (n,) how many there were.
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
        """Those only, as a copy."""
        return Beliefs(*(getattr(self, field.name)[which] for field in fields(self)))

    def joined(self, others: Beliefs) -> Beliefs:
        """All of both."""
        return Beliefs(
            *(np.concatenate([getattr(self, field.name), getattr(others, field.name)]) for field in fields(self))
        )

    def at_new_place(self, place: int, covariance_px: Array) -> None:
        """A place (its index) is another pose now."""
        rows = slice(2 * COUNT + 2 * place, 2 * COUNT + 2 * place + 2)
        self.mean[:, rows] = 0.0
        self.covariance[:, rows, :] = 0.0
        self.covariance[:, :, rows] = 0.0
        self.covariance[:, rows, rows] = covariance_px


def as_calibrated(calibrated: Calibrated) -> Beliefs:
    """One belief: nothing has moved."""
    covariance = np.zeros((1, SIZE, SIZE))
    covariance[0, :COUNT, :COUNT] = calibrated.covariance
    none = np.zeros(1, dtype=np.intp)
    return Beliefs(
        np.zeros((1, SIZE)), covariance, np.zeros(1), none - 1, none.copy(), none.copy(), none.copy(),
        np.zeros((1, COUNT, COUNT)), none.copy(),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Pulse:
    """``uv_px`` (k, 2) of the candidates with ``covariance_px`` (k, 2, 2), seen at a pose (4, 4) of a ``place``; the
    calibration foresees ``foreseen_px`` (2,) with derivatives ``rows`` (2, 13).
    """

    base_T_ee: Array
    place: int
    uv_px: Array
    covariance_px: Array
    foreseen_px: Array
    rows: Array


class Bank:
    """Foresees pulses by beliefs and lets these learn from them."""

    def __init__(self, calibrated: Calibrated):
        self._calibrated = calibrated
        self._focal_px = 0.5 * (calibrated.camera.fx_px + calibrated.camera.fy_px)

    def foreseen(self, beliefs: Beliefs, pulse: Pulse) -> tuple[Array, Array]:
        """Pixels (n, 2), NaN where a belief foresees none, and derivatives (n, 2, 50) by the beliefs' means."""
        change = beliefs.mean[:, :COUNT] + beliefs.mean[:, MOVED]
        shifts = change[:, None, :] * pulse.rows
        uv_px = pulse.foreseen_px + shifts.sum(axis=2)
        rows = np.tile(pulse.rows, (len(beliefs), 1, 1))
        reach = np.sqrt(_FAR * self._calibrated.sigma_px * self._focal_px)
        left = np.flatnonzero(np.abs(shifts).sum(axis=2).max(axis=1) > reach)
        while len(left):
            # Derivatives where one of them is serve all that are near it.
            found = foresee_moved(self._calibrated, change[left[0]], pulse.base_T_ee)
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
        """What a pulse says of each belief, which then learns from it.

        ``wrong`` (k,): density of a wrong spot where each candidate is (1/px²), ``share`` how often a pulse has none
        but wrong ones.  Returns logarithms (n,) of how probable the candidates are, over all of them being wrong; which
        candidate (n,) is the spot; and whether any is (n,).
        """
        uv_px, rows = self.foreseen(beliefs, pulse)
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
        """Covariance (n, 2, 2) of what derivatives miss of an image that is foreseen so roughly: a central projection
        bends by the square of a shift over the focal length.
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
        """The step was large: derivatives where it led to, Gauss-Newton (the iterated extended Kalman filter)."""
        one = np.array([k])
        prior = beliefs.covariance[k] + taken
        for _ in range(_ITERATIONS):
            uv_px, there = self.foreseen(beliefs.picked(one), pulse)
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
    """The last places, each with the first pose (4, 4) that was seen there."""

    def __init__(self) -> None:
        self._poses: dict[int, Array] = {}  # least recently visited first

    @property
    def poses(self) -> tuple[Array, ...]:
        """Of all places, the last visited one last."""
        return tuple(self._poses.values())

    def find(self, base_T_ee: Array) -> int | None:
        """The index of a pose's place; it is the last visited one from now on."""
        for place, pose in reversed(self._poses.items()):
            near = float(np.linalg.norm(pose[:3, 3] - base_T_ee[:3, 3])) <= SAME_M
            if near and rotation_angle(pose[:3, :3].T @ base_T_ee[:3, :3]) <= SAME_RAD:
                self._poses[place] = self._poses.pop(place)
                return place
        return None

    def take(self, base_T_ee: Array) -> int:
        """A place for a pose that has none, an older one's if there is none left."""
        place = len(self._poses) if len(self._poses) < PLACES else next(iter(self._poses))
        self._poses.pop(place, None)
        self._poses[place] = base_T_ee.copy()
        return place
