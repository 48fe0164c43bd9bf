"""The anchor: the average of the proven poses, kept once under each hypothesis that may have held all along.

An edge that has belonged to something else since the first frame biases the average, too, so that the average is also
kept without it: each hypothesis has a Kalman filter of its own (a bank of filters, as for solution separation over
time).  In front of a background that stands still all frames have the same error: what their scatter doesn't show stays
in the average's covariance, as in :mod:`gripmon.judge.smoothing`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.smoothing import LEAST_KEPT_RATIO, MOST_SCATTER
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Protection
from gripmon.monitor.bounds import SIGMA_INFLATION, protection_of
from gripmon.monitor.refits import Refits
from gripmon.monitor.since import FIRST_FRAMES
from gripmon.track.integrity import Hypotheses, Separation
from gripmon.track.integrity.frame_kernel import Fits, absolute_level
from gripmon.track.integrity.kernel import follow, with_known
from gripmon.track.integrity.separation import limits_of

PRIOR_FRAMES, SCATTER_FRAMES = 10.0, 40.0
"""Weight of the prior (errors don't scatter at all), and number over which the scatter is averaged, frames."""

YOUNG_VARIANCE_RATIO = 0.2
"""Least variance of the average over that of a frame: it has to follow a creep, and averaging more than five frames
would gain little, given the least variance that an average may claim.
"""

LEFT_WITH_BACKGROUND, ATTACHED_SHARE = 0.3, 1e-2
"""Share of the things that were taken for the fingers' ends that still are before another background; and of those that
always are, being attached to the gripper: a cable, a strip of tape.  Assumed, not measured.
"""

CONFIRMING_FRAMES = 5
"""Frames after a knock, besides the first, that need the full proof of the new place."""

NO_FIT, UNKNOWN_VARIANCE_RATIO = -1, 1e12
"""Number of a missing fit; and the factor on the covariance of the fit in its place that removes its information."""


class Lasting(NamedTuple):
    """Hypotheses that may have held since the first frame: g of them about all of a gripper's edges, with ``name`` and
    ``prior`` (g,), and ``doubts`` (g, e), whether each leaves out an edge, and ``opening`` (g,), the jaw's opening.
    """

    name: tuple[str, ...]
    prior: Array
    doubts: NDArray[np.bool_]
    opening: NDArray[np.bool_]

    def priors(self, misread: float) -> Array:
        """(g,) with the probability ``misread`` that no end is what it seems, as the clearest frame has it."""
        prior = self.prior.copy()
        prior[-1] = misread
        return prior

    @classmethod
    def of(cls, every: Hypotheses) -> Lasting:
        """Those of the hypotheses about all edges that aren't sudden, and last that no end is what it seems."""
        rows = np.append(np.flatnonzero(~every.sudden), every.ends)
        return cls(tuple(every.name[k] for k in rows), every.prior[rows], *(each[rows] for each in _doubted(every)))

    def rows(self, hypotheses: Hypotheses, edges: NDArray[np.intp]) -> NDArray[np.intp]:
        """(g,) which of the ``hypotheses`` about the seen ``edges`` (v,) each lasting one is; -1 where it leaves no
        seen edge.
        """
        doubts, opening = _doubted(hypotheses)
        # Of edges that no hypothesis doubts nothing can be told.
        known, may_open = doubts.any(axis=0), opening.any()
        number = {key: k for k, key in reversed([*enumerate(_keys(doubts, opening))])}
        wanted = _keys(self.doubts[:, edges] & known, self.opening & may_open)
        return np.array([number.get(key, NO_FIT) for key in wanted], dtype=np.intp)


def _doubted(hypotheses: Hypotheses) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of v edges each of h hypotheses leaves out (h, v), and whether the opening (h,)."""
    return hypotheses.keep == 0.0, hypotheses.opening


def _keys(doubts: NDArray[np.bool_], opening: NDArray[np.bool_]) -> list[bytes]:
    return [row.tobytes() for row in np.column_stack([doubts, opening])]


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
        self.clearest, self.proven = misread, proven
        self.backgrounds = 1
        """Before how many different ones a pose was proved here."""
        self._lasting, self._base_T, self._origin = lasting, base_T, origin
        self.now_s, self.frames = now_s, 1
        self._to_confirm = CONFIRMING_FRAMES if knocked else 0
        self._filters = _chosen(fits, rows, base_T)
        self._newest = deque([(self._filters.shift[0].copy(), self._filters.covariance[0].copy())], FIRST_FRAMES)
        self._frames_variance = np.einsum("hii->hi", self._filters.covariance).copy()
        self._scatter = np.zeros((len(rows), 6))
        self._weight = PRIOR_FRAMES
        self._conclude()

    @property
    def misread(self) -> float:
        """Probability that what looked like the fingers' ends was something else in every frame: as :attr:`clearest`
        has it; what isn't the gripper's mostly leaves with its background.
        """
        return self.clearest * max(LEFT_WITH_BACKGROUND ** (self.backgrounds - 1), ATTACHED_SHARE)

    @property
    def confirmed(self) -> bool:
        """Whether enough frames have proven the place since a knock; later ones need a weaker proof."""
        return self._to_confirm <= 0

    def add(self, fits: Refits, rows: NDArray[np.intp], creep: Array, now_s: float, misread: float) -> None:
        """Add a proven pose, given by its frame's fits, ``rows`` (g,) of them; ``creep`` (6,): variances of the motion
        since the last one; ``misread`` as at first.
        """
        self.now_s = now_s
        self.clearest = min(self.clearest, misread)
        self.frames += 1
        self._to_confirm -= 1
        frame = _chosen(fits, rows, self._base_T)
        self._newest.append((frame.shift[0], frame.covariance[0]))
        innovation, variance = frame.shift - self._filters.shift, np.einsum("hii->hi", frame.covariance)
        *averages, gains = follow(*self._filters, *frame, creep)
        self._filters = Separation(*averages)
        origin_T, known = self._origin
        self._origin = origin_T, known + np.diag(creep)
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
        self._claimed = _claimed(self._filters.covariance, young, self._scatter)
        whole = Separation(self._filters.shift[:1], self._claimed[:1], self._filters.of_model[:1])
        (shift,), (covariance,), (of_model,) = self._with_origin(whole, self._base_T)
        self.cam_T_grip = perturb(self._base_T, shift)
        self.covariance: Array = covariance
        self.of_model: Array = of_model

    def fits(self) -> Separation:
        """The averages under the lasting hypotheses, as shifts from :attr:`cam_T_grip`, of where the gripper was at any
        of the newest frames: a mount that crept stood elsewhere than on average.
        """
        shift = self._filters.shift - perturbation_between(self._base_T, self.cam_T_grip)
        return Separation(shift, self._claimed + self._crept, self._filters.of_model)

    @property
    def _crept(self) -> Array:
        """(6, 6) squared ways from the average to the newest frames' places, on average, of the position and of the
        rotation, but for what is explained by their errors, and by what more they scatter from one to the next: half of
        the squared way between these (von Neumann 1941), which no creep adds to.  The surer frames weigh more.
        """
        places, errors = (np.array(each) for each in zip(*self._newest, strict=True))
        way, out = places - perturbation_between(self._base_T, self.cam_T_grip), np.zeros((6, 6))
        step = np.diff(places, axis=0, prepend=places[:1])
        for part in (slice(0, 3), slice(3, 6)):
            error = errors[:, part, part]
            weight = 1.0 / np.einsum("nii->n", error)
            apart, known, steps = (
                np.einsum("n,nij->ij", weight / weight.sum(), each)
                for each in (_squares(way[:, part]), error, 0.5 * _squares(step[:, part]))
            )
            out[part, part] = _positive(apart - known - _positive(steps - known))
        return out

    def bound(self, risk: float) -> Protection:
        """The protection level of the average itself."""
        fits, every = self._with_origin(self.fits(), self.cam_T_grip), np.arange(len(self._lasting.name))
        cases = *fits, self._lasting.priors(self.misread), every, every
        limits = limits_of(risk, SIGMA_INFLATION)
        bound = absolute_level(cases, len(every), np.zeros((0, 6)), np.zeros(2), limits)
        return protection_of(bound, self._lasting.name, risk)

    def _with_origin(self, fits: Separation, at_T: Array) -> Separation:
        """Fits as shifts from ``at_T`` (4, 4), joined with what was known of the pose before."""
        origin_T, covariance = self._origin
        return Separation(*with_known(*fits, perturbation_between(at_T, origin_T), covariance))

    @property
    def known(self) -> tuple[Fits, Array, Array, Array]:
        """The averages under the lasting hypotheses, the pose (4, 4) that they count from, and where the gripper was
        before, (4, 4), with the covariance (6, 6) of that.
        """
        average = self._filters.shift, self._claimed, self._filters.of_model
        return average, self._base_T, *self._origin


def average_of(base_T: Array, frames: Sequence[tuple[Refits, NDArray[np.intp]]], play: Array) -> Separation:
    """The averages (g) of frames' fits, ``rows`` (g,) of each, as shifts from a pose (4, 4): of frames whose mount
    stood at places that scatter by standard deviations ``play`` (6,), of which the average is off by what they are few.
    As in the anchor, errors that don't scatter don't average out; unlike there, the newest frames don't weigh more.
    """
    each, places = [_chosen(fits, rows, base_T) for fits, rows in frames], np.diag(np.square(play))
    unknown = np.stack([rows == NO_FIT for _, rows in frames])
    unknown &= ~unknown.all(axis=0)  # where no frame has a fit, they are as unknown together
    count = np.count_nonzero(~unknown, axis=0)[:, None]
    own = np.stack([fits.covariance for fits in each])
    information = np.linalg.inv(own + places)
    information[unknown] = 0.0
    weight = np.linalg.inv(information.sum(axis=0)) @ information
    shift = np.stack([fits.shift for fits in each])
    mean = np.einsum("nhij,nhj->hi", weight, shift)
    covariance = np.einsum("nhij,nhjk,nhlk->hil", weight, own, weight)
    of_model = np.einsum("nhij,nhfj->hfi", weight, np.stack([fits.of_model for fits in each]))
    variance = np.einsum("nhii->nhi", own)
    both = variance + np.square(play)
    # Of errors that are smaller than the play, a scatter by that says nothing.
    scatter = (variance / both * np.minimum(np.square(shift - mean) / both, MOST_SCATTER)).sum(axis=0)
    # Of a frame as the average has them: the surer ones weigh more.
    usual = count / np.where(unknown[:, :, None], 0.0, 1.0 / variance).sum(axis=0)
    young = np.clip(np.einsum("hii->hi", covariance) / usual, 1.0 / count, 1.0)
    claimed = _claimed(covariance, young, scatter / (count - 1 + PRIOR_FRAMES)) + places / count[:, :, None]
    return Separation(mean, 0.5 * (claimed + claimed.transpose(0, 2, 1)), of_model)


def _squares(ways: Array) -> Array:
    return ways[:, :, None] * ways[:, None, :]


def _positive(matrix: Array) -> Array:
    """A symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _claimed(covariance: Array, young: Array, scatter: Array) -> Array:
    """What averages with the covariances (g, 6, 6), of variances ``young`` (g, 6) over those of one frame, may claim:
    averaging reduces persistent errors, all but the ``scatter`` (g, 6) of a frame's variance, less than independent
    ones.
    """
    kept = np.maximum(1.0 - (1.0 - np.sqrt(young)) * scatter, LEAST_KEPT_RATIO * scatter)
    scale = np.sqrt(kept / young)
    return np.asarray(covariance * (scale[:, :, None] * scale[:, None, :]))


def _chosen(fits: Refits, rows: NDArray[np.intp], base_T: Array) -> Separation:
    """The fits ``rows`` (g,), as shifts from a pose (4, 4)."""
    covariance, unknown = fits.covariance[rows], rows == NO_FIT
    if unknown.any():
        covariance[unknown] *= UNKNOWN_VARIANCE_RATIO
    return Separation(fits.shifts(base_T)[rows], covariance, fits.of_model[rows])
