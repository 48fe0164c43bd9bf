"""Keys of earlier versions: a file that still has them is read as if it hadn't, with a line that says so."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from gripmon.daemon.config.typed import ConfigError

_log = logging.getLogger(__name__)


class _Gone(NamedTuple):
    """A key that is gone, with what to say; ``used``: whether a value of it had an effect that isn't there now.
    ``instead``: what to write instead, where nothing can be assumed.
    """

    section: tuple[str, ...]
    key: str
    text: str
    used: Callable[[Any], bool]
    instead: str = ""


_GONE = (
    _Gone(
        (),
        "laser",
        "a second camera isn't watched by the daemon any more",
        lambda _: True,
        "gripmon check --laser LASER.yaml SPOTS.csv compares fresh spots with a calibration",
    ),
    _Gone(
        ("source",),
        "topic",
        "is gone: ROS 2 is spoken by rclpy now",
        lambda _: True,
        "source: {kind: ros2, image: /the/topic}, in docs/howto/ros2.md",
    ),
    _Gone(
        ("jaw",),
        "topic",
        "is gone with jaw.source ros2_joint_state",
        lambda _: True,
        "joint_states and opening in a source of kind ros2, with jaw: {source: frames}, in docs/howto/ros2.md",
    ),
    _Gone(
        ("ros2",),
        "router",
        "rclpy finds ROS 2's nodes without it; remove the key, and for gripmon's own messages through that router "
        "write publish: {mode: client, connect: [tcp/127.0.0.1:7447]}",
        lambda router: router is not None,
    ),
    _Gone(
        ("monitor",),
        "look",
        "the look as a measurement is gone, and transforms come from the edges alone; remove the section",
        lambda look: isinstance(look, dict) and look.get("enabled") is True,
    ),
    _Gone(
        ("monitor", "stream"),
        "rate_s",
        "another frame rate than usual is no fault any more; remove the key",
        lambda _: False,
    ),
    _Gone(
        ("monitor", "policy"),
        "suspect_sigma_m",
        "is gone",
        lambda sigma_m: sigma_m is not None,
        "alert_limit_m, the error that the task tolerates: 4.42 times its value says the same at a risk of 1e-5 (m)",
    ),
)


def without_gone(path: Path, values: dict[str, Any], *, say: bool) -> dict[str, Any]:
    """The content of a configuration without the keys that are gone.

    ``say``: log a line for each of them; otherwise, for a file that nobody can edit, only for those that had an effect.
    Raises :class:`ConfigError` for one in whose place something else has to be written.
    """
    for gone in _GONE:
        values = _without(path, values, gone, gone.section, say=say)
    return values


def _without(path: Path, values: dict[str, Any], gone: _Gone, section: tuple[str, ...], *, say: bool) -> dict[str, Any]:
    if section:
        inner = values.get(section[0])
        if not isinstance(inner, dict):
            return values
        return values | {section[0]: _without(path, inner, gone, section[1:], say=say)}
    if gone.key not in values:
        return values
    key, used = ".".join((*gone.section, gone.key)), gone.used(values[gone.key])
    if used and gone.instead:
        raise ConfigError(path, key, gone.text, gone.instead)
    if say or used:
        _log.warning("%s: %s: %s", path, key, gone.text)
    return {name: value for name, value in values.items() if name != gone.key}
