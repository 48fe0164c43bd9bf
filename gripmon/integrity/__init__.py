"""What may be promised of a transform: bounds on its error under everything that may be wrong, at a stated risk."""

from gripmon.integrity.quantiles import bounds

__all__ = ["bounds"]
