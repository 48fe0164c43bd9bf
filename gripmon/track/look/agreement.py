"""What the gripper's look says of poses: which patches agree with it, and what that is worth as evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

AGREEING_CORRELATION = 0.6
"""Correlation from which a patch agrees: two that have nothing to do with each other reach it once in a hundred times
(13 free numbers).
"""

HIDDEN_PROBABILITY = 0.5
"""Probability that a patch of a finger is hidden, or looks otherwise than learnt, where the finger is: held objects
often hide half of a finger.
"""

MISS_BOUNDS = (0.02, 0.5)
"""Bounds on the probability that a patch doesn't agree where it is and can be seen."""

CHANCE_BOUNDS = (0.02, 0.3)
"""Bounds on the probability that a patch agrees where the finger isn't: below, some hundred slid views are too few to
tell; above, a patch isn't used.
"""


MINORITY_SHARE = 0.5
"""Of the patches that agree at another pose, below which those here are chance: noise, blur and a tenth of a millimetre
take a few of thirty, a slide of a millimetre left 0 to 8 of them.
"""


def patch_evidence(hit: Array, chance: Array) -> tuple[Array, Array]:
    """Log odds (n,), nats, that the gripper is at a pose rather than elsewhere: of a patch that agrees there, and of
    one that doesn't.

    ``hit`` (n,): share of frames in which the patch agreed where it was; ``chance`` (n,): share in which it did where
    it wasn't.
    """
    here = (1.0 - HIDDEN_PROBABILITY) * np.clip(hit, 1.0 - MISS_BOUNDS[1], 1.0 - MISS_BOUNDS[0])
    elsewhere = np.clip(chance, *CHANCE_BOUNDS)
    here = here + HIDDEN_PROBABILITY * elsewhere
    return np.log(here / elsewhere), np.log((1.0 - here) / (1.0 - elsewhere))


@dataclass(frozen=True, slots=True)
class LookAgreement:
    """What the look says of k poses, on f fingers.

    ``correlation`` (k, f): median over the finger's patches, NaN where it has none; ``agree`` (k, f): how many agree,
    of those that lie in the image, ``seen`` (k, f).  ``log_odds`` (k, f): evidence that the finger is there rather than
    where it would look otherwise, natural logarithm of odds; 0 where nothing can be told.
    """

    correlation: Array
    agree: NDArray[np.intp]
    seen: NDArray[np.intp]
    log_odds: Array

    def supports(self, risk: float, pose: int = 0) -> bool:
        """Whether the gripper's look is seen at a pose, rather than nowhere or at another one of the poses, by chance
        with no more than a probability of ``risk``.
        """
        odds = self.log_odds.sum(axis=1)
        return bool(odds[pose] - np.delete(odds, pose).max(initial=0.0) > -math.log(risk))

    def contradicts(self, risk: float, pose: int = 0) -> bool:
        """Whether the look is seen at another one of the poses, and so much less at this one that it can't be here.

        On all fingers together, or on one of them: the odds against it are 1 to ``risk``, and fewer than half as many
        patches agree here.  False where the look is seen nowhere: something hides it, or the light is another; then it
        says nothing.
        """
        # A pose turned about one finger is right there and wrong at the other.
        odds = np.column_stack([self.log_odds, self.log_odds.sum(axis=1)])
        agree = np.column_stack([self.agree, self.agree.sum(axis=1)])
        enough = -math.log(risk)
        best, column = odds.argmax(axis=0), np.arange(odds.shape[1])
        unlikely = (odds[best, column] > enough) & (odds[best, column] - odds[pose] > enough)
        return bool((unlikely & (agree[pose] < MINORITY_SHARE * agree[best, column])).any())
