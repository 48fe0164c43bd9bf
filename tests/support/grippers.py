"""Grippers from values, as a file has them."""

from __future__ import annotations

from typing import Any

import msgspec

from gripmon.model.gripper import Gripper, GripperModel


def gripper_from_dict(value: Any) -> Gripper:
    """msgspec's ValidationError for a wrong key or type."""
    return Gripper(msgspec.convert(value, GripperModel))
