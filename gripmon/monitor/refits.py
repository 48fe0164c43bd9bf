"""The fit of one frame repeated under each hypothesis, alone and with what is known of the pose from before."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array
from gripmon.monitor.bounds import SIGMA_INFLATION, Cases, ModelError
from gripmon.monitor.since import Opened
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, prior_information
from gripmon.track.integrity import Hypotheses, Knocks, Separation, knocked, with_and_without


@cache
def _vague(count: int, m: int) -> Array:
    """(count, m, m) information that keeps m unknowns solvable whatever is seen."""
    information = prior_information(JAW_UNREPORTED_SIGMA_M if m == 7 else None)
    return np.tile(np.diag(information), (count, 1, 1))


@cache
def _in_the_references_frames(names: tuple[str, ...]) -> tuple[str, ...]:
    """What lasting hypotheses but the first are called where they hold in those frames alone."""
    return tuple(f"{name}, in the frames of the reference" for name in names[1:])


class Anchored(NamedTuple):
    """Fits with the anchor's pose as one more measurement, and the ``square`` (h,) of its normalised innovation against
    each fit without it.
    """

    fits: Separation
    square: Array


class Known(NamedTuple):
    """The anchor as a measurement: its pose (4, 4), the covariance (6, 6), and its error (f, 6) where a finger's length
    is off by its standard deviation, or (1, 6) of zeros.
    """

    anchor_T: Array
    covariance: Array
    of_model: Array


class Refits:
    """One measurement's fits under h hypotheses, alone and with what is ``known`` of the pose from before."""

    def __init__(
        self,
        measurement: Measurement,
        hypotheses: Hypotheses,
        floor: Array,
        model: ModelError,
        known: Known,
        together: bool = True,
    ):
        """``floor`` (6, 6): covariance of the error that no averaging removes.  ``together``: whether the fits with
        what is known are asked for; :attr:`anchored` has none otherwise.
        """
        self.hypotheses, self.model, self._floor = hypotheses, model, floor
        normal = self._normal = measurement.normal
        xi = measurement.consensus.xi
        self._fit_T = perturb(measurement.prediction.cam_T_grip, xi[:6])
        count, m = len(hypotheses.name), len(xi)
        held, pull = _vague(count, m).copy(), np.zeros((count, m))
        if m == 7:
            fitted_m = measurement.prediction.jaw_opening_m + float(xi[6])
            held[~hypotheses.opening, 6, 6] = max(measurement.jaw_known_sigma_m, 1e-6) ** -2
            pull[:, 6] = held[:, 6, 6] * (measurement.jaw_known_m - fitted_m)
        # A longer finger pulls at a fit by all its edges together.
        longer = normal.information[:, :, :3] @ (self._fit_T[:3, :3] @ (model.sigma_m * model.axis_grip))
        # An edge that lies beside its place pulls by itself, alike in every frame.
        part = np.stack([model.finger[normal.edge], model.fingers + normal.edge])
        of_model = np.stack([longer, normal.lasting]), part, model.parts
        of = normal.pull, normal.information, normal.middle, of_model, hypotheses.keep, held, pull
        self.known = known
        self._known = perturbation_between(self._fit_T, known.anchor_T), known.covariance + floor, known.of_model
        # The free fit's distance from what is known, in units of both covariances.
        self._free, fits, square = with_and_without(*of, *self._known, SIGMA_INFLATION**2, together)
        self.anchored = Anchored(fits, square)
        self.stays: NDArray[np.bool_] = square <= CONTRADICTION_SQUARE
        """(h,) under which hypotheses the pose may be where it is known to have been."""
        self.covariance: Array = self._free.covariance + self._floor
        """(h, 6, 6) of the fits by the frame alone, without the model's error."""
        self.of_model = self._free.of_model
        """(h, f, 6) their errors if a finger is longer by its standard deviation."""
        self.opened = Opened.of(measurement)

    @property
    def edges(self) -> NDArray[np.intp]:
        """(v,) edges that the fits are made of."""
        return self._normal.edge

    def shifts(self, base_T: Array) -> Array:
        """(h, 6) perturbations from a pose (4, 4) near by to the fits by the frame alone."""
        return perturbation_between(base_T, self._fit_T) + self._free.shift

    def cases(self, cam_T_grip: Array, prior: Array, anchored: Anchored | None = None) -> Cases:
        """What may be wrong with a published pose (4, 4) under hypotheses of probability ``prior`` (h,), by the frame
        alone or by the anchor too.
        """
        fits = self._free if anchored is None else anchored.fits
        return Cases(self.hypotheses.name, prior, self._beside(fits, cam_T_grip))

    def _beside(self, fits: Separation, cam_T_grip: Array) -> Separation:
        """Fits as differences from a pose (4, 4), with the error that no averaging removes."""
        away = fits.shift - perturbation_between(self._fit_T, cam_T_grip)
        return Separation(away, fits.covariance + self._floor, fits.of_model)

    def knocked(
        self,
        cam_T_grip: Array,
        prior: Array,
        knocks: Knocks,
        odds: tuple[float, float],
        least: float,
    ) -> tuple[Cases, float]:
        """What may be wrong with a published pose (4, 4) if the mount was knocked since the pose that is known.

        ``prior`` (h,): of the hypotheses; ``odds``: of a knock under those that leave an end of a finger, and under the
        others.  Those less probable than ``least``, given the fits, are left out; also returns their probability
        together.
        """
        endless, known = self.hypotheses.endless, self._known
        probable = np.where(endless, odds[1], odds[0])
        fit, weight, fits, left_out = knocked(
            self._free, *known, knocks, prior, probable, self.stays, endless, least, SIGMA_INFLATION**2
        )
        name = tuple(self.hypotheses.name[k] for k in fit.tolist())
        return Cases(name, weight, self._beside(fits, cam_T_grip)), left_out

    def wrong_at_first(self, lasting: tuple[str, ...], prior: Array, anchored: Anchored | None) -> Cases:
        """Of the motion since the reference's frames: one of the lasting hypotheses but the first, by name and of a
        ``prior`` (g,), held in those, and no longer does.  ``anchored``: None where the pose rests on the frame alone.
        """
        name = _in_the_references_frames(lasting)
        covariance, of_model = (self._free if anchored is None else anchored.fits)[1:]
        now = Separation(
            np.zeros((len(name), 6)),
            np.tile(covariance[0] + self._floor, (len(name), 1, 1)),
            np.tile(of_model[0], (len(name), 1, 1)),
        )
        return Cases(name, prior[1:], now)

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number])
        return pose, anchored.fits.covariance[number] + self._floor
