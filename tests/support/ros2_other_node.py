"""A node of ``zenoh-ros2-sdk``, another implementation of ``rmw_zenoh``'s protocol, in a process of its own.

PORT COUNT: prints as JSON what it knows of the publishers of three topics, then COUNT transforms from tf as it decoded
them.  It gets the definitions of all messages, so that it fetches none from the network, and computes their hashes
itself.
"""

from __future__ import annotations

import dataclasses
import json
import queue
import sys

from zenoh_ros2_sdk import ROS2Subscriber, ZenohSession, get_topic_info
from zenoh_ros2_sdk.utils import get_type_hash

from support.ros2_definitions import DEFINITIONS

TF = "tf2_msgs/msg/TFMessage"
port, count = map(int, sys.argv[1:])

session = ZenohSession.get_instance("127.0.0.1", port)
for name, definition in DEFINITIONS.items():
    session.register_message_type(definition, name)
received: queue.Queue[object] = queue.Queue()
subscriber = ROS2Subscriber(
    "/tf",
    TF,
    received.put,
    msg_definition=DEFINITIONS[TF],
    domain_id=0,
    router_port=port,
    type_hash=get_type_hash(TF, DEFINITIONS[TF], DEFINITIONS),
)
placed = [received.get(timeout=60.0).transforms[0] for _ in range(count)]
for topic in ("/tf", "/demo/wrist/gripmon/cam_T_grip", "/diagnostics"):
    info = get_topic_info(topic, domain_id=0, router_port=port, timeout=5.0, verbose=True)
    print(json.dumps(dataclasses.asdict(info)), flush=True)
for each in placed:
    translation, rotation = each.transform.translation, each.transform.rotation
    line = {
        "stamp_ns": each.header.stamp.sec * 1_000_000_000 + each.header.stamp.nanosec,
        "frames": [each.header.frame_id, each.child_frame_id],
        "translation_m": [translation.x, translation.y, translation.z],
        "rotation_xyzw": [rotation.x, rotation.y, rotation.z, rotation.w],
    }
    print(json.dumps(line), flush=True)
subscriber.close()
session.session.close()
