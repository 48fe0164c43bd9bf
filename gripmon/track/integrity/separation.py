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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from gripmon.model.records import Array
from gripmon.track.integrity import frame_kernel, kernel, level_kernel
from gripmon.track.integrity.knocks import Knocks, least_known

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


class Refitted(NamedTuple):
    """One frame's fits under all hypotheses: the pose ``fit_T`` (4, 4) that they are shifts from, where the pose that
    is known from before is ``at`` (6,), the fits ``alone`` and ``anchored``, with that pose as one more measurement,
    and the normalised squares (h,) of the former's distances from it.
    """

    fit_T: Array
    at: Array
    alone: Separation
    anchored: Separation
    square: Array


def refitted(
    prediction: tuple[Array, Array],
    normal: tuple[Array, Array, Array, Array, NDArray[np.intp]],
    model: tuple[NDArray[np.intp], int, Array],
    doubted: tuple[Array, NDArray[np.bool_], Array],
    opening: tuple[float, float],
    known: tuple[Array, Array, Array],
    times: float,
    together: bool = True,
) -> Refitted:
    """The fits of a frame by what :func:`kernel.refitted` is told, in this order, with the pose that is ``known`` but
    for a covariance (6, 6), and off by the model (f, 6), or (1, 6) of zeros.  The squares are by ``times`` the fits'
    own covariances and that one.  Not ``together``: without the anchored ones, of which there are none then.
    """
    of = *prediction, *normal, *model, *doubted, *opening, *known, times, together
    fit_T, at, alone, anchored, squares = kernel.refitted(*of)
    return Refitted(fit_T, at, Separation(*alone), Separation(*anchored), squares)


def follow(averages: Separation, frame: Separation, creep: Array) -> tuple[Separation, Array]:
    """A bank of g Kalman filters, the same average once under each hypothesis, after one more measurement, the pose
    having crept by the variances ``creep`` (6,) since the one before; and the traces (g,) of the gains.
    """
    *after, gains = kernel.follow(*averages, *frame, creep)
    return Separation(*after), gains


def with_known(fits: Separation, at: Array, covariance: Array) -> Separation:
    """The fits, each joined with what is known of all of them besides: ``at`` (6,) but for a ``covariance`` (6, 6)."""
    return Separation(*kernel.with_known(*fits, at, covariance))


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


class Cases(NamedTuple):
    """Things that may be wrong with a published pose, r of them: the ``name`` that each is ``called`` (r,) by, its
    ``prior`` (r,), and the ``fits`` under them as shifts from that pose.  ``alike`` (p, 6): errors by the model that
    all have, by their standard deviations; ``farther`` (2,): what is added to their distances, m and rad.
    """

    prior: Array
    name: tuple[str, ...]
    called: NDArray[np.intp]
    fits: Separation
    alike: Array = np.zeros((0, 6))
    farther: Array = np.zeros(2)

    @classmethod
    def of(cls, name: tuple[str, ...], prior: Array, fits: Separation) -> Cases:
        """Each by its own name."""
        return cls(prior, name, np.arange(len(prior)), fits)

    def fill(self, table: Array, first: int, share: float, inflation: float) -> None:
        """Into a table, see :func:`level_kernel.doubted`."""
        level_kernel.doubted(*self.fits, self.prior, self.alike, self.farther, inflation, share, table, first)


class Moved(NamedTuple):
    """The same about the motion since the reference: fits have ``begun`` there under g hypotheses, of which each of the
    ``cases``, with their ``prior`` (r,), goes with its own, ``which`` (r,).  ``lever`` (6, 6), ``by_motion`` (k, 6, 3),
    ``travel`` (6,), ``origin`` (3,), ``tcp`` (3,) and ``stays_at`` (6,) as for :func:`level_kernel.moved`; ``staying``
    (6, 6): how far a mount moves that stays; (0, 6) where the fits contain that.  ``usual`` (6, 6), ``knock`` (6, 6)
    and ``odds``: of the true motion that errors ``by_motion`` are by, as for :func:`level_kernel.moved`.
    """

    prior: Array
    cases: Cases
    which: NDArray[np.intp]
    begun: Separation
    lever: Array
    by_motion: Array
    travel: Array
    origin: Array
    tcp: Array
    stays_at: Array
    staying: Array
    usual: Array = np.zeros((0, 6))
    knock: Array = np.zeros((6, 6))
    odds: float = 0.0

    def fill(self, table: Array, first: int, share: float, inflation: float) -> None:
        """Into a table, see :func:`level_kernel.moved`."""
        of = *self.cases.fits, self.cases.prior, self.which, *self.begun
        since = self.lever, self.by_motion, self.travel, self.origin, self.tcp, self.stays_at, self.staying
        level_kernel.moved(*of, *since, self.usual, self.knock, self.odds, inflation, share, table, first)


@dataclass(frozen=True, slots=True)
class Doubts:
    """What may be wrong with a published pose: sets of it.

    ``inflation``: factor on standard deviations with which a normal distribution bounds the tails of real errors.
    """

    sets: tuple[Cases | Moved, ...]
    inflation: float

    def levels(self, risk: float) -> tuple[float, float, str]:
        """Protection levels of position and of rotation, and the name of what the position's owes most to.

        What is together less probable than the risk isn't bounded by a length: it takes its part of the risk.
        """
        count = 0
        for each in self.sets:
            count += len(each.prior)
        if not count:
            return 0.0, 0.0, ""
        table, first = np.empty((7, count)), 0
        for each in self.sets:
            each.fill(table, first, risk / count, self.inflation)
            first += len(each.prior)
        position, rotation, number = level_kernel.levels(
            table[0], table[1:3], table[3:5], table[5:7], risk, LEVEL_TOLERANCE_RATIO, *QUANTILES
        )
        if number < 0:
            return position, rotation, ""
        for each in self.sets:
            if number < len(each.prior):
                break
            number -= len(each.prior)
        cases = each.cases if isinstance(each, Moved) else each
        return position, rotation, cases.name[cases.called[number]]


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    whole, none, edge = np.ones((2, 2)), np.zeros(6), np.zeros(2, dtype=np.intp)
    some, yes, here = np.full(2, 0.1), np.ones(2, dtype=np.bool_), np.eye(4)
    for m in (6, 7):
        each, row = np.tile(np.eye(m), (2, 1, 1)), np.zeros((2, m))
        normal, known = (row, each, each, row, edge), (here, np.eye(6), np.zeros((1, 6)))
        made = (here, np.zeros(m)), normal, (edge, 1, np.zeros(3)), (whole, yes, np.ones(m)), (0.0, 1.0), known
        _, at, fits, _, _ = refitted(*made, 1.0)
    follow(fits, fits, none)
    Knocks.of(least_known(np.eye(6), np.ones(3), 0.0))
    told = with_known(fits, none, np.eye(6))
    motion = frame_kernel.begun(here, here, here, *fits, np.eye(6))[0]
    frame_kernel.motion_since(here, here, here)
    cases = Cases.of(("", ""), np.ones(2), told)
    of = np.eye(6), np.zeros((0, 6, 3)), none, none[:3], none[:3], none, np.eye(6)
    since = Moved(cases.prior, cases, edge, Separation(*motion), *of)
    Doubts((cases, since), 1.0).levels(1e-5)
    doubts, alike, limits = (some, yes, yes), np.zeros((0, 6)), (1e-5, 1.0, LEVEL_TOLERANCE_RATIO, *QUANTILES)
    frame = here, tuple(fits), tuple(fits), fits.covariance, np.eye(6)
    bare, knocks, before = (tuple(fits), doubts), (none[:3], 0, 1.0, 0.1, 0.1), (at, np.eye(6), fits.of_model[0])
    lasting, since_first = (tuple(fits), here, here, np.eye(6), none, edge, some), (motion, *of[:-1])
    every = frame_kernel.gathered(
        here, False, frame, doubts, some, bare, before, knocks, lasting, some, 1e-5, 1e-9, 1.0
    )  # fmt: skip
    frame_kernel.absolute_level(every[0], 2, alike, np.zeros(2), limits)
    frame_kernel.level_of_motion(*every[:3], since_first, (np.eye(6), False, 0.0, 0.1), limits)
