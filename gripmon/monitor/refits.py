"""The fit of one frame made once more under each hypothesis, and what that bounds."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Protection
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, NormalEquations, prior_information
from gripmon.track.integrity import Doubts, Hypotheses, Separation, Sums, with_and_without

SIGMA_INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Stands for no bound at all."""


@cache
def _vague(count: int, m: int) -> Array:
    """(count, m, m) information that keeps m unknowns solvable whatever is seen."""
    information = prior_information(JAW_UNREPORTED_SIGMA_M if m == 7 else None)
    return np.tile(np.diag(information), (count, 1, 1))


class Anchored(NamedTuple):
    """Fits with the anchor's pose as one more measurement, and how much that surprises each of them, (h,)."""

    fits: Separation
    surprise: Array


class Known(NamedTuple):
    """The anchor as a measurement: its pose (4, 4), the covariance (6, 6), and by how much it is off by the model,
    (f, 6) or (1, 6) of zeros.
    """

    anchor_T: Array
    covariance: Array
    of_model: Array


class ModelError(NamedTuple):
    """What the gripper file may be wrong by: each finger longer or shorter by ``sigma_m``, along ``axis_grip`` (3,);
    ``finger`` (e,) that each edge belongs to, of ``fingers``.
    """

    sigma_m: float
    axis_grip: Array
    finger: NDArray[np.intp]
    fingers: int

    def pulls(self, normal: NormalEquations, rotation: Array) -> tuple[Array, NDArray[np.intp], int]:
        """(v, m) by which that pulls at a fit, edge by edge: a finger that is longer, by all its edges together; and
        the finger (v,) of each, of how many.  ``rotation`` (3, 3) from gripper to camera.
        """
        by_edge = normal.information[:, :, :3] @ (rotation @ (self.sigma_m * self.axis_grip))
        return by_edge, self.finger[normal.edge], self.fingers


def protection_of(doubts: Doubts, risk: float) -> Protection:
    """The protection levels at a ``risk``."""
    position_m, rotation_rad, name = doubts.levels(risk)
    return Protection(min(position_m, UNBOUNDED_M), min(rotation_rad, UNBOUNDED_RAD), risk, name)


class Refits:
    """One measurement's fits under h hypotheses, alone and with what is ``known`` from the anchor."""

    def __init__(
        self,
        measurement: Measurement,
        hypotheses: Hypotheses,
        floor: Array,
        model: ModelError,
        known: Known | None = None,
    ):
        """``floor`` (6, 6): covariance of the error that no averaging removes."""
        self.hypotheses, self._floor = hypotheses, floor
        normal = self._normal = measurement.normal
        xi = measurement.consensus.xi
        self._fit_T = perturb(measurement.prediction.cam_T_grip, xi[:6])
        count, m = len(hypotheses.name), len(xi)
        held, pull = _vague(count, m).copy(), np.zeros((count, m))
        if m == 7:
            fitted_m = measurement.prediction.jaw_opening_m + float(xi[6])
            held[~hypotheses.opening, 6, 6] = max(measurement.jaw_known_sigma_m, 1e-6) ** -2
            pull[:, 6] = held[:, 6, 6] * (measurement.jaw_known_m - fitted_m)
        pulls = model.pulls(normal, self._fit_T[:3, :3])
        of = normal.pull, normal.information, normal.middle, pulls, hypotheses.keep, held, pull
        self.anchored: Anchored | None = None
        """The same with the anchor; None where nothing is known of one."""
        if known is None:
            self._free = Sums.of_kept(*of).fits()
        else:
            at, covariance = perturbation_between(self._fit_T, known.anchor_T), known.covariance + floor
            # The free fit's distance from the anchor, in units of both covariances.
            self._free, fits, surprise = with_and_without(*of, at, covariance, known.of_model, SIGMA_INFLATION**2)
            self.anchored = Anchored(fits, surprise)
        self.covariance: Array = self._free.covariance + self._floor
        """(h, 6, 6) of the fits by the frame alone, without the model's error."""
        self.of_model = self._free.of_model
        """(h, f, 6) of how those are off where a finger is longer by its standard deviation."""

    @property
    def edges(self) -> NDArray[np.intp]:
        """(v,) that the fits are made of."""
        return self._normal.edge

    def shifts(self, base_T: Array) -> Array:
        """(h, 6) from a pose (4, 4) near by to the fits by the frame alone."""
        return perturbation_between(base_T, self._fit_T) + self._free.shift

    def doubts(self, cam_T_grip: Array, prior: Array, anchored: Anchored | None = None) -> Doubts:
        """What may be wrong with a published pose (4, 4) under hypotheses of probability ``prior`` (h,), by the frame
        alone or by the anchor too.
        """
        fits = self._free if anchored is None else anchored.fits
        away = fits.shift - perturbation_between(self._fit_T, cam_T_grip)
        fits = Separation(away, fits.covariance + self._floor, fits.of_model)
        return Doubts.of(self.hypotheses.name, prior, fits, SIGMA_INFLATION)

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number])
        return pose, anchored.fits.covariance[number] + self._floor


def reaching(bound: Protection, away: Array, hypothesis: str) -> Protection:
    """A bound on the error of one pose as one of another, ``away`` (6,) from it."""
    return Protection(
        bound.position_m + float(np.linalg.norm(away[:3])),
        bound.rotation_rad + float(np.linalg.norm(away[3:])),
        bound.risk,
        hypothesis,
    )


def larger(one: Protection, other: Protection) -> Protection:
    """The larger one of two bounds, for position and for rotation."""
    first, second = (one, other) if one.position_m >= other.position_m else (other, one)
    return Protection(first.position_m, max(first.rotation_rad, second.rotation_rad), first.risk, first.hypothesis)
