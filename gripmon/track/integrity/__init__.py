"""What may be promised of a transform: bounds on its error under everything that may be wrong, at a stated risk."""

from gripmon.track.integrity.hypotheses import Hypotheses, hypotheses_of
from gripmon.track.integrity.knocks import Knocks
from gripmon.track.integrity.separation import (
    Doubts,
    Separation,
    Sums,
    bounds,
    follow,
    knocked,
    of_motion,
    telling,
    warm_up,
    with_and_without,
    with_known,
)

__all__ = [
    "Doubts",
    "Hypotheses",
    "Knocks",
    "Separation",
    "Sums",
    "bounds",
    "follow",
    "hypotheses_of",
    "knocked",
    "of_motion",
    "telling",
    "warm_up",
    "with_and_without",
    "with_known",
]
