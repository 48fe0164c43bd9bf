"""What may be promised of a transform: bounds on its error under everything that may be wrong, at a stated risk."""

from gripmon.track.integrity.hypotheses import Hypotheses, hypotheses_of
from gripmon.track.integrity.knocks import Knocks, Mount
from gripmon.track.integrity.separation import (
    Cases,
    Doubts,
    Moved,
    Separation,
    bounds,
    follow,
    refitted,
    warm_up,
    with_known,
)

__all__ = [
    "Cases",
    "Doubts",
    "Hypotheses",
    "Knocks",
    "Mount",
    "Moved",
    "Separation",
    "bounds",
    "follow",
    "hypotheses_of",
    "refitted",
    "warm_up",
    "with_known",
]
