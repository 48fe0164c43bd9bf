"""``gripmon certificates``: keys for mutual TLS."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from gripmon.cli.common import REQUIRED, Arguments, Command, make_directory, writing
from gripmon.model.errors import InputError, input_errors

if TYPE_CHECKING:
    from gripmon.io.wire.certificates import Issued

_OPTIONS = """
[NAME...]         common names; default: router, controller, operator and those of the robots
--robot ROBOT...  a robot's name, for its two certificates; may be repeated; default: arm1
--rules FILE      add the rules for these robots to the router's file (such as router.json5)
--out DIR         the folder; created if missing
--host HOST...    name or address at which the router, or the named one, will be reached; may be repeated;
                  default: localhost, 127.0.0.1, ::1 for the router
"""

_EXAMPLES = """\
  gripmon certificates --out certificates                     router, controller, operator, robot arm1
  gripmon certificates --out certificates --host 10.0.0.5     the router will be reached at 10.0.0.5
  gripmon certificates --robot arm2 --robot arm3 --rules router.json5 --out certificates
                                                              two more robots, also in the router's rules
  gripmon certificates dashboard --out certificates           one more client
  gripmon certificates central --host 10.0.0.1 --out certificates       another router; without --host a client

It needs the package cryptography: pip install -e '.[certificates]' in gripmon's checkout.
exit codes: 0 done; 2 wrong usage, a folder that can't be written to"""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_LONGEST_NAME = 50


def _name(text: str) -> str:
    if not _NAME.fullmatch(text) or len(text) > _LONGEST_NAME or text == "ca":
        right = f"letters, digits, - _ and ., at most {_LONGEST_NAME}, not ca"
        raise argparse.ArgumentTypeError(f"'{text}' can't be a name; {right}")
    return text


@Command(
    "certificates", "make keys and certificates for mutual TLS", _OPTIONS, _EXAMPLES, name=_name, robot={"default": []},
    out=REQUIRED, host={"default": []},
)  # fmt: skip
def certificates(arguments: Arguments) -> None:
    """Make a small private certificate authority in a folder, and certificates for the common names in the
    access rules of configs/zenoh/router.json5. Every robot has two of its own, monitor-NAME and robot-NAME
    (gripper and camera driver), which are not valid for another robot. Existing files are kept, so that
    names can be added later. Private keys are readable by their owner only.

    The authority's key, ca-key.pem, signs further certificates: keep it away from the robots.
    """
    try:
        from gripmon.io.wire.certificates import Authority, read
    except ImportError:
        right = "pip install -e '.[certificates]' in gripmon's checkout"
        raise InputError(f"certificates: the package cryptography is missing; {right}") from None
    from gripmon.io.wire.rules import wanted_names

    if arguments.rules and not arguments.robot:
        raise InputError("certificates: --rules without a robot; add --robot NAME")
    with input_errors("certificates: --robot"):
        wanted = wanted_names(arguments.name, arguments.robot, arguments.host)
    folder = make_directory(arguments.out)
    if arguments.rules:
        _add_rules(arguments)
    with input_errors("certificates"), writing(folder):
        authority = Authority(folder)
        if authority.is_new:
            print(f"{folder / 'ca.pem'}: a new authority; keep ca-key.pem away from the robots")
        for name, hosts in wanted.items():
            made = authority.issue(name, hosts)
            issued = _issued(made, read(folder / f"{name}.pem"), hosts)
            print(f"{folder / name}.pem, {name}-key.pem: {issued}")


def _issued(made: bool, issued: Issued, hosts: list[str]) -> str:
    what = f"common name {issued.name}, for a client only"
    if issued.serves:
        what = f"common name {issued.name}, for a router (and as a client) at {', '.join(issued.hosts)}"
    if made and not hosts:
        what += " (--host makes it a router's)"
    return f"made, {what}" if made else f"exists, unchanged: {what}; to change it, delete both files"


def _add_rules(arguments: Arguments) -> None:
    """Put rules for the robots into a router's file."""
    from gripmon.io.wire.rules import add_robots

    path, robots = arguments.rules, arguments.robot
    try:
        with writing(path, "--rules"):
            changed = add_robots(path, robots)
    except ValueError as error:
        wrong = "isn't text" if isinstance(error, UnicodeDecodeError) else str(error)
        raise error if isinstance(error, InputError) else InputError(f"certificates: --rules {path} {wrong}") from None
    which = f"rules for {', '.join(robots)}"
    print(f"{path}: {which}{' added; restart the router' if changed else ' exist already'}")
