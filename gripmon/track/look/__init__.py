"""The gripper's own learned look: a second witness of where it is."""

from gripmon.track.look.agreement import LookAgreement, LookRefused
from gripmon.track.look.core import GripperLook
from gripmon.track.look.strips import ONE_EDGE_PX, FingerStrips, StripsSeen

__all__ = [
    "ONE_EDGE_PX",
    "FingerStrips",
    "GripperLook",
    "LookAgreement",
    "LookRefused",
    "StripsSeen",
]
