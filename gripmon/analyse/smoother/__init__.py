"""Retroactive correction: the transform of every instant, knowing the whole recording."""

from gripmon.analyse.smoother.correction import SOURCES, STAGES, ChangePoint, Correction, correct
from gripmon.analyse.smoother.run import LEAST_FRAMES
from gripmon.analyse.smoother.sampling import sample

__all__ = ["LEAST_FRAMES", "SOURCES", "STAGES", "ChangePoint", "Correction", "correct", "sample"]
