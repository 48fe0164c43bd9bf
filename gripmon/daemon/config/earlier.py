"""Keys of earlier versions: a file that still has them is read as if it hadn't, with a line that says so."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from gripmon.daemon.config.typed import ConfigError

_log = logging.getLogger(__name__)

_NO_ROUTER = (
    "rclpy finds ROS 2's nodes without it; remove the key, and for gripmon's own messages through that router write "
    "publish: {mode: client, connect: [tcp/127.0.0.1:7447]}"
)
_OPENING = "joint_states and opening in a source of kind ros2, with jaw: {source: frames}, in docs/howto/ros2.md"
_LIMIT = "alert_limit_m, the error that the task tolerates: 4.42 times its value says the same at a risk of 1e-5 (m)"
_SPOTS = "gripmon check --laser LASER.yaml SPOTS.csv compares fresh spots with a calibration"
_NO_LOOK = "the look as a measurement is gone, and transforms come from the edges alone; remove the section"
_GONE = {
    "laser": ("a second camera isn't watched by the daemon any more", _SPOTS),
    "source.topic": (
        "is gone: ROS 2 is spoken by rclpy now", "source: {kind: ros2, image: /the/topic}, in docs/howto/ros2.md"
    ),
    "jaw.topic": ("is gone with jaw.source ros2_joint_state", _OPENING),
    "ros2.router": (_NO_ROUTER, ""),
    "monitor.look": (_NO_LOOK, ""),
    "monitor.stream.rate_s": ("another frame rate than usual is no fault any more; remove the key", ""),
    "monitor.policy.suspect_sigma_m": ("is gone", _LIMIT),
}  # fmt: skip
"""By key what to say, and what to write instead where nothing can be assumed."""


def without_gone(path: Path, values: dict[str, Any], *, say: bool) -> dict[str, Any]:
    """The content of a configuration without the keys that are gone.

    ``say``: log a line for each of them; otherwise, for a file that nobody can edit, only for those that had an effect.
    Raises :class:`ConfigError` for one in whose place something else has to be written.
    """
    for key in _GONE:
        values = _without(path, values, key, key.split("."), say=say)
    return values


def _without(path: Path, values: dict[str, Any], key: str, names: list[str], *, say: bool) -> dict[str, Any]:
    first, *rest = names
    if rest:
        inner = values.get(first)
        return values | {first: _without(path, inner, key, rest, say=say)} if isinstance(inner, dict) else values
    if first not in values:
        return values
    (text, instead), value = _GONE[key], values[first]
    used = value is not None and key != "monitor.stream.rate_s"
    if key == "monitor.look":
        used = isinstance(value, dict) and value.get("enabled") is True
    if used and instead:
        raise ConfigError(path, key, text, instead)
    if say or used:
        _log.warning("%s: %s: %s", path, key, text)
    return {name: other for name, other in values.items() if name != first}
