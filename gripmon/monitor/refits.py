"""The fit of one frame repeated under each hypothesis, alone and with what is known of the pose from before."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array
from gripmon.monitor.bounds import SIGMA_INFLATION, ModelError
from gripmon.monitor.since import Opened
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, prior_information
from gripmon.track.integrity import Cases, Hypotheses, Separation, refitted
from gripmon.track.integrity.frame_kernel import Doubted, Fits, Frame


@cache
def _vague(m: int) -> Array:
    """(m,) information that keeps m unknowns solvable whatever is seen."""
    return prior_information(JAW_UNREPORTED_SIGMA_M if m == 7 else None)


@cache
def in_the_references_frames(names: tuple[str, ...]) -> tuple[str, ...]:
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
        self.hypotheses, self.model, self.known, self._floor = hypotheses, model, known, floor
        self._measurement, normal = measurement, measurement.normal
        prediction, xi = measurement.prediction, measurement.consensus.xi
        m, opening = len(xi), (0.0, 0.0)
        if m == 7:
            fitted_m = prediction.jaw_opening_m + float(xi[6])
            opening = measurement.jaw_known_m - fitted_m, measurement.jaw_known_sigma_m
        before = known.covariance + floor, known.of_model
        made = refitted(
            (prediction.cam_T_grip, xi),
            (normal.pull, normal.information, normal.middle, normal.lasting, normal.edge),
            (model.finger, model.fingers, model.sigma_m * model.axis_grip),
            (hypotheses.keep, hypotheses.opening, _vague(m)),
            opening,
            (known.anchor_T, *before),
            SIGMA_INFLATION**2,
            together,
        )
        self._fit_T, self._free = made.fit_T, made.alone
        self.before: Fits = made.at, *before
        """The pose that is known, from the fits' (6,), its covariance (6, 6), and its errors by the model."""
        # The free fit's distance from what is known, in units of both covariances.
        self.anchored = Anchored(made.anchored, made.square)
        self.stays: NDArray[np.bool_] = made.square <= CONTRADICTION_SQUARE
        """(h,) under which hypotheses the pose may be where it is known to have been."""
        self.covariance: Array = made.alone.covariance + floor
        """(h, 6, 6) of the fits by the frame alone, without the model's error."""
        self.of_model = made.alone.of_model
        """(h, f, 6) their errors if a finger is longer by its standard deviation."""

    def under(self, hypotheses: Hypotheses) -> Refits:
        """The fits by the frame alone under other hypotheses."""
        return Refits(self._measurement, hypotheses, self._floor, self.model, self.known, together=False)

    @property
    def edges(self) -> NDArray[np.intp]:
        """(v,) edges that the fits are made of."""
        return self._measurement.normal.edge

    @property
    def opened(self) -> Opened:
        """The fit's jaw opening."""
        return Opened.of(self._measurement)

    def shifts(self, base_T: Array) -> Array:
        """(h, 6) perturbations from a pose (4, 4) near by to the fits by the frame alone."""
        return perturbation_between(base_T, self._fit_T) + self._free.shift

    def away(self, cam_T_grip: Array) -> Array:
        """(6,) where a published pose (4, 4) is from the one that the fits count from."""
        return perturbation_between(self._fit_T, cam_T_grip)

    def cases(self, away: Array, prior: Array, chosen: NDArray[np.bool_]) -> Cases:
        """What may be wrong with a published pose, :meth:`away`, under the ``chosen`` hypotheses (h,) of probability
        ``prior`` (h,), by the frame alone.
        """
        rows, shift = chosen.nonzero()[0], self._free.shift - away
        fits = Separation(shift[rows], self.covariance[rows], self.of_model[rows])
        return Cases(prior[rows], self.hypotheses.name, rows, fits)

    @property
    def alone(self) -> Fits:
        """The fits by the frame alone, of their own errors."""
        return tuple(self._free)

    @property
    def frame(self) -> Frame:
        """As :func:`~gripmon.track.integrity.frame_kernel.gathered` asks for."""
        return self._fit_T, self.alone, tuple(self.anchored.fits), self.covariance, self._floor

    def doubted(self, prior: Array) -> Doubted:
        """Likewise, of a ``prior`` (h,)."""
        return prior, self.stays, self.hypotheses.endless

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number])
        return pose, anchored.fits.covariance[number] + self._floor
