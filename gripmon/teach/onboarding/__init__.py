"""From rough corners in an image to a gripper's measured ones: what the hand/eye calibration on a plate begins with."""

from gripmon.teach.onboarding.measuring import measure_known, measure_outlines
from gripmon.teach.onboarding.onplate import KnownGripper, Look, UnknownGripper
from gripmon.teach.onboarding.outlines import Outline, RoughCorners, outlines_of

__all__ = [
    "KnownGripper",
    "Look",
    "Outline",
    "RoughCorners",
    "UnknownGripper",
    "measure_known",
    "measure_outlines",
    "outlines_of",
]
