"""What may be promised of a transform: bounds on its error under everything that may be wrong, at a stated risk."""

from gripmon.track.integrity.hypotheses import Hypotheses, hypotheses_of
from gripmon.track.integrity.knocks import Knocks, Mount
from gripmon.track.integrity.separation import (
    Cases,
    Doubts,
    Knocked,
    Moved,
    Separation,
    after_knocks,
    begun,
    bounds,
    follow,
    knocked,
    motion_since,
    refitted,
    telling,
    warm_up,
    with_known,
)

__all__ = [
    "Cases",
    "Doubts",
    "Hypotheses",
    "Knocked",
    "Knocks",
    "Mount",
    "Moved",
    "Separation",
    "after_knocks",
    "begun",
    "bounds",
    "follow",
    "hypotheses_of",
    "knocked",
    "motion_since",
    "refitted",
    "telling",
    "warm_up",
    "with_known",
]
