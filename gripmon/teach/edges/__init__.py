"""Teaching: what the edges of a gripper look like to a camera at the reference calibration."""

from gripmon.teach.edges.measure import Taught, teach
from gripmon.teach.edges.views import TeachingImage, TeachingRefused

__all__ = ["Taught", "TeachingImage", "TeachingRefused", "teach"]
