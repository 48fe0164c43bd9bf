"""The gripper's own learned look: a second witness of where it is."""

from gripmon.track.look.agreement import LookAgreement
from gripmon.track.look.core import GripperLook
from gripmon.track.look.strips import ONE_EDGE_PX, FingerStrips, StripsRefused, StripsSeen, warm_up

__all__ = [
    "ONE_EDGE_PX",
    "FingerStrips",
    "GripperLook",
    "LookAgreement",
    "StripsRefused",
    "StripsSeen",
    "warm_up",
]
