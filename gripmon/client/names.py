"""Whose messages."""

from __future__ import annotations

from typing import NamedTuple


class MonitorName(NamedTuple):
    """The second and third part of every key."""

    robot: str
    camera: str

    def __str__(self) -> str:
        return f"{self.robot}/{self.camera}"


class Start(NamedTuple):
    """One start of a monitor: the process that speaks under its name; without an id from a version before ids."""

    monitor: MonitorName
    monitor_id: str

    def __str__(self) -> str:
        return f"{self.monitor} ({self.monitor_id or 'of an earlier version'})"


def start_of(key: object) -> Start:
    """Which start shows the liveliness token ``gripmon/<robot>/<camera>/alive/<id>``."""
    return Start(monitor_name(key), str(key).rpartition("/")[2])


def monitor_name(key: object) -> MonitorName:
    """Who a message on this key, ``gripmon/<robot>/<camera>/…``, is from."""
    _, robot, camera, *_ = str(key).split("/")
    return MonitorName(robot, camera)
