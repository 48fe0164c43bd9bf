"""How far off a pose may be, and the motion since the reference, from its fits under all that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array, Protection
from gripmon.monitor.common import CommonError
from gripmon.monitor.since import AtReference, Bounds, Differences, Opened
from gripmon.track.integrity import Doubts, Separation

SIGMA_INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Published where there is no bound."""


class Cases(NamedTuple):
    """Things that may be wrong with a published pose, r of them: ``name``, ``prior`` (r,), and the ``fits`` under each,
    as differences from that pose.
    """

    name: tuple[str, ...]
    prior: Array
    fits: Separation

    def among(self, chosen: NDArray[np.bool_]) -> Cases:
        """Those that are ``chosen`` (r,)."""
        if chosen.all():
            return self
        name = tuple(compress(self.name, chosen.tolist()))
        return Cases(name, self.prior[chosen], Separation(*(each[chosen] for each in self.fits)))

    @classmethod
    def together(cls, cases: list[Cases]) -> Cases:
        """All of them; at least one set."""
        if len(cases) == 1:
            return cases[0]
        name, prior, fits = zip(*cases, strict=True)
        joined = Separation(*(np.concatenate(each) for each in zip(*fits, strict=True)))
        return cls(tuple(chain.from_iterable(name)), np.concatenate(prior), joined)


@dataclass(frozen=True, slots=True)
class TwoDoubts:
    """What may be wrong with a measured pose, and with the motion since the reference that it shows."""

    absolute: Doubts
    since: Doubts

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

    def differences(self, cam_T_grip: Array, opened: Opened) -> Differences | None:
        """What makes fits near a pose (4, 4) fits of the motion since the reference; None while nothing was measured
        there.
        """
        first, reference_T = self.first
        return None if first is None else first.differences(cam_T_grip, reference_T, opened, self.common)

    def absolute(self, cases: Cases, cam_T_grip: Array) -> Doubts:
        """The doubts about a pose (4, 4), with what is common to all of them."""
        common, (name, prior, fits) = self.common, cases
        if common is None:
            return Doubts.of(name, prior, fits, SIGMA_INFLATION)
        return common.reaching(Doubts.of(name, prior, common.on(fits, cam_T_grip), SIGMA_INFLATION))


def doubts_since(
    cases: Cases,
    differences: Differences | None,
    lasting: NDArray[np.intp] | None = None,
    staying: Array | None = None,
) -> Doubts:
    """The doubts about the motion since the reference; without ``differences`` this frame is the first one.

    ``lasting`` (r,): which of the lasting hypotheses each is, that held in the reference's frames, too; None: nothing
    was wrong then.  ``staying`` (6, 6): covariance of the motion that a mount makes, where the fits don't contain that.
    """
    name, prior, fits = cases
    if differences is None:  # as uncertain again
        motion = fits._replace(covariance=2.0 * fits.covariance, of_model=np.zeros_like(fits.of_model))
        return Doubts.of(name, prior, motion, SIGMA_INFLATION)
    motion = differences.of(fits, np.zeros(len(prior), dtype=np.intp) if lasting is None else lasting)
    if staying is not None:
        motion = differences.staying(motion, staying)
    return Doubts.of(name, prior, motion, SIGMA_INFLATION)


def unbounded(risk: float, why: str) -> Bounds:
    """Both bounds where there are none, and why."""
    none = Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, why)
    return Bounds(none, none)


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
