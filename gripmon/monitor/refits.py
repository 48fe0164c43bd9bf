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
from gripmon.track.integrity import (
    Doubts,
    Hypotheses,
    Knocks,
    Separation,
    after_jumps,
    follow,
    jumped,
    telling,
    with_and_without,
)

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

    @property
    def parts(self) -> int:
        """Number of the gripper's parts that may be off: its fingers, and its edges each by itself."""
        return self.fingers + len(self.finger)

    def doubts(
        self,
        name: tuple[str, ...],
        prior: Array,
        fits: Separation,
        cam_T_grip: Array,
        opened: Opened,
    ) -> TwoDoubts:
        """The doubts about a pose (4, 4) under the hypotheses of these fits, with what is common to all of them."""
        common = self.common
        if common is None:
            absolute = Doubts.of(name, prior, fits, SIGMA_INFLATION)
        else:
            absolute = common.reaching(Doubts.of(name, prior, common.on(fits, cam_T_grip), SIGMA_INFLATION))
        none = np.zeros(len(prior), dtype=np.intp)
        return TwoDoubts(absolute, self.since(name, prior, fits, cam_T_grip, opened, none))

    def since(
        self,
        name: tuple[str, ...],
        prior: Array,
        fits: Separation,
        cam_T_grip: Array,
        opened: Opened,
        lasting: NDArray[np.intp],
        staying: Array | None = None,
    ) -> Doubts:
        """The doubts about the motion since the reference.  ``lasting`` (h,): which of the lasting hypotheses each is,
        that held in the reference's frames, too; 0 for none.  ``staying`` (6, 6): covariance of the motion that a mount
        makes, where the fits don't contain that.
        """
        first, reference_T = self.first
        if first is None:
            # This frame is the first one: as uncertain again.
            motion = fits._replace(covariance=2.0 * fits.covariance, of_model=np.zeros_like(fits.of_model))
        else:
            motion = first.of_motion(fits, cam_T_grip, reference_T, lasting, opened, self.common)
            if staying is not None:
                motion = first.staying(motion, cam_T_grip, reference_T, staying)
        return Doubts.of(name, prior, motion, SIGMA_INFLATION)


def bounds_of(doubts: TwoDoubts, risk: float, left_out: float = 0.0) -> Bounds:
    """The protection levels of both at an integrity ``risk``, of which ``left_out`` is as for :func:`protection_of`."""
    return Bounds(protection_of(doubts.absolute, risk, left_out), protection_of(doubts.since, risk, left_out))


def protection_of(doubts: Doubts, risk: float, left_out: float = 0.0) -> Protection:
    """The protection levels at an integrity ``risk``, of which what isn't among the doubts takes the part ``left_out``;
    where that is more than half of it, there is no bound.
    """
    if left_out > 0.5 * risk:
        return Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, "too much may be wrong at once")
    position_m, rotation_rad, name = doubts.levels(risk - left_out)
    return Protection(min(position_m, UNBOUNDED_M), min(rotation_rad, UNBOUNDED_RAD), risk, name)


class Refits:
    """One measurement's fits under h hypotheses, alone and with what is ``known`` of the pose from before."""

    def __init__(self, measurement: Measurement, hypotheses: Hypotheses, floor: Array, model: ModelError, known: Known):
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
        # An edge that lies beside its place pulls by itself, alike in every frame.
        part = np.stack([model.finger[normal.edge], model.fingers + normal.edge])
        of_model = np.stack([longer, normal.lasting]), part, model.parts
        of = normal.pull, normal.information, normal.middle, of_model, hypotheses.keep, held, pull
        self.known = known
        self._known = perturbation_between(self._fit_T, known.anchor_T), known.covariance + floor, known.of_model
        # The free fit's distance from what is known, in units of both covariances.
        self._free, fits, square = with_and_without(*of, *self._known, SIGMA_INFLATION**2)
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
    ) -> TwoDoubts:
        """What may be wrong with a published pose (4, 4) under hypotheses of probability ``prior`` (h,), by the frame
        alone or by the anchor too.
        """
        fits = self._free if anchored is None else anchored.fits
        away = fits.shift - perturbation_between(self._fit_T, cam_T_grip)
        fits = Separation(away, fits.covariance + self._floor, fits.of_model)
        return self.model.doubts(self.hypotheses.name, prior, fits, cam_T_grip, self.opened)

    def with_first(
        self,
        doubts: TwoDoubts,
        lasting: Lasting,
        prior: Array,
        cam_T_grip: Array,
        anchored: Anchored | None,
        staying: Array,
    ) -> TwoDoubts:
        """The doubts with those about the motion since the reference that a lasting hypothesis held in the reference's
        frames, each of the ``prior`` (g,), and no longer does.  ``anchored``: None where the pose (4, 4) rests on the
        frame alone; ``staying`` as for :meth:`ModelError.since`.
        """
        first, reference_T = self.model.first
        if first is None:
            return doubts
        fits = self._free if anchored is None else anchored.fits
        now = Separation(fits.shift[:1], fits.covariance[:1] + self._floor, fits.of_model[:1])
        wrong = first.staying(first.wrong_at_first(now, cam_T_grip, reference_T), cam_T_grip, reference_T, staying)
        name = _in_the_references_frames(lasting.name)
        return replace(doubts, since=doubts.since + Doubts.of(name, prior[1:], wrong, SIGMA_INFLATION))

    def knocked(
        self,
        cam_T_grip: Array,
        prior: Array,
        knocks: Knocks,
        probable: Array,
        stays: NDArray[np.bool_],
        endless: NDArray[np.bool_],
        least: float,
    ) -> tuple[TwoDoubts, float]:
        """What may be wrong with a published pose (4, 4) if the mount was knocked since the pose that is known.

        ``prior`` (h,): of the hypotheses; ``probable`` (h,): of a knock under each; ``stays`` (h,): whether the fit
        under it is where the pose was; ``endless`` (h,): whether it leaves no end of a finger.  Those less probable
        than ``least``, given the fits, are left out; also returns their probability together.
        """
        at, covariance, of_model = self._known
        share = probable[:, None] * knocks.share
        given = jumped(self._free, at, covariance, of_model, knocks.covariance, share, stays, SIGMA_INFLATION**2)
        # Without an end nothing shows a knock along the fingers; that it is exactly along them isn't held against it.
        given = np.where(endless[:, None] & knocks.along, np.maximum(given, share), given)
        weight = prior[:, None] * given
        counts = weight > least
        fit, jump = np.nonzero(counts)
        fits = after_jumps(self._free, at, covariance, of_model, knocks.covariance, fit, jump)
        away = fits.shift - perturbation_between(self._fit_T, cam_T_grip)
        name = tuple(self.hypotheses.name[k] for k in fit.tolist())
        fits = Separation(away, fits.covariance + self._floor, fits.of_model)
        return self.model.doubts(name, weight[counts], fits, cam_T_grip, self.opened), float(weight[~counts].sum())

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

    def priors(self, misread: float) -> Array:
        """(g,) with the probability ``misread`` that no end is what it seems, as the clearest frame has it."""
        return np.append(self.prior[:-1], misread)

    @classmethod
    def of(cls, every: Hypotheses) -> Lasting:
        """Those of the hypotheses about all edges that aren't sudden, and last that no end is what it seems."""
        rows = np.append(np.flatnonzero(~every.sudden), every.ends)
        doubted = _doubted(every, np.arange(every.keep.shape[1]))
        return cls(tuple(every.name[k] for k in rows), every.prior[rows], tuple(doubted[k] for k in rows))

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
    """The average of the proven poses, from the first one on; before one is ``proven``, of what edges show without the
    fingers' ends.  ``origin``: what was known of the pose before, (4, 4) and its covariance (6, 6): it stays the prior
    of what the frames don't show.
    """

    def __init__(
        self,
        lasting: Lasting,
        base_T: Array,
        fits: Refits,
        rows: NDArray[np.intp],
        now_s: float,
        origin: tuple[Array, Array],
        misread: float,
        proven: bool = True,
        knocked: bool = False,
    ):
        """``knocked``: the first pose differs from the one expected before; ``misread``: probability that what looked
        like the fingers' ends there was something else.
        """
        self.misread, self.proven = misread, proven
        self._lasting, self._base_T, self._origin = lasting, base_T, origin
        self.began_s, self.now_s, self.frames, self.knocked = now_s, now_s, 1, knocked
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

    def add(self, fits: Refits, rows: NDArray[np.intp], creep: Array, now_s: float, misread: float) -> None:
        """Add a proven pose, given by its frame's fits, ``rows`` (g,) of them; ``creep`` (6,): variances of the motion
        since the last one; ``misread`` as at first.
        """
        self.now_s = now_s
        self.misread = min(self.misread, misread)
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
        whole = Separation(self._filters.shift[:1], self._claimed[:1], self._filters.of_model[:1])
        (shift,), (covariance,), (of_model,) = _with_origin(whole, self._base_T, self._origin, np.zeros(6))
        self.cam_T_grip = perturb(self._base_T, shift)
        self.covariance: Array = covariance
        self.of_model: Array = of_model

    def fits(self) -> Separation:
        """The averages under the lasting hypotheses, as shifts from :attr:`cam_T_grip`."""
        shift = self._filters.shift - perturbation_between(self._base_T, self.cam_T_grip)
        return Separation(shift, self._claimed, self._filters.of_model)

    def bound(self, risk: float) -> Protection:
        """The protection level of the average itself."""
        fits = _with_origin(self.fits(), self.cam_T_grip, self._origin, np.zeros(6))
        prior = self._lasting.priors(self.misread)
        return protection_of(Doubts.of(self._lasting.name, prior, fits, SIGMA_INFLATION), risk)

    def doubts(
        self,
        cam_T_grip: Array,
        fits: Refits,
        rows: NDArray[np.intp],
        wander: Array,
        staying: Array,
    ) -> TwoDoubts:
        """The lasting hypotheses about a pose (4, 4) from a frame's ``fits``, ``rows`` (g,) of them; ``wander`` (6,):
        variance of the motion since the anchor.

        Under each hypothesis the average or the frame counts, whichever is more certain; the frame where they differ.
        What neither shows is known as it was at the origin.
        """
        at = perturbation_between(self._base_T, cam_T_grip)
        frame = Separation(fits.shifts(cam_T_grip), fits.covariance, fits.of_model)
        average = Separation(self._filters.shift, self._claimed, self._filters.of_model)
        told = telling(average, at, wander / SIGMA_INFLATION**2, frame, rows, CONTRADICTION_SQUARE)
        absolute = _with_origin(told, cam_T_grip, self._origin, wander / SIGMA_INFLATION**2)
        prior = self._lasting.priors(self.misread)
        doubts = fits.model.doubts(self._lasting.name, prior, absolute, cam_T_grip, fits.opened)
        since = fits.model.since(
            self._lasting.name, prior, told, cam_T_grip, fits.opened, np.arange(len(prior)), staying
        )
        return replace(doubts, since=since)


def _with_origin(fits: Separation, at_T: Array, origin: tuple[Array, Array], wander: Array) -> Separation:
    """Fits as shifts from ``at_T`` (4, 4), joined with what was known of the pose before, a motion of variances
    ``wander`` (6,) ago.
    """
    (origin_T, covariance), count = origin, len(fits.shift)
    before = Separation(
        np.tile(perturbation_between(at_T, origin_T), (count, 1)),
        np.tile(covariance + np.diag(wander), (count, 1, 1)),
        np.zeros_like(fits.of_model),
    )
    return follow(fits, before, np.zeros(6))[0]


def _chosen(fits: Refits, rows: NDArray[np.intp], base_T: Array) -> Separation:
    """The fits ``rows`` (g,), as shifts from a pose (4, 4)."""
    covariance, unknown = fits.covariance[rows], rows == NO_FIT
    if unknown.any():
        covariance[unknown] *= UNKNOWN_VARIANCE_RATIO
    return Separation(fits.shifts(base_T)[rows], covariance, fits.of_model[rows])
