"""Calibration targets found in images: which points are seen, to some hundredths of a pixel, and their covariances."""

from gripmon.calibrate.detection.boards import upright
from gripmon.calibrate.detection.target import BLURRED_PX, detect

__all__ = ["BLURRED_PX", "detect", "upright"]
