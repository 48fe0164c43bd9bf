"""ROS 2 without a bridge: what a node on ``rmw_zenoh`` would put on the network, and reading what such nodes put there.

The message definitions, their hashes and CDR come from ``rosbags``, an optional dependency (``gripmon[ros2]``) that is
imported at the first message.
"""

from __future__ import annotations

from gripmon.ros2.decode import (
    ENCODINGS,
    JointOpening,
    MessageError,
    decode_compressed_image,
    decode_image,
    decode_joint_state,
)
from gripmon.ros2.names import NodeName, Qos, RosNameError, subscription_key
from gripmon.ros2.types import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, Ros2Missing

__all__ = [
    "COMPRESSED_IMAGE",
    "ENCODINGS",
    "IMAGE",
    "JOINT_STATE",
    "JointOpening",
    "MessageError",
    "NodeName",
    "Qos",
    "Ros2Missing",
    "RosNameError",
    "decode_compressed_image",
    "decode_image",
    "decode_joint_state",
    "subscription_key",
]
