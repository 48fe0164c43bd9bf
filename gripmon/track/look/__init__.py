"""The gripper's own learned look: a second witness of where it is, which fails in other ways than its edges."""

from gripmon.track.look.agreement import LookAgreement
from gripmon.track.look.core import GripperLook, LookRefused
from gripmon.track.look.strips import FingerStrips

__all__ = ["FingerStrips", "GripperLook", "LookAgreement", "LookRefused"]
