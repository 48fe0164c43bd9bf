"""The fit of one frame made once more under each hypothesis, and what that bounds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.corners import JAW_UNREPORTED_SIGMA_M, Measurement, prior_information
from gripmon.geometry import perturb, perturbation_between
from gripmon.integrity import Hypotheses, Separation, levels, separate
from gripmon.records import Array, Protection

INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Stands for no bound at all."""


class Anchored(NamedTuple):
    """Fits with the anchor's pose as one more measurement, and how much that surprises each of them, (h,)."""

    fits: Separation
    surprise: Array


class ModelError(NamedTuple):
    """What the gripper file may be wrong by: each finger longer or shorter by ``sigma_m``, along ``axis_grip`` (3,);
    ``finger`` (e,) that each edge belongs to.
    """

    sigma_m: float
    axis_grip: Array
    finger: NDArray[np.intp]

    def of_pose(self, inverse: Array, information: Array, edge: NDArray[np.intp], rotation: Array) -> Array:
        """(6, 6) covariance of the pose by that: a finger that is longer pulls by all its edges together.

        ``inverse`` (m, m) of the normal matrix, ``information`` (v, m, m) of the edges ``edge`` (v,), ``rotation``
        (3, 3) from gripper to camera.
        """
        out = np.zeros((6, 6))
        finger = self.finger[edge]
        for number in np.unique(finger):
            pull = (inverse @ information[finger == number].sum(axis=0)[:, :3] @ (rotation @ self.axis_grip))[:6]
            out += self.sigma_m**2 * np.outer(pull, pull)
        return out


class Levels(NamedTuple):
    """Bounds of ``position`` and ``rotation`` (h,) under hypotheses; ``counted`` (h,): those whose probability isn't
    below their share of the ``risk``.
    """

    position: Array
    rotation: Array
    counted: NDArray[np.bool_]
    risk: float
    name: tuple[str, ...]

    def worst(self, among: NDArray[np.bool_]) -> Protection:
        """The largest of those ``among`` (h,) that count."""
        counted = np.flatnonzero(self.counted & among)
        if not len(counted):
            return Protection(0.0, 0.0, self.risk, "")
        worst = int(counted[np.argmax(self.position[counted])])
        return Protection(
            min(float(self.position[worst]), UNBOUNDED_M),
            min(float(self.rotation[counted].max()), UNBOUNDED_RAD),
            self.risk,
            self.name[worst],
        )


class Refits:
    """One measurement's fits under h hypotheses, about the published pose ``cam_T_grip`` (4, 4)."""

    def __init__(
        self, measurement: Measurement, cam_T_grip: Array, hypotheses: Hypotheses, floor: Array, model: ModelError
    ):
        """``floor`` (6,): variances of the error that no averaging removes."""
        self.cam_T_grip, self._hypotheses, self._floor = cam_T_grip, hypotheses, floor
        self._normal = measurement.normal
        xi = measurement.consensus.xi
        self._fit_T = perturb(measurement.prediction.cam_T_grip, xi[:6])
        self._published = perturbation_between(self._fit_T, cam_T_grip)
        count, m = len(hypotheses.name), len(xi)
        self._known = np.zeros((count, m, m))
        self._pull = np.zeros((count, m))
        vague = prior_information(JAW_UNREPORTED_SIGMA_M if m == 7 else None)
        self._known[:, range(m), range(m)] = vague
        if m == 7:
            fitted_m = measurement.prediction.jaw_opening_m + float(xi[6])
            told = np.where(hypotheses.opening, vague[6], max(measurement.jaw_known_sigma_m, 1e-6) ** -2)
            self._known[:, 6, 6] = told
            self._pull[:, 6] = told * (measurement.jaw_known_m - fitted_m)
        self.free = self._separate(self._known, self._pull)
        normal = self._normal
        inverse = np.linalg.inv(normal.information.sum(axis=0) + self._known[0])
        self._of_model = model.of_pose(inverse, normal.information, normal.edge, cam_T_grip[:3, :3])

    def _separate(self, known: Array, pull: Array) -> Separation:
        normal = self._normal
        return separate(normal.pull, normal.information, normal.middle, self._hypotheses.keep, known, pull)

    def anchored(self, anchor_T: Array, covariance: Array) -> Anchored:
        """The fits with the gripper known to be at ``anchor_T`` (4, 4) but for ``covariance`` (6, 6)."""
        information = np.linalg.inv(covariance + np.diag(self._floor))
        at = perturbation_between(self._fit_T, anchor_T)
        known, pull = self._known.copy(), self._pull.copy()
        known[:, :6, :6] += information
        pull[:, :6] += information @ at
        fits = self._separate(known, pull)
        # The free fit's distance from the anchor, in units of both covariances.
        way = self.free.shift[:, :6] - at
        both = INFLATION**2 * self.free.covariance[:, :6, :6] + covariance + np.diag(self._floor)
        surprise = np.einsum("hi,hi->h", way, np.linalg.solve(both, way[:, :, None])[:, :, 0])
        return Anchored(fits, surprise)

    def levels(self, prior: Array, risk: float, anchored: Anchored) -> tuple[Levels, Levels]:
        """Bounds under each hypothesis, by the frame alone and by the anchor too; ``prior`` (h,) of each."""
        count = len(prior)
        shift = np.concatenate([self.free.shift[:, :6], anchored.fits.shift[:, :6]])
        covariance = np.concatenate([self.free.covariance[:, :6, :6], anchored.fits.covariance[:, :6, :6]])
        covariance[:, range(6), range(6)] += self._floor
        covariance[[self._hypotheses.model, count + self._hypotheses.model]] += self._of_model / INFLATION**2
        share = risk / count / np.maximum(prior, 1e-300)
        position, rotation = levels(shift - self._published, covariance, np.tile(share, 2), INFLATION)
        counted = prior > risk / count
        return (
            Levels(position[:count], rotation[:count], counted, risk, self._hypotheses.name),
            Levels(position[count:], rotation[count:], counted, risk, self._hypotheses.name),
        )

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number, :6])
        return pose, anchored.fits.covariance[number, :6, :6] + np.diag(self._floor)


def larger(one: Protection, other: Protection) -> Protection:
    """The larger one of two bounds, for position and for rotation."""
    first, second = (one, other) if one.position_m >= other.position_m else (other, one)
    return Protection(first.position_m, max(first.rotation_rad, second.rotation_rad), first.risk, first.hypothesis)
