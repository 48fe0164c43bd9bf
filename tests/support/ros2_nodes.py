"""Nodes of a real ROS 2 beside the monitor's: on this machine alone, in a domain that nobody else should have."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from support.loopback import wait_until
from support.network_daemon import ENVIRONMENT

rclpy = pytest.importorskip("rclpy", reason="the wheels of ROS 2 aren't installed (gripmon[ros2])")

ENVIRONMENT["ROS_AUTOMATIC_DISCOVERY_RANGE"] = os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
DOMAIN = random.SystemRandom().randrange(10, 100)
OTHER_DOMAIN = DOMAIN + 1


class OtherNode:
    """A node by plain rclpy."""

    def __init__(self, node: Any) -> None:
        self.node = node

    def listen(self, kind: type, topic: str) -> list[Any]:
        """All messages from now on."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, 100)
        return messages

    def publisher(self, kind: type, topic: str) -> Any:
        return self.node.create_publisher(kind, topic, 10)

    def call(self, name: str) -> Any:
        """The response of a Trigger service."""
        from std_srvs.srv import Trigger

        client = self.node.create_client(Trigger, name)
        wait_until(client.service_is_ready, f"the service {name}")
        future = client.call_async(Trigger.Request())
        wait_until(future.done, f"an answer of {name}")
        return future.result()


@contextmanager
def other_node(name: str, domain: int = DOMAIN) -> Iterator[OtherNode]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    node = rclpy.create_node(name, context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield OtherNode(node)
    finally:
        stop.set()
        thread.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def stamped(message: Any, stamp_ns: int) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def image_message(image: np.ndarray, stamp_ns: int, encoding: str = "mono8") -> Any:
    from sensor_msgs.msg import Image

    step = image.strides[0]
    message = Image(height=image.shape[0], width=image.shape[1], encoding=encoding, step=step)
    message.data.frombytes(image.tobytes())
    return stamped(message, stamp_ns)


def file_message(data: bytes, stamp_ns: int, said: str = "png") -> Any:
    from sensor_msgs.msg import CompressedImage

    message = CompressedImage(format=said)
    message.data.frombytes(data)
    return stamped(message, stamp_ns)


def joint_message(stamp_ns: int, **positions: float) -> Any:
    from sensor_msgs.msg import JointState

    return stamped(JointState(name=list(positions), position=list(positions.values())), stamp_ns)


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
