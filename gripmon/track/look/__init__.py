"""The gripper's own learned look: a second witness of where it is, and a finer measure of how it moves."""

from gripmon.track.look.agreement import LookAgreement, LookRefused
from gripmon.track.look.alignment import LookAlignment, LookMotion, warm_up
from gripmon.track.look.blocks import BLOCK_PX
from gripmon.track.look.core import GripperLook, another_background
from gripmon.track.look.fusion import Fused, LookFusion
from gripmon.track.look.strips import ONE_EDGE_PX, FingerStrips, StripsSeen

__all__ = [
    "BLOCK_PX",
    "ONE_EDGE_PX",
    "FingerStrips",
    "Fused",
    "GripperLook",
    "LookAgreement",
    "LookAlignment",
    "LookFusion",
    "LookMotion",
    "LookRefused",
    "StripsSeen",
    "another_background",
    "warm_up",
]
