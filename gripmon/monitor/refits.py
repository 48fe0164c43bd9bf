"""The fit of one frame repeated under each hypothesis, alone and with what is known of the pose from before."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array
from gripmon.monitor.bounds import SIGMA_INFLATION, ModelError, protection_of
from gripmon.monitor.since import Bounds, Opened
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, prior_information
from gripmon.track.integrity import Hypotheses
from gripmon.track.integrity.frame_kernel import Fits, Frame, absolute_level, level_of_motion
from gripmon.track.integrity.kernel import refitted
from gripmon.track.integrity.separation import limits_of


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

    fits: Fits
    square: Array


class Known(NamedTuple):
    """The anchor as a measurement: its pose (4, 4), the covariance (6, 6), and its error (f, 6) where a finger's length
    is off by its standard deviation, or (1, 6) of zeros.  ``wander`` (6,): the part of that covariance that is by the
    motion since.
    """

    anchor_T: Array
    covariance: Array
    of_model: Array
    wander: Array = np.zeros(6)


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
        fit_T, at, alone, anchored, square = refitted(
            prediction.cam_T_grip, xi, normal.pull, normal.information, normal.middle, normal.lasting, normal.edge,
            model.finger, model.fingers, model.sigma_m * model.axis_grip, hypotheses.keep, hypotheses.opening,
            _vague(m), *opening, known.anchor_T, *before, SIGMA_INFLATION**2, together,
        )  # fmt: skip
        self.edges: NDArray[np.intp] = normal.edge
        """(v,) edges that the fits are made of."""
        self.before: Fits = at, *before
        """The pose that is known, from the fits' (6,), its covariance (6, 6), and its errors by the model."""
        # The free fit's distance from what is known, in units of both covariances.
        self.anchored = Anchored(anchored, square)
        self.stays: NDArray[np.bool_] = square <= CONTRADICTION_SQUARE
        """(h,) under which hypotheses the pose may be where it is known to have been."""
        self.alone: Fits = alone
        """The fits by the frame alone, of their own errors."""
        self.covariance: Array = alone[1] + floor
        """(h, 6, 6) of these, without the model's error."""
        self.of_model: Array = alone[2]
        """(h, f, 6) their errors if a finger is longer by its standard deviation."""
        self.frame: Frame = fit_T, alone, anchored, self.covariance, floor
        """As :func:`~gripmon.track.integrity.frame_kernel.gathered` asks for."""

    def under(self, hypotheses: Hypotheses) -> Refits:
        """The fits by the frame alone under other hypotheses."""
        return Refits(self._measurement, hypotheses, self._floor, self.model, self.known, together=False)

    @property
    def opened(self) -> Opened:
        """The fit's jaw opening."""
        return Opened.of(self._measurement)

    def shifts(self, base_T: Array) -> Array:
        """(h, 6) perturbations from a pose (4, 4) near by to the fits by the frame alone."""
        return perturbation_between(base_T, self.frame[0]) + self.alone[0]

    def bounds(self, cam_T_grip: Array, rows: NDArray[np.intp], swing: Array, risk: float) -> Bounds:
        """The protection levels of a pose (4, 4), and of the motion since the reference, by the frame alone under the
        hypotheses ``rows`` (r,), whatever a mount does; ``swing`` (6,): variances of its vibration.
        """
        shift, model = self.alone[0] - perturbation_between(self.frame[0], cam_T_grip), self.model
        of_each = shift[rows], self.covariance[rows], self.of_model[rows], self.hypotheses.prior[rows]
        cases, count, limits = (*of_each, rows, np.zeros_like(rows)), len(rows), limits_of(risk, SIGMA_INFLATION)
        absolute = absolute_level(cases, count, *model.alike(cam_T_grip), limits)
        first, none = model.differences(cam_T_grip, self.opened, swing), np.zeros((6, 6))
        since = level_of_motion(cases, (0, count, count), none, first, (none, True, 0.0, 0.0), limits)
        return Bounds(*(protection_of(each, self.hypotheses.name, risk) for each in (absolute, since)))

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        shift, covariance, _ = anchored.fits
        return perturb(self.frame[0], shift[number]), covariance[number] + self._floor
