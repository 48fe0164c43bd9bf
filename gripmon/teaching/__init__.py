"""Teaching: what the edges of a gripper look like to a camera at the reference calibration."""

from gripmon.teaching.measure import Taught, teach
from gripmon.teaching.views import TeachingImage, TeachingRefused

__all__ = ["Taught", "TeachingImage", "TeachingRefused", "teach"]
