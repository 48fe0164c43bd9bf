"""Retroactive correction: the transform of every instant, knowing the whole recording."""

from gripmon.hindsight.correction import SOURCES, STAGES, ChangePoint, Correction, correct
from gripmon.hindsight.run import LEAST_FRAMES
from gripmon.hindsight.sampling import sample

__all__ = ["LEAST_FRAMES", "SOURCES", "STAGES", "ChangePoint", "Correction", "correct", "sample"]
