"""Whose messages."""

from __future__ import annotations

from typing import NamedTuple


class MonitorName(NamedTuple):
    """The second and third part of every key."""

    robot: str
    camera: str

    def __str__(self) -> str:
        return f"{self.robot}/{self.camera}"


def monitor_name(key: object) -> MonitorName:
    """Who a message on this key, ``gripmon/<robot>/<camera>/…``, is from."""
    _, robot, camera, *_ = str(key).split("/")
    return MonitorName(robot, camera)
