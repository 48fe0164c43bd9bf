"""What may be promised of a transform: bounds on its error under everything that may be wrong, at a stated risk."""

from gripmon.track.integrity.hypotheses import Hypotheses, hypotheses_of
from gripmon.track.integrity.knocks import Mount
from gripmon.track.integrity.separation import Separation, bounds, warm_up

__all__ = [
    "Hypotheses",
    "Mount",
    "Separation",
    "bounds",
    "hypotheses_of",
    "warm_up",
]
