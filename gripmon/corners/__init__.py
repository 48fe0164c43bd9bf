"""Fingertip corners from images: predicted edges, sub-pixel candidates, one joint fit, intersections."""

from gripmon.corners.measure import Effort, FingertipMeter, Measurement, MeasurementSettings

__all__ = ["Effort", "FingertipMeter", "Measurement", "MeasurementSettings"]
