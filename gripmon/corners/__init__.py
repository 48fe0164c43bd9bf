"""Fingertip corners from images: predicted edges, sub-pixel candidates, one joint fit, intersections."""

from gripmon.corners.measure import FingertipMeter, Patience
from gripmon.corners.settling import Effort, Measurement, MeasurementSettings
from gripmon.corners.sums import edge_sums
from gripmon.corners.taught import TaughtEdges, TaughtModel
from gripmon.corners.views import agreeing_fingers, trace_of

__all__ = [
    "Effort",
    "FingertipMeter",
    "Measurement",
    "MeasurementSettings",
    "Patience",
    "TaughtEdges",
    "TaughtModel",
    "agreeing_fingers",
    "edge_sums",
    "trace_of",
]
