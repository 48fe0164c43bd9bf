"""Solution separation: how far off a fit may be if one of several things were wrong, at a stated integrity risk.

For each hypothesis k, of probability p_k, the fit is made once more without what k doubts.  If k is true that fit is
the right one, so that the error of the published one is at most the distance between the two and what the other's own
covariance allows.  The protection level PL is the length that all hypotheses together exceed with the stated risk r
(multiple-hypothesis solution separation: Pervan, Pullen and Christie 1998; Blanch and others, "Baseline advanced RAIM
user algorithm", 2015):

    sum over k of p_k P(|x_0 - x_k| + |e_k| > PL) = r,   e_k normal with the covariance of x_k
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.track.integrity.quantiles import Tails

NEAR = 1.02
"""Factor within which a protection level is found; the larger end counts."""


@dataclass(frozen=True, slots=True)
class Separation:
    """Fits under all hypotheses: ``shift`` (h, m) of the unknowns against those that the sums are of, ``covariance``
    (h, m, m) of that, ``inverse`` (h, m, m) of the normal matrices.
    """

    shift: Array
    covariance: Array
    inverse: Array


def separate(
    pull: Array, information: Array, middle: Array, keep: Array, known: Array, known_pull: Array
) -> Separation:
    """Fits from the normal equations of the kept edges.

    ``pull`` (v, m), ``information`` and ``middle`` (v, m, m) as the fit has them at its solution; ``keep`` (h, v) of 0
    and 1; ``known`` (h, m, m) information from elsewhere and ``known_pull`` (h, m) its pull at the solution.  Where
    nothing determines a direction, ``known`` must: LinAlgError otherwise.
    """
    m = pull.shape[1]
    inverse = np.linalg.inv((keep @ information.reshape(len(information), -1)).reshape(-1, m, m) + known)
    shift = np.einsum("hij,hj->hi", inverse, keep @ pull + known_pull)
    spread = (keep @ middle.reshape(len(middle), -1)).reshape(-1, m, m) + known
    return Separation(shift, inverse @ spread @ inverse, inverse)


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
    def of(cls, name: tuple[str, ...], prior: Array, shift: Array, covariance: Array, inflation: float) -> Doubts:
        """``shift`` (h, 6) from the published pose to the other fits, ``covariance`` (h, 6, 6) of those.

        ``inflation``: factor on standard deviations with which a normal distribution bounds the tails of real errors.
        """
        parts = shift.reshape(-1, 2, 3)
        blocks = np.stack([covariance[:, :3, :3], covariance[:, 3:, 3:]])
        away = np.sqrt(np.einsum("hpi,hpi->ph", parts, parts))
        return cls(name, prior, away, Tails.of(inflation**2 * blocks))

    def among(self, chosen: NDArray[np.bool_]) -> Doubts:
        """Those that are ``chosen`` (h,)."""
        names = tuple(name for name, one in zip(self.name, chosen.tolist(), strict=True) if one)
        tails = Tails(self.tails.sigma[:, chosen], self.tails.factor[:, chosen])
        return Doubts(names, self.prior[chosen], self.away[:, chosen], tails)

    def __add__(self, other: Doubts) -> Doubts:
        tails = Tails(*(np.concatenate(both, axis=1) for both in zip(self.tails, other.tails, strict=True)))
        return Doubts(
            self.name + other.name,
            np.concatenate([self.prior, other.prior]),
            np.concatenate([self.away, other.away], axis=1),
            tails,
        )

    def levels(self, risk: float) -> tuple[float, float, str]:
        """Protection levels of position and of rotation, and the name of what the position's owes most to.

        What is together less probable than the risk isn't bounded by a length: it takes its part of the risk.
        """
        share = risk / max(len(self.prior), 1)
        counted = self.prior > share
        if not counted.any():
            return 0.0, 0.0, ""
        left = risk - float(self.prior[~counted].sum())
        some = self.among(counted)
        away, tails, prior = some.away, some.tails, some.prior
        # Each needs as much as if it had the whole risk alone; an equal share is enough for all.
        least = (away + tails.radius(np.broadcast_to(left / prior, away.shape))).max(axis=1)
        most = (away + tails.radius(np.broadcast_to(left / len(prior) / prior, away.shape))).max(axis=1)
        least = np.maximum(least, 1e-3 * most)
        while (most > NEAR * least).any():
            middle = np.sqrt(least * most)
            enough = (prior * tails.beyond(middle[:, None] - away)).sum(axis=1) <= left
            least, most = np.where(enough, least, middle), np.where(enough, middle, most)
        owed = prior * tails.beyond(most[:, None] - away)[0]
        return float(most[0]), float(most[1]), some.name[int(np.argmax(owed))]
