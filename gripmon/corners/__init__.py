"""Fingertip corners from images: predicted edges, sub-pixel candidates, one joint fit, intersections."""

from gripmon.corners.consensus import prior_information
from gripmon.corners.ends import FingerEnds, FingerEndsSeen
from gripmon.corners.measure import FingertipMeter, Patience
from gripmon.corners.settling import JAW_UNREPORTED_SIGMA_M, Effort, Measurement, MeasurementSettings
from gripmon.corners.sums import edge_sums
from gripmon.corners.taught import TaughtEdges, TaughtModel
from gripmon.corners.uncertainty import NormalEquations
from gripmon.corners.views import agreeing_fingers, trace_of

__all__ = [
    "JAW_UNREPORTED_SIGMA_M",
    "Effort",
    "FingerEnds",
    "FingerEndsSeen",
    "FingertipMeter",
    "Measurement",
    "MeasurementSettings",
    "NormalEquations",
    "Patience",
    "TaughtEdges",
    "TaughtModel",
    "agreeing_fingers",
    "edge_sums",
    "prior_information",
    "trace_of",
]
