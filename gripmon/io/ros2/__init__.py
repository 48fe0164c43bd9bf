"""ROS 2 without a bridge: what a node on ``rmw_zenoh`` would put on the network, and reading what such nodes put there.

The message definitions, their hashes and CDR come from ``rosbags``, an optional dependency (``gripmon[ros2]``) that is
imported at the first message.
"""

from __future__ import annotations

from gripmon.io.ros2.names import (
    Layout,
    NodeName,
    Qos,
    Ros2Fault,
    Ros2Settings,
    RosNameError,
    as_token,
    fault_of,
    layout_of,
    network_of,
    subscription_key,
)
from gripmon.io.ros2.node import (
    COMPRESSED_IMAGE,
    IMAGE,
    JOINT_STATE,
    HeardTopic,
    JointOpening,
    Listeners,
    MessageError,
    Node,
    Ros2Missing,
    decode_compressed_image,
    decode_image,
    decode_joint_state,
)
from gripmon.io.ros2.publisher import Ros2Publisher

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
