"""What may have moved since a laser calibration, as explanations of fresh spots that are compared by their evidence.

Every explanation is a set-up that is uncertain: "nothing moved" by the calibration's covariance C, "the camera moved"
by C and a motion of the camera's six parameters of an assumed size, and so on for the plane, the pointer, and all of
them.  Its evidence is the probability density that it gives to the spots: by Laplace's method, at the set-up that fits
best under it.

A spot may be wrong: a reflection, or speckle beside it.  Half of the wrong spots are assumed uniform over the image,
half centred on where the calibration has the spot, uniform in the logarithm of the distance.  Spots from one pose count
together as one, since the errors of arm and lens are the same for them: of m spots each has the weight 1 / m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.bundle import independent_errors
from gripmon.laser.documents import Calibrated
from gripmon.laser.setup import (
    CAMERA,
    COUNT,
    LASER,
    PLANE,
    LaserSetup,
    in_camera,
    spots_in_camera,
    spots_on_plane,
)
from gripmon.laser.spots import Spot
from gripmon.model.geometry import rotation_angle
from gripmon.model.least_squares import Equations, minimise, normal_equations, whitening
from gripmon.model.records import Array, Cause

KINDS: tuple[tuple[Cause, slice, float], ...] = (
    (Cause.CAMERA_MOUNT, CAMERA, 0.3),
    (Cause.PLANE_MOVED, PLANE, 0.3),
    (Cause.LASER_MOVED, LASER, 0.3),
    (Cause.UNKNOWN, slice(0, COUNT), 0.1),
)
"""Cause, which parameters move, and prior share; the last is a motion of several at once, which is also what an arm
looks like that was moved or has lost its zero.
"""
SCALES = ((1e-3, 1.5e-3), (3e-3, 4.5e-3), (1e-2, 1.5e-2), (3e-2, 4.5e-2), (1e-1, 1.5e-1))
"""Standard deviations (m, rad) of the assumed motions, from a loosening mount to a fall: so close together that a
motion of one part is assumed large enough by one of them, and doesn't pass for smaller ones of several.
"""
SAME_M, SAME_RAD = 5e-3, 0.02
"""Largest distance between poses that count as one (m, rad): the arm's error doesn't change noticeably over it."""
_NEAR = 3.0
"""Wrong spots are no denser than at this many standard deviations from the prediction."""
_ITERATIONS, _LAST_ITERATIONS = 5, 50
_IS_ANGLE = np.array([False] * 3 + [True] * 3 + [True, True, False] + [True, True, False, False])


class Foreseen(NamedTuple):
    """Spots as the calibration has them: pixels (n, 2), NaN where there is none, their derivatives (n, 2, 13) by the
    set-up, and their covariances (n, 2, 2) by the arm and by the calibration.
    """

    uv_px: Array
    rows: Array
    by_arm: Array
    by_calibration: Array


def foresee(known: Calibrated, base_T_ee: Array, arm: Array) -> Foreseen:
    """The spots at poses (n, 4, 4); ``arm`` (6, 6): covariance of these."""
    spots, slopes = spots_in_camera(known.setup, base_T_ee)
    uv_px, by_point = known.camera.project_with_jacobian(spots)
    slopes = by_point @ slopes
    rows, by_pose = slopes[:, :, :COUNT], slopes[:, :, COUNT:]
    by_arm = by_pose @ arm @ by_pose.transpose(0, 2, 1)
    return Foreseen(uv_px, rows, by_arm, rows @ known.covariance @ rows.transpose(0, 2, 1))


@dataclass(frozen=True, slots=True)
class Fit:
    """A set-up fitted to the spots: ``change`` (13,) since the calibration with its ``covariance``, the logarithm of
    the ``evidence``, and for each sample whether its spot is believed and which candidate that is.
    """

    setup: LaserSetup
    change: Array
    covariance: Array
    evidence: float
    used: NDArray[np.bool_]
    candidate: NDArray[np.intp]


class _State(NamedTuple):
    """The set-up, and the change since the calibration (13,) in standard deviations of an explanation's prior."""

    setup: LaserSetup
    normal: Array


class Evidence:
    """Fresh spots, and what explanations make of them.  n samples at ``base_T_ee`` (n, 4, 4), each with at least one
    candidate for its spot; of all m candidates: ``uv_px`` and ``foreseen_px`` (m, 2) by the calibration, their
    ``noise`` (m, 2, 2) by spot and arm, and ``spread`` (m, 2, 2) by calibration, spot and arm; ``first`` (n,): where
    each sample's candidates begin.  ``arm`` (6, 6): covariance of the arm's poses; ``wrong``: share of wrong spots.
    """

    def __init__(self, known: Calibrated, base_T_ee: Array, spots: Sequence[Sequence[Spot]], arm: Array, wrong: float):
        self._known, self._wrong, self.base_T_ee = known, wrong, base_T_ee
        counts = np.array([len(each) for each in spots])
        self._of_sample = np.repeat(np.arange(len(spots)), counts)
        self.first = np.cumsum([0, *counts[:-1]])
        self.uv_px = np.array([spot.uv_px for each in spots for spot in each])
        own = np.array([spot.covariance_px for each in spots for spot in each])
        foreseen = foresee(known, base_T_ee, arm)
        self.foreseen_px = foreseen.uv_px[self._of_sample]
        self._rows = foreseen.rows[self._of_sample]
        # Spots of this camera are no better than the calibration's, however well one of them looks.
        self.noise = covariance_max(own, known.sigma_px**2 * np.eye(2)) + foreseen.by_arm[self._of_sample]
        self.spread = self._rows @ known.covariance @ self._rows.transpose(0, 2, 1) + self.noise
        self._whiten = whitening(self.noise)
        densest = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(self.noise)))
        self._most_odds = (1.0 - wrong) / counts[self._of_sample] * densest / self._wrong_density()
        self._weights = 1.0 / _same_poses(base_T_ee)
        # What makes costs positive, for tolerances are relative.
        self._zero = 2.0 * float(self._weights @ np.log(wrong + self._summed(self._most_odds)))

    def _wrong_density(self) -> Array:
        """(m,) density of wrong spots at the candidates, 1/px²."""
        camera = self._known.camera
        diagonal = math.hypot(camera.width_px, camera.height_px)
        near = np.minimum(_NEAR * np.sqrt(0.5 * np.trace(self.spread, axis1=1, axis2=2)), 0.1 * diagonal)
        distance = np.maximum(np.linalg.norm(self.uv_px - self.foreseen_px, axis=1), near)
        around = 1.0 / (2.0 * np.pi * distance**2 * (0.5 + np.log(diagonal / near)))
        out: Array = 0.5 / (camera.width_px * camera.height_px) + 0.5 * around
        return out

    def of(self, moved: tuple[int, int] | None) -> Fit:
        """The best set-up under an explanation: a kind of motion and its scale, or None for no motion."""
        prior = self._known.covariance if moved is None else self._known.covariance + assumed_motion(*moved)
        root = independent_errors(prior).T
        wide = self._whiten @ self._rows @ root
        # Begin with spots as uncertain as the explanation has them, so that all can take part; then as they are.
        scale = max(math.sqrt(0.5 * float(np.square(wide).sum(axis=(1, 2)).max())), 1.0)
        state = _State(self._known.setup, np.zeros(COUNT))
        while scale > 1.5:
            state = self._fitted(state, root, scale, _ITERATIONS)
            scale *= 0.5
        state = self._fitted(state, root, 1.0, _LAST_ITERATIONS)
        odds, total = self._odds(state, 1.0)
        information = np.eye(COUNT) + self._equations(state, root, 1.0)[0]
        evidence = float(self._weights @ np.log(self._wrong + total)) - 0.5 * float(state.normal @ state.normal)
        evidence -= 0.5 * float(np.linalg.slogdet(information)[1])
        covariance = root @ np.linalg.inv(information) @ root.T
        best = np.array([int(part.argmax()) for part in np.split(odds, self.first[1:])])
        return Fit(state.setup, root @ state.normal, covariance, evidence, total > self._wrong, best)

    def motion(self, kind: int, fit: Fit) -> tuple[Array, Array]:
        """What of a fit's change under the widest explanation of a kind is motion (13,), with covariance (13, 13); the
        rest is the calibration's own error.
        """
        assumed = assumed_motion(kind, len(SCALES) - 1)
        share = np.linalg.solve(self._known.covariance + assumed, assumed).T
        covariance = share @ fit.covariance @ share.T + assumed - share @ assumed
        return share @ fit.change, covariance

    def _fitted(self, state: _State, root: Array, scale: float, iterations: int) -> _State:
        def cost(at: _State) -> float:
            total = self._odds(at, scale)[1]
            fitted = 2.0 * float(self._weights @ np.log(self._wrong + total))
            return float(at.normal @ at.normal) + self._zero - fitted

        def equations(at: _State) -> Equations:
            normal, side = self._equations(at, root, scale)
            return normal + np.eye(COUNT), side - at.normal

        def moved(at: _State, step: Array) -> _State:
            return _State(at.setup.moved(root @ step), at.normal + step)

        return minimise(state, cost, equations, moved, iterations=iterations).state

    def _odds(self, state: _State, scale: float) -> tuple[Array, Array]:
        """Of each candidate the odds (m,) that it is the spot against that it is wrong, and their sums (n,)."""
        values = self._values(state)
        odds = self._most_odds * np.exp(-0.5 * np.square(values).sum(axis=1) / scale**2) / scale**2
        odds = np.where(np.isfinite(odds), odds, 0.0)
        return odds, self._summed(odds)

    def _summed(self, odds: Array) -> Array:
        return np.asarray(np.bincount(self._of_sample, odds), dtype=float)

    def _values(self, state: _State) -> Array:
        """Whitened residuals (m, 2)."""
        off = self.uv_px - self.predicted_px(state.setup)[self._of_sample]
        out: Array = np.einsum("mij,mj->mi", self._whiten, off)
        return out

    def _equations(self, state: _State, root: Array, scale: float) -> Equations:
        """Normal equations of the spots alone, each candidate weighted by how probably it is the spot."""
        spots, slopes = spots_in_camera(state.setup, self.base_T_ee)
        _, by_point = self._known.camera.project_with_jacobian(spots)
        rows = self._whiten @ (by_point @ slopes[:, :, :COUNT])[self._of_sample] @ root
        values = self._values(state)
        odds, total = self._odds(state, scale)
        weights = (odds / (self._wrong + total[self._of_sample])) * self._weights[self._of_sample] / scale**2
        good = np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
        rows[~good], values[~good], weights[~good] = 0.0, 0.0, 0.0
        return normal_equations(rows, values, weights)


    def predicted_px(self, setup: LaserSetup) -> Array:
        """Pixels (n, 2) of the spots of another set-up; NaN where there is none."""
        return self._known.camera.project(in_camera(setup, spots_on_plane(setup, self.base_T_ee)))

def assumed_motion(kind: int, scale: int) -> Array:
    """(13, 13): prior covariance of a motion."""
    metres, radians = SCALES[scale]
    variance = np.zeros(COUNT)
    moves = KINDS[kind][1]
    variance[moves] = np.square(np.where(_IS_ANGLE, radians, metres))[moves]
    return np.diag(variance)


def covariance_max(a: Array, b: Array) -> Array:
    """The smallest covariances (..., k, k) that are nowhere below either of two; ``b`` positive definite."""
    root = np.linalg.cholesky(b)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ a @ inverse.swapaxes(-1, -2))
    out: Array = root @ (axes * np.maximum(values, 1.0)[..., None, :]) @ axes.swapaxes(-1, -2) @ root.swapaxes(-1, -2)
    return out


def _same_poses(base_T_ee: Array) -> Array:
    """How many poses (n, 4, 4) count as the same as each (n,), itself included."""
    turns = np.array([[rotation_angle(a.T @ b) for b in base_T_ee[:, :3, :3]] for a in base_T_ee[:, :3, :3]])
    apart = np.linalg.norm(base_T_ee[:, None, :3, 3] - base_T_ee[None, :, :3, 3], axis=2)
    out: Array = ((apart <= SAME_M) & (turns <= SAME_RAD)).sum(axis=1).astype(float)
    return out
