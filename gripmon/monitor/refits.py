"""The fit of one frame made once more under each hypothesis, and what that bounds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array, Protection
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, NormalEquations, prior_information
from gripmon.track.integrity import Doubts, Hypotheses, Separation, separate

INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Stands for no bound at all."""


class Anchored(NamedTuple):
    """Fits with the anchor's pose as one more measurement, how much that surprises each of them, (h,), and how they are
    off by the model, (h, f, 6).
    """

    fits: Separation
    surprise: Array
    of_model: Array


class ModelError(NamedTuple):
    """What the gripper file may be wrong by: each finger longer or shorter by ``sigma_m``, along ``axis_grip`` (3,);
    ``finger`` (e,) that each edge belongs to.
    """

    sigma_m: float
    axis_grip: Array
    finger: NDArray[np.intp]

    def pulls(self, normal: NormalEquations, rotation: Array) -> Array:
        """(f, v, m) by which that pulls at a fit, finger by finger: one that is longer by all its edges together.
        ``rotation`` (3, 3) from gripper to camera.
        """
        by_edge = self.sigma_m * normal.information[:, :, :3] @ (rotation @ self.axis_grip)
        own = self.finger[normal.edge] == np.arange(self.finger.max() + 1)[:, None]
        return np.asarray(own[:, :, None] * by_edge)


def of_fingers(away: Array) -> Array:
    """(h, 6, 6) covariances of poses (h, f, 6) that are off by one standard deviation of each finger's length."""
    return np.einsum("hfi,hfj->hij", away, away)


def protection_of(doubts: Doubts, risk: float) -> Protection:
    """The protection levels at a ``risk``."""
    position_m, rotation_rad, name = doubts.levels(risk)
    return Protection(min(position_m, UNBOUNDED_M), min(rotation_rad, UNBOUNDED_RAD), risk, name)


class Refits:
    """One measurement's fits under h hypotheses."""

    def __init__(self, measurement: Measurement, hypotheses: Hypotheses, floor: Array, model: ModelError):
        """``floor`` (6,): variances of the error that no averaging removes."""
        self.hypotheses, self._floor = hypotheses, np.diag(floor)
        self._normal = measurement.normal
        xi = measurement.consensus.xi
        self._fit_T = perturb(measurement.prediction.cam_T_grip, xi[:6])
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
        pulls = model.pulls(self._normal, self._fit_T[:3, :3])
        self._pulls = np.einsum("hv,fvi->hfi", hypotheses.keep, pulls)
        self.of_model = self._off(self.free, self._pulls)
        """(h, f, 6) of how the fits are off where a finger is longer by its standard deviation."""

    def _separate(self, known: Array, pull: Array) -> Separation:
        normal = self._normal
        return separate(normal.pull, normal.information, normal.middle, self.hypotheses.keep, known, pull)

    @staticmethod
    def _off(fits: Separation, pulls: Array) -> Array:
        return np.einsum("hij,hfj->hfi", fits.inverse, pulls)[:, :, :6]

    def anchored(self, anchor_T: Array, covariance: Array, of_model: Array) -> Anchored:
        """The fits with the gripper known to be at ``anchor_T`` (4, 4) but for ``covariance`` (6, 6), and off by the
        model by ``of_model`` (f, 6).
        """
        information = np.linalg.inv(covariance + self._floor)
        at = perturbation_between(self._fit_T, anchor_T)
        known, pull = self._known.copy(), self._pull.copy()
        known[:, :6, :6] += information
        pull[:, :6] += information @ at
        fits = self._separate(known, pull)
        # The free fit's distance from the anchor, in units of both covariances.
        way = self.free.shift[:, :6] - at
        both = INFLATION**2 * self.free.covariance[:, :6, :6] + covariance + self._floor
        surprise = np.einsum("hi,hi->h", way, np.linalg.solve(both, way[:, :, None])[:, :, 0])
        pulls = self._pulls.copy()
        pulls[:, :, :6] += of_model @ information
        return Anchored(fits, surprise, self._off(fits, pulls))

    @property
    def edges(self) -> NDArray[np.intp]:
        """(v,) that the fits are made of."""
        return self._normal.edge

    def shifts(self, base_T: Array) -> Array:
        """(h, 6) from a pose (4, 4) near by to the fits by the frame alone."""
        return perturbation_between(base_T, self._fit_T) + self.free.shift[:, :6]

    def free_covariance(self) -> Array:
        """(h, 6, 6) of the fits by the frame alone, without the model's error."""
        return self.free.covariance[:, :6, :6] + self._floor

    def doubts(self, cam_T_grip: Array, prior: Array, anchored: Anchored | None = None) -> Doubts:
        """What may be wrong with a published pose (4, 4) under hypotheses of probability ``prior`` (h,), by the frame
        alone or by the anchor too.
        """
        fits, of_model = (self.free, self.of_model) if anchored is None else (anchored.fits, anchored.of_model)
        away = fits.shift[:, :6] - perturbation_between(self._fit_T, cam_T_grip)
        covariance = fits.covariance[:, :6, :6] + self._floor + of_fingers(of_model) / INFLATION**2
        return Doubts.of(self.hypotheses.name, prior, away, covariance, INFLATION)

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number, :6])
        return pose, anchored.fits.covariance[number, :6, :6] + self._floor


def larger(one: Protection, other: Protection) -> Protection:
    """The larger one of two bounds, for position and for rotation."""
    first, second = (one, other) if one.position_m >= other.position_m else (other, one)
    return Protection(first.position_m, max(first.rotation_rad, second.rotation_rad), first.risk, first.hypothesis)
