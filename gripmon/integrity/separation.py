"""Solution separation: how far off a fit may be if one of several things were wrong, at a stated integrity risk.

For each hypothesis k the fit is made once more without what k doubts.  If k is true that fit is the right one, so that
the error of the published one is at most the distance between the two and what the other's own covariance allows
(multiple-hypothesis solution separation: Pervan, Pullen and Christie 1998; Blanch and others, "Baseline advanced RAIM
user algorithm", 2015):

    PL = max over k of |x_0 - x_k| + K(r_k / p_k) sigma_k
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.integrity.quantiles import bounds
from gripmon.records import Array


@dataclass(frozen=True, slots=True)
class Separation:
    """Fits under all hypotheses: ``shift`` (h, m) of the unknowns against those that the sums are of, ``covariance``
    (h, m, m).
    """

    shift: Array
    covariance: Array


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
    return Separation(shift, inverse @ spread @ inverse)


def levels(shift: Array, covariance: Array, risk: Array, inflation: float) -> tuple[Array, Array]:
    """(h,) bounds of position and of rotation: ``shift`` (h, 6) from the published pose to each fit and ``covariance``
    (h, 6, 6) of that, ``risk`` (h,) that may be taken if the hypothesis is true.

    ``inflation``: factor on standard deviations with which a normal distribution bounds the tails of real errors.
    """
    parts = shift.reshape(-1, 2, 3)
    away = np.sqrt(np.einsum("hpi,hpi->hp", parts, parts))
    blocks = np.stack([covariance[:, :3, :3], covariance[:, 3:, 3:]], axis=1)
    radius = bounds(blocks.reshape(-1, 3, 3), np.repeat(risk, 2)).reshape(-1, 2)
    both = away + inflation * radius
    return both[:, 0], both[:, 1]
