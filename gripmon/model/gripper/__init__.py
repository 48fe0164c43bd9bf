"""What the camera sees of the gripper: corners, edges and faces of its fingers, and how they move with the jaws.

Gripper frame: origin at the TCP, x across the jaws, z out of the gripper (towards the object); metres.  The model comes
from a YAML file; its coordinates hold at the nominal jaw opening.  Each finger translates without rotation, along an
axis or as a table over the opening (adaptive grippers move on an arc, so that their fingertips also change depth).
"""

from __future__ import annotations

from gripmon.model.gripper.core import LARGEST_EXTENT_M, EdgeView, Gripper, on_a_line
from gripmon.model.gripper.faces import FaceLoop
from gripmon.model.gripper.model import (
    SIZE_UNKNOWN,
    UNTOLD_BEVEL_M,
    WIDEST_BEVEL_M,
    AxisMotion,
    EdgeModel,
    FaceModel,
    FingerModel,
    GripperError,
    GripperModel,
    JawModel,
    PointModel,
    RoundModel,
    TableMotion,
    contents_of,
)

__all__ = [
    "LARGEST_EXTENT_M",
    "SIZE_UNKNOWN",
    "UNTOLD_BEVEL_M",
    "WIDEST_BEVEL_M",
    "AxisMotion",
    "EdgeModel",
    "EdgeView",
    "FaceLoop",
    "FaceModel",
    "FingerModel",
    "Gripper",
    "GripperError",
    "GripperModel",
    "JawModel",
    "PointModel",
    "RoundModel",
    "TableMotion",
    "contents_of",
    "on_a_line",
]
