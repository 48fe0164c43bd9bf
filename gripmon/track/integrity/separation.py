"""Solution separation: how far off a fit may be if one of several things were wrong, at a stated integrity risk.

For each hypothesis k, of probability p_k, the fit is made once more without what k doubts.  If k is true that fit is
the right one, so that the error of the published one is at most the distance between the two and what the other's own
covariance allows.  The protection level PL is the length that all hypotheses together exceed with the stated risk r
(multiple-hypothesis solution separation: Pervan, Pullen and Christie 1998; Blanch and others, "Baseline advanced RAIM
user algorithm", 2015):

    sum over k of p_k P(|x_0 - x_k| + |e_k| > PL) = r,   e_k normal with the covariance of x_k

The arithmetic stands in :mod:`~gripmon.track.integrity.kernel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from gripmon.model.records import Array
from gripmon.track.integrity import kernel
from gripmon.track.integrity.knocks import Knocks

LEVEL_TOLERANCE_RATIO = 1.02
"""Factor within which a protection level is found; the larger end counts."""


class Quantiles(NamedTuple):
    """Tables of the normal distribution: ``squares`` (2, r) that errors along one axis, and along three equal ones,
    exceed with probabilities whose decadic logarithms are a ``spacing`` apart; ``guide`` (2, n): where a square's place
    among them is found from on, for each ``step`` of it.
    """

    squares: Array
    spacing: float
    guide: NDArray[np.intp]
    step: float

    @classmethod
    def of(cls, spacing: float, step: float) -> Quantiles:
        """Tables from the probability 1 to 1e-14."""
        log_risk = -spacing * np.arange(round(14.0 / spacing) + 1.0)
        squares = chdtri(np.array([[1.0], [3.0]]), 10.0**log_risk)
        at = np.arange(0.0, squares.max(), step)
        guide = [np.searchsorted(row, at, side="right").clip(1, len(row) - 1) - 1 for row in squares]
        return cls(squares, spacing, np.stack(guide), step)

    @property
    def log_risk(self) -> Array:
        """(r,) decadic logarithms of the probabilities, from zero down."""
        return -self.spacing * np.arange(float(self.squares.shape[1]))


QUANTILES = Quantiles.of(spacing=0.05, step=0.25)
"""Between its places the length that a risk allows is interpolated to 0.1 %."""


class Separation(NamedTuple):
    """Fits under all hypotheses: ``shift`` (h, n) of the first n unknowns against those that the sums are of,
    ``covariance`` (h, n, n) of that, and ``of_model`` (h, f, n): how they are off where one of the gripper's f parts is
    off by its standard deviation.
    """

    shift: Array
    covariance: Array
    of_model: Array


class Sums(NamedTuple):
    """Normal equations under all hypotheses: ``pull`` (h, m), ``normal`` matrices and covariances of the pulls, their
    ``spread`` (h, m, m), and ``of_model`` (h, f, m), the pulls of the gripper's f parts.
    """

    pull: Array
    normal: Array
    spread: Array
    of_model: Array

    @classmethod
    def of_kept(
        cls,
        pull: Array,
        information: Array,
        middle: Array,
        model: tuple[Array, NDArray[np.intp], int],
        keep: Array,
        known: Array,
        known_pull: Array,
    ) -> Sums:
        """Of the kept edges among v.

        ``pull`` (v, m), ``information`` and ``middle`` (v, m, m) as the fit has them at its solution; ``model``: how
        each edge pulls (p, v, m) where its parts of the gripper are off, which parts (p, v) these are, and how many
        there are;
        ``keep`` (h, v) of 0 and 1; ``known`` (h, m, m) information from elsewhere and ``known_pull`` (h, m) its pull.
        """
        pull, information, middle = map(np.ascontiguousarray, (pull, information, middle))
        return cls(*kernel.add_up(pull, information, middle, *model, keep, known, known_pull))

    def fits(self, unknowns: int = 6) -> Separation:
        """The fits' first ``unknowns``.  Where nothing determines a direction, ``known`` must: LinAlgError else."""
        return Separation(*kernel.separate(*self, unknowns))


def with_and_without(
    pull: Array,
    information: Array,
    middle: Array,
    model: tuple[Array, NDArray[np.intp], int],
    keep: Array,
    known: Array,
    known_pull: Array,
    at: Array,
    covariance: Array,
    of_model: Array,
    times: float,
    together: bool = True,
) -> tuple[Separation, Separation, Array]:
    """The fits of six unknowns by what :meth:`Sums.of_kept` is made of, and the same with these known to be ``at`` (6,)
    but for a ``covariance`` (6, 6), and off by ``of_model`` (f, 6), or (1, 6) of zeros.  And the normalised squares
    (h,) of the former's distances from there, by ``times`` their own covariances and that one.  Not ``together``:
    without the second ones, of which there are none then.
    """
    pull, information, middle = map(np.ascontiguousarray, (pull, information, middle))
    of = pull, information, middle, *model, keep, known, known_pull, at, covariance, of_model, times
    alone, with_pose, squares = kernel.with_and_without(*of, together)
    return Separation(*alone), Separation(*with_pose), squares


def follow(averages: Separation, frame: Separation, creep: Array) -> tuple[Separation, Array]:
    """A bank of g Kalman filters, the same average once under each hypothesis, after one more measurement, the pose
    having crept by the variances ``creep`` (6,) since the one before; and the traces (g,) of the gains.
    """
    *after, gains = kernel.follow(*averages, *frame, creep)
    return Separation(*after), gains


def with_known(fits: Separation, at: Array, covariance: Array) -> Separation:
    """The fits, each joined with what is known of all of them besides: ``at`` (6,) but for a ``covariance`` (6, 6)."""
    return Separation(*kernel.with_known(*fits, at, covariance))


def of_motion(
    fits: Separation, first: Separation, which: NDArray[np.intp], lever: Array, turn: Array, more: Array
) -> Separation:
    """Fits x made those of the motion since the ones of ``first`` b that are their ``which`` (h,): L (x - T b) with the
    Jacobians ``lever`` L and ``turn`` T (6, 6), and covariances L (C_x + T C_b T' + M) L', M = ``more`` (6, 6).
    """
    return Separation(*kernel.of_motion(*fits, which, *first, lever, turn, more))


def telling(
    averages: Separation, at: Array, wander: Array, frame: Separation, rows: NDArray[np.intp], limit: float
) -> Separation:
    """Under each hypothesis what knows more by the position's variances, the average, from ``at`` (6,) and after a way
    with the variances ``wander`` (6,), or the frame's fit ``rows`` (g,); but the frame's where they differ by more than
    a normalised square of ``limit``.  A negative row is no fit.
    """
    return Separation(*kernel.telling(*averages, at, wander, *frame, rows, limit))


def knocked(
    frame: Separation,
    at: Array,
    known: Array,
    of_model: Array,
    knocks: Knocks,
    prior: Array,
    probable: Array,
    stays: NDArray[np.bool_],
    endless: NDArray[np.bool_],
    least: float,
    times: float,
) -> tuple[NDArray[np.intp], Array, Separation, float]:
    """Under which hypotheses (r,) the pose, known to have been ``at`` (6,) but for a covariance ``known`` (6, 6) and
    ``of_model`` (f or 1, 6), was knocked, with which probability (r,), and where it is then, given the frame's fits.
    And the probability of what is less probable than ``least``, together, which is left out.

    ``prior`` (h,): of the hypotheses; ``probable`` (h,): of a knock under each; ``stays`` (h,): whether it may as well
    have stayed; ``endless`` (h,): whether no end of a finger is left, which alone show a knock along the fingers: that
    it is exactly along them isn't held against it then.  ``times``: factor on the fits' covariances for their tails.
    """
    known_before, of = (at, known, of_model), (knocks.covariance, knocks.share, knocks.along)
    fit, weight, left_out, *fits = kernel.knocked(
        *frame, *known_before, *of, prior, probable, stays, endless, least, times
    )
    return fit, weight, Separation(*fits), left_out


class Tails(NamedTuple):
    """How probably normal vectors are longer than something: ``sigma`` (...,) along the longest axis of each, and the
    power of ten ``factor`` (...,) by which the two others raise the tail of that one.

    With variances ``v`` along the axes, the largest ``v_1``, the square of the length exceeds ``v_1 t`` for large ``t``
    with the probability of one axis alone times ``prod (1 - v_j / v_1)^(-1/2)`` (Zolotarev 1961), and never with more
    than that of three axes as long as the longest: the smaller of both is taken.  Exact for one axis and for three
    equal ones; else too small by up to a factor of 1.3 (1 % of the length), or too large.  A probability below 1e-14
    counts as that.
    """

    sigma: Array
    factor: Array

    @classmethod
    def of(cls, covariance: Array) -> Tails:
        """Of the covariances (..., 3, 3)."""
        variance = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
        largest = np.maximum(variance[..., 2], 1e-300)
        left = np.maximum(1.0 - variance[..., :2] / largest[..., None], 1e-12)
        return cls(np.sqrt(largest), -0.5 * np.log10(left).sum(axis=-1))

    def radius(self, risk: Array) -> Array:
        """Lengths that are exceeded with the probabilities ``risk``."""
        log_risk = np.log10(np.maximum(risk, 1e-300))
        # The tables run from the certain to the improbable.
        one = np.interp(self.factor - log_risk, -QUANTILES.log_risk, QUANTILES.squares[0])
        three = np.interp(-log_risk, -QUANTILES.log_risk, QUANTILES.squares[1])
        return np.asarray(self.sigma * np.sqrt(np.minimum(one, three)))


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,)."""
    return Tails.of(covariance).radius(risk)


@dataclass(frozen=True, slots=True)
class Doubts:
    """What may be wrong with a published pose, h things of the probabilities ``prior`` (h,) with the ``name`` (h,): how
    far ``away`` (2, h) the other fit is, in position and in rotation, and the ``tails`` (2, h) of that one's error.
    """

    name: tuple[str, ...]
    prior: Array
    away: Array
    tails: Tails

    @classmethod
    def of(cls, name: tuple[str, ...], prior: Array, fits: Separation, inflation: float) -> Doubts:
        """``fits`` with shifts (h, 6) from the published pose to the others.

        ``inflation``: factor on standard deviations with which a normal distribution bounds the tails of real errors.
        """
        away, sigma, factor = kernel.tails(*fits, inflation)
        return cls(name, prior, away, Tails(sigma, factor))

    def among(self, chosen: NDArray[np.bool_]) -> Doubts:
        """Those that are ``chosen`` (h,)."""
        if chosen.all():
            return self
        away, *tails = (each.compress(chosen, axis=1) for each in (self.away, *self.tails))
        return Doubts(tuple(compress(self.name, chosen.tolist())), self.prior[chosen], away, Tails(*tails))

    def __add__(self, other: Doubts) -> Doubts:
        return Doubts(
            self.name + other.name,
            np.concatenate([self.prior, other.prior]),
            np.concatenate([self.away, other.away], axis=1),
            Tails(
                np.concatenate([self.tails.sigma, other.tails.sigma], axis=1),
                np.concatenate([self.tails.factor, other.tails.factor], axis=1),
            ),
        )

    def levels(self, risk: float) -> tuple[float, float, str]:
        """Protection levels of position and of rotation, and the name of what the position's owes most to.

        What is together less probable than the risk isn't bounded by a length: it takes its part of the risk.
        """
        squares, spacing, guide, step = QUANTILES
        position, rotation, number = kernel.levels(
            self.prior, self.away, *self.tails, risk, LEVEL_TOLERANCE_RATIO, squares, spacing, guide, step
        )
        return position, rotation, self.name[number] if number >= 0 else ""


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    whole, none = np.ones((2, 2)), np.zeros(6)
    for m in (6, 7):
        each = np.tile(np.eye(m), (2, 1, 1))
        model = np.zeros((2, 2, m)), np.zeros((2, 2), dtype=np.intp), 1
        of = np.zeros((2, m)), each, each, model, whole, each, np.zeros((2, m))
        fits = Sums.of_kept(*of).fits()
        with_and_without(*of, none, np.eye(6), fits.of_model[0], 1.0)
    averages, _ = follow(fits, fits, none)
    with_known(of_motion(fits, fits, np.arange(2), np.eye(6), np.eye(6), np.eye(6)), none, np.eye(6))
    some, yes = np.full(2, 0.1), np.ones(2, dtype=np.bool_)
    knocked(fits, none, np.eye(6), fits.of_model[0], Knocks.of(none[:3]), some, some, yes, yes, 1e-9, 1.0)
    told = telling(averages, none, none, fits, np.arange(2), 1.0)
    Doubts.of(("", ""), np.ones(2), told, 1.0).levels(1e-5)
