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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from gripmon.model.records import Array
from gripmon.track.integrity import frame_kernel, kernel
from gripmon.track.integrity.level_kernel import Limits

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


def limits_of(risk: float, inflation: float) -> Limits:
    """``inflation``: factor on standard deviations with which a normal distribution bounds the tails of real errors."""
    return risk, inflation, LEVEL_TOLERANCE_RATIO, *QUANTILES


class Separation(NamedTuple):
    """Fits under all hypotheses: ``shift`` (h, n) of the first n unknowns against those that the sums are of,
    ``covariance`` (h, n, n) of that, and ``of_model`` (h, f, n): how they are off where one of the gripper's f parts is
    off by its standard deviation.
    """

    shift: Array
    covariance: Array
    of_model: Array


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


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    whole, none, edge = np.ones((2, 2)), np.zeros(6), np.zeros(2, dtype=np.intp)
    some, yes, here = np.full(2, 0.1), np.ones(2, dtype=np.bool_), np.eye(4)
    for m in (6, 7):
        each, row = np.tile(np.eye(m), (2, 1, 1)), np.zeros((2, m))
        of = row, each, each, row, edge, edge, 1, none[:3], whole, yes, np.ones(m), 0.0, 1.0
        _, at, alone, _, _ = kernel.refitted(here, np.zeros(m), *of, here, np.eye(6), np.zeros((1, 6)), 1.0, True)
    kernel.follow(*alone, *alone, none)
    kernel.with_known(*alone, none, np.eye(6))
    begun, lever, moved, tcp, unmoved = frame_kernel.begun(here, here, here, *alone, np.eye(6))
    frame_kernel.motion_since(here, here, here)
    doubts, frame = (some, yes, yes), (here, alone, alone, alone[1], np.eye(6))
    bare, knocks, before = (alone, doubts), (none[:3], 0, 1.0, 0.1, 0.1), (at, np.eye(6), alone[2][0])
    lasting, limits = (alone, here, here, np.eye(6), none, edge, some), limits_of(1e-5, 1.0)
    first, mount = (begun, lever, np.zeros((0, 6, 3)), none, moved, tcp, unmoved), (np.eye(6), False, 0.0, 0.1)
    alike = np.zeros((0, 6)), np.zeros(2)
    what = here, False, frame, doubts, some, bare, before, knocks, lasting, some, 1e-9, 0.0
    frame_kernel.frame_bounds(what, alike, first, mount, limits)
    cases = *alone, some, edge, edge
    frame_kernel.absolute_level(cases, 2, *alike, limits)
    frame_kernel.level_of_motion(cases, (0, 2, 2), np.eye(6), first, mount, limits)
