"""Access rules in a router's file for another robot, whose certificates are valid for it alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from gripmon.model.atomic import write_atomically

_CLIENTS = ("controller", "operator")
_SHIPPED_ROBOT = "arm1"  # the one in the shipped files
_LOCAL = ("localhost", "127.0.0.1", "::1")
_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")


def names_of(robot: str) -> tuple[str, str]:
    """The common names of a robot's monitor, and of its gripper and camera driver.

    Raises ValueError for a name that can't be part of them.
    """
    if not _ROBOT.fullmatch(robot):
        raise ValueError(f"'{robot}' can't be a robot's name in a certificate; letters, digits, - _ and .")
    return f"monitor-{robot}", f"robot-{robot}"


def wanted_names(names: Sequence[str], robots: Sequence[str], hosts: Sequence[str]) -> dict[str, list[str]]:
    """The common names that need certificates, each with the hosts at which it is reached: ``names`` or else those of
    the shipped rules, and two for each robot.  ValueError as :func:`names_of`.
    """
    of_robots = [name for robot in robots for name in names_of(robot)]
    if names:
        return {name: list(hosts) for name in names} | {name: [] for name in of_robots}
    others = (*_CLIENTS, *(of_robots or names_of(_SHIPPED_ROBOT)))
    return {"router": [*_LOCAL, *hosts], **{name: [] for name in others}}


def add_robots(path: Path, robots: Sequence[str]) -> bool:
    """Add the robots' rules to a router's file; False if it has them already.  ValueError as :func:`with_robot`,
    OSError for a file that can't be read or written.
    """
    before = text = path.read_text(encoding="utf-8")
    for robot in robots:
        text = with_robot(text, robot)
    if text != before:
        write_atomically(path, text.encode())
    return text != before


def with_robot(text: str, robot: str) -> str:
    """The text of a router's file, json5, with the rules for this robot added; the same text if it has them.

    They are inserted before the lines ``// robots: rules``, ``subjects`` and ``policies`` of the shipped files.  Raises
    ValueError for a file without these.
    """
    monitor, driver = names_of(robot)
    if re.search(rf'^[^/\n]*cert_common_names: \["{re.escape(monitor)}"\]', text, re.MULTILINE):
        return text
    for part, lines in _parts(robot, monitor, driver).items():
        mark = re.search(rf"^ *// robots: {part}\n", text, re.MULTILINE)
        if mark is None:
            raise ValueError(f"has no line '// robots: {part}', before which the robot's would stand")
        text = text[: mark.start()] + lines + text[mark.start() :]
    return text


def _parts(robot: str, monitor: str, driver: str) -> dict[str, str]:
    everything = f'["gripmon/{robot}/**", "gripmon/{robot}/*/*/@adv/**"]'
    inputs = ", ".join(f'"gripmon/{robot}/*/{leaf}"' for leaf in ("jaw", "image"))
    rules = f"""\
      {{ id: "{monitor} says", permission: "allow", flows: ["ingress"],
        messages: ["put", "declare_queryable", "reply", "liveliness_token", "declare_subscriber", "liveliness_query",
                   "declare_liveliness_subscriber"],
        key_exprs: {everything} }},
      {{ id: "{monitor} hears", permission: "allow", flows: ["egress"],
        messages: ["put", "reply", "liveliness_token"],
        key_exprs: {everything} }},
      {{ id: "{driver} reports", permission: "allow", flows: ["ingress"], messages: ["put"],
        key_exprs: [{inputs}] }},
      {{ id: "{driver} is heard", permission: "allow", flows: ["egress"], messages: ["declare_subscriber"],
        key_exprs: [{inputs}] }},
"""
    subjects = "".join(f'      {{ id: "{name}", cert_common_names: ["{name}"] }},\n' for name in (monitor, driver))
    policies = f"""\
      {{ subjects: ["{monitor}"], rules: ["{monitor} says", "{monitor} hears", "be asked"] }},
      {{ subjects: ["{driver}"], rules: ["{driver} reports", "{driver} is heard"] }},
"""
    return {"rules": rules, "subjects": subjects, "policies": policies}
