"""The fit of one frame repeated under each hypothesis, and the anchor: the average of the proven poses.

An edge that has belonged to something else since the first frame biases the average, too, so that the average is also
kept without it: each hypothesis has a Kalman filter of its own (a bank of filters, as for solution separation over
time).  In front of a background that stands still all frames have the same error: what their scatter doesn't show stays
in the average's covariance, as in :mod:`gripmon.judge.smoothing`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.smoothing import LEAST_KEPT_RATIO, MOST_SCATTER
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Protection
from gripmon.monitor.since import AtReference, Bounds, CommonError, Opened
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, prior_information
from gripmon.track.integrity import Doubts, Hypotheses, Separation, Sums, follow, telling, with_and_without

SIGMA_INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Published where there is no bound."""

PRIOR_FRAMES, SCATTER_FRAMES = 10.0, 40.0
"""Weight of the prior (errors don't scatter at all), and number over which the scatter is averaged, frames."""

YOUNG_VARIANCE_RATIO = 0.2
"""Least variance of the average over that of a frame: it has to follow a creep, and averaging more than five frames
would gain little, given the least variance that an average may claim.
"""

CONFIRMING_FRAMES = 5
"""Frames after a knock, besides the first, that need the full proof of the new place."""

NO_FIT, UNKNOWN_VARIANCE_RATIO = -1, 1e12
"""Number of a missing fit; and the factor on the covariance of the fit in its place that removes its information."""


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


@dataclass(frozen=True, slots=True)
class TwoDoubts:
    """What may be wrong with a measured pose, and with the motion since the reference that it shows."""

    absolute: Doubts
    since: Doubts

    def among(self, chosen: NDArray[np.bool_]) -> TwoDoubts:
        """Those that are ``chosen`` (h,)."""
        return TwoDoubts(self.absolute.among(chosen), self.since.among(chosen))

    def __add__(self, other: TwoDoubts) -> TwoDoubts:
        return TwoDoubts(self.absolute + other.absolute, self.since + other.since)


class ModelError(NamedTuple):
    """The gripper file's error: each finger longer or shorter by a standard deviation ``sigma_m``, along ``axis_grip``
    (3,); ``finger`` (e,): which of the ``fingers`` each edge belongs to; ``common``: None where there is no such error.
    ``first``: what was measured at the reference, None until a frame proves a pose, and the reference (4, 4).
    """

    sigma_m: float
    axis_grip: Array
    finger: NDArray[np.intp]
    fingers: int
    common: CommonError | None
    first: tuple[AtReference | None, Array] = (None, np.eye(4))

    def doubts(
        self,
        name: tuple[str, ...],
        prior: Array,
        fits: Separation,
        cam_T_grip: Array,
        opened: Opened,
        lasting: NDArray[np.intp] | None = None,
    ) -> TwoDoubts:
        """The doubts about a pose (4, 4) under the hypotheses of these fits, with what is common to all of them.

        ``lasting`` (h,): which of the lasting hypotheses each is, that held in the reference's frames, too; 0 for none.
        """
        common, (first, reference_T) = self.common, self.first
        if common is None:
            absolute = Doubts.of(name, prior, fits, SIGMA_INFLATION)
        else:
            absolute = common.reaching(Doubts.of(name, prior, common.on(fits, cam_T_grip), SIGMA_INFLATION))
        if first is None:
            # This frame is the first one: as uncertain again.
            since = fits._replace(covariance=2.0 * fits.covariance, of_model=np.zeros_like(fits.of_model))
        else:
            held = np.zeros(len(prior), dtype=np.intp) if lasting is None else lasting
            since = first.of_motion(fits, cam_T_grip, reference_T, held, opened, common)
        return TwoDoubts(absolute, Doubts.of(name, prior, since, SIGMA_INFLATION))


def bounds_of(doubts: TwoDoubts, risk: float) -> Bounds:
    """The protection levels of both at an integrity ``risk``."""
    return Bounds(protection_of(doubts.absolute, risk), protection_of(doubts.since, risk))


def protection_of(doubts: Doubts, risk: float) -> Protection:
    """The protection levels at an integrity ``risk``."""
    position_m, rotation_rad, name = doubts.levels(risk)
    return Protection(min(position_m, UNBOUNDED_M), min(rotation_rad, UNBOUNDED_RAD), risk, name)


class Refits:
    """One measurement's fits under h hypotheses, alone and with the anchor as a ``known`` measurement."""

    def __init__(
        self,
        measurement: Measurement,
        hypotheses: Hypotheses,
        floor: Array,
        model: ModelError,
        known: Known | None = None,
    ):
        """``floor`` (6, 6): covariance of the error that no averaging removes."""
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
        of_model = longer, model.finger[normal.edge], model.fingers
        of = normal.pull, normal.information, normal.middle, of_model, hypotheses.keep, held, pull
        self.anchored: Anchored | None = None
        """The same with the anchor; None without one."""
        if known is None:
            self._free = Sums.of_kept(*of).fits()
        else:
            at, covariance = perturbation_between(self._fit_T, known.anchor_T), known.covariance + floor
            # The free fit's distance from the anchor, in units of both covariances.
            self._free, fits, square = with_and_without(*of, at, covariance, known.of_model, SIGMA_INFLATION**2)
            self.anchored = Anchored(fits, square)
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

    def doubts(
        self,
        cam_T_grip: Array,
        prior: Array,
        anchored: Anchored | None = None,
        lasting: NDArray[np.intp] | None = None,
    ) -> TwoDoubts:
        """What may be wrong with a published pose (4, 4) under hypotheses of probability ``prior`` (h,), by the frame
        alone or by the anchor too; ``lasting`` (h,) as for :meth:`ModelError.doubts`.
        """
        fits = self._free if anchored is None else anchored.fits
        away = fits.shift - perturbation_between(self._fit_T, cam_T_grip)
        fits = Separation(away, fits.covariance + self._floor, fits.of_model)
        return self.model.doubts(self.hypotheses.name, prior, fits, cam_T_grip, self.opened, lasting)

    def with_first(
        self, doubts: TwoDoubts, lasting: Lasting, cam_T_grip: Array, anchored: Anchored | None
    ) -> TwoDoubts:
        """The doubts with those about the motion since the reference that a lasting hypothesis held in the reference's
        frames, and no longer does.  ``anchored``: None where the pose (4, 4) rests on the frame alone.
        """
        first, reference_T = self.model.first
        if first is None:
            return doubts
        fits = self._free if anchored is None else anchored.fits
        now = Separation(fits.shift[:1], fits.covariance[:1] + self._floor, fits.of_model[:1])
        wrong = first.wrong_at_first(now, cam_T_grip, reference_T)
        name = _in_the_references_frames(lasting.name)
        return replace(doubts, since=doubts.since + Doubts.of(name, lasting.prior[1:], wrong, SIGMA_INFLATION))

    def solution(self, anchored: Anchored, number: int) -> tuple[Array, Array]:
        """Pose (4, 4) and covariance (6, 6) under one hypothesis."""
        pose = perturb(self._fit_T, anchored.fits.shift[number])
        return pose, anchored.fits.covariance[number] + self._floor


def reaching(bound: Protection, away: Array, hypothesis: str) -> Protection:
    """A pose's bound, increased to include another pose, ``away`` (6,) from it."""
    return Protection(
        bound.position_m + float(np.linalg.norm(away[:3])),
        bound.rotation_rad + float(np.linalg.norm(away[3:])),
        bound.risk,
        hypothesis,
    )


def larger(one: Protection, other: Protection) -> Protection:
    """The larger of two bounds, for position and for rotation; the hypothesis is that of the larger position."""
    first, second = (one, other) if one.position_m >= other.position_m else (other, one)
    return Protection(first.position_m, max(first.rotation_rad, second.rotation_rad), first.risk, first.hypothesis)


class Lasting(NamedTuple):
    """Hypotheses that may have held since the first frame: g of them about all of a gripper's edges, with ``name`` and
    ``prior`` (g,), and ``doubted``, the edges that each leaves out; a doubted opening counts as one more edge.
    """

    name: tuple[str, ...]
    prior: Array
    doubted: tuple[frozenset[int], ...]

    @classmethod
    def of(cls, every: Hypotheses) -> Lasting:
        """Those of the hypotheses about all edges that aren't sudden."""
        rows = np.flatnonzero(~every.sudden)
        doubted = _doubted(every, np.arange(every.keep.shape[1]))
        return cls(tuple(every.name[k] for k in rows), every.prior[rows], tuple(doubted[k] for k in rows))

    def numbers(self, rows: NDArray[np.intp], count: int) -> NDArray[np.intp]:
        """(count,) which lasting hypothesis each one about the seen edges is, from their :meth:`rows`; 0 for others."""
        out = np.zeros(count, dtype=np.intp)
        out[rows[rows != NO_FIT]] = np.flatnonzero(rows != NO_FIT)
        out[0] = 0  # those that leave no seen edge are this one, too
        return out

    def rows(self, hypotheses: Hypotheses, edges: NDArray[np.intp]) -> NDArray[np.intp]:
        """(g,) which of the ``hypotheses`` about the seen ``edges`` (v,) each lasting one is; -1 where it leaves no
        seen edge.
        """
        number = {doubted: k for k, doubted in reversed([*enumerate(_doubted(hypotheses, edges))])}
        known = frozenset[int]().union(*number)
        return np.array([number.get(doubted & known, NO_FIT) for doubted in self.doubted], dtype=np.intp)


def _doubted(hypotheses: Hypotheses, edges: NDArray[np.intp]) -> list[frozenset[int]]:
    own = [frozenset(edges[keep == 0.0].tolist()) for keep in hypotheses.keep]
    for number in np.flatnonzero(hypotheses.opening).tolist():
        own[number] = frozenset([-1])
    return own


class Anchor:
    """The average of the proven poses, from the first one on."""

    def __init__(
        self, lasting: Lasting, base_T: Array, fits: Refits, rows: NDArray[np.intp], now_s: float, knocked: bool = False
    ):
        """``knocked``: the first pose differs from the one expected before."""
        self._lasting, self._base_T, self.now_s, self.frames = lasting, base_T, now_s, 1
        self._to_confirm = CONFIRMING_FRAMES if knocked else 0
        self._filters = _chosen(fits, rows, base_T)
        self._frames_variance = np.einsum("hii->hi", self._filters.covariance).copy()
        self._scatter = np.zeros((len(rows), 6))
        self._weight = PRIOR_FRAMES
        self._conclude()

    @property
    def confirmed(self) -> bool:
        """Whether enough frames have proven the place since a knock; later ones need a weaker proof."""
        return self._to_confirm <= 0

    def add(self, fits: Refits, rows: NDArray[np.intp], creep: Array, now_s: float) -> None:
        """Add a proven pose, given by its frame's fits, ``rows`` (g,) of them; ``creep`` (6,): variances of the motion
        since the last one.
        """
        self.now_s = now_s
        self.frames += 1
        self._to_confirm -= 1
        frame = _chosen(fits, rows, self._base_T)
        innovation, variance = frame.shift - self._filters.shift, np.einsum("hii->hi", frame.covariance)
        self._filters, gains = follow(self._filters, frame, creep)
        share = np.minimum(innovation**2 / (variance + np.einsum("hii->hi", self._filters.covariance)), MOST_SCATTER)
        self._weight = min(self._weight + 1.0, SCATTER_FRAMES)
        self._scatter += (share - self._scatter) / self._weight
        # A frame that leaves a direction open isn't typical of the frames' variance.
        worth = np.minimum((self._frames_variance / variance).min(axis=1), 1.0)
        usual = worth**2 * gains / 6.0
        self._frames_variance += usual[:, None] * (variance - self._frames_variance)
        self._conclude()

    def _conclude(self) -> None:
        young = np.einsum("hii->hi", self._filters.covariance) / self._frames_variance
        # The filters' own covariances, which this changes.
        scale = np.sqrt(np.maximum(YOUNG_VARIANCE_RATIO / young, 1.0))
        self._filters.covariance[:] *= scale[:, :, None] * scale[:, None, :]
        young = np.clip(young, YOUNG_VARIANCE_RATIO, 1.0)
        # Averaging reduces persistent errors less than independent ones.
        kept = np.maximum(1.0 - (1.0 - np.sqrt(young)) * self._scatter, LEAST_KEPT_RATIO * self._scatter)
        scale = np.sqrt(kept / young)
        self._claimed = self._filters.covariance * (scale[:, :, None] * scale[:, None, :])
        self.cam_T_grip = perturb(self._base_T, self._filters.shift[0])
        self.covariance: Array = self._claimed[0]
        self.of_model: Array = self._filters.of_model[0]

    def fits(self) -> Separation:
        """The averages under the lasting hypotheses, as shifts from :attr:`cam_T_grip`."""
        shift = self._filters.shift - perturbation_between(self._base_T, self.cam_T_grip)
        return Separation(shift, self._claimed, self._filters.of_model)

    def bound(self, risk: float) -> Protection:
        """The protection level of the average itself."""
        return protection_of(Doubts.of(self._lasting.name, self._lasting.prior, self.fits(), SIGMA_INFLATION), risk)

    def doubts(self, cam_T_grip: Array, fits: Refits, rows: NDArray[np.intp], wander: Array) -> TwoDoubts:
        """The lasting hypotheses about a pose (4, 4) from a frame's ``fits``, ``rows`` (g,) of them; ``wander`` (6,):
        variance of the motion since the anchor.

        Under each hypothesis the average or the frame counts, whichever is more certain; the frame where they differ.
        """
        at = perturbation_between(self._base_T, cam_T_grip)
        frame = Separation(fits.shifts(cam_T_grip), fits.covariance, fits.of_model)
        average = Separation(self._filters.shift, self._claimed, self._filters.of_model)
        told = telling(average, at, wander / SIGMA_INFLATION**2, frame, rows, CONTRADICTION_SQUARE)
        every = np.arange(len(self._lasting.name))
        return fits.model.doubts(self._lasting.name, self._lasting.prior, told, cam_T_grip, fits.opened, every)


def _chosen(fits: Refits, rows: NDArray[np.intp], base_T: Array) -> Separation:
    """The fits ``rows`` (g,), as shifts from a pose (4, 4)."""
    covariance, unknown = fits.covariance[rows], rows == NO_FIT
    if unknown.any():
        covariance[unknown] *= UNKNOWN_VARIANCE_RATIO
    return Separation(fits.shifts(base_T)[rows], covariance, fits.of_model[rows])
