"""ROS 2 without a bridge: what a node on ``rmw_zenoh`` would put on the network, and reading what such nodes put there.

The message definitions, their hashes and CDR come from ``rosbags``, an optional dependency (``gripmon[ros2]``) that is
imported at the first message.
"""

from __future__ import annotations

from gripmon.io.ros2.decode import (
    JointOpening,
    MessageError,
    decode_compressed_image,
    decode_image,
    decode_joint_state,
)
from gripmon.io.ros2.names import NodeName, Qos, RosNameError, as_token, subscription_key
from gripmon.io.ros2.node import Node
from gripmon.io.ros2.presence import HeardTopic, Listeners
from gripmon.io.ros2.publisher import Ros2Publisher
from gripmon.io.ros2.settings import Layout, Ros2Fault, Ros2Settings, fault_of, layout_of, network_of
from gripmon.io.ros2.types import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, Ros2Missing

__all__ = [
    "COMPRESSED_IMAGE",
    "IMAGE",
    "JOINT_STATE",
    "HeardTopic",
    "JointOpening",
    "Layout",
    "Listeners",
    "MessageError",
    "Node",
    "NodeName",
    "Qos",
    "Ros2Fault",
    "Ros2Missing",
    "Ros2Publisher",
    "Ros2Settings",
    "RosNameError",
    "as_token",
    "decode_compressed_image",
    "decode_image",
    "decode_joint_state",
    "fault_of",
    "layout_of",
    "network_of",
    "subscription_key",
]
