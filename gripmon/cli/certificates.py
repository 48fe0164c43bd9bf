"""``gripmon certificates``: keys for mutual TLS."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.io.wire.certificates import Issued

_DESCRIPTION = """\
Make a small private certificate authority in a folder, and certificates for those who shall talk to
each other: the names that the access rules of configs/zenoh/router.json5 know. Every robot has two of
its own, monitor-NAME and robot-NAME (gripper and camera driver), which can't speak for another robot.
What is there already stays, so that names can be added later. Private keys can be read by their owner
alone.

The authority's key, ca-key.pem, makes more certificates: keep it away from the robots."""

_EXAMPLES = """\
  gripmon certificates --out certificates                     router, controller, operator, robot arm1
  gripmon certificates --out certificates --host 10.0.0.5     the router will be reached at 10.0.0.5
  gripmon certificates --robot arm2 --robot arm3 --rules router.json5 --out certificates
                                                              two more robots, in the router's rules, too
  gripmon certificates dashboard --out certificates           one more client
  gripmon certificates central --host 10.0.0.1 --out certificates       another router; without --host a client

It needs the package cryptography: pip install -e '.[certificates]' in gripmon's checkout.
exit codes: 0 done; 2 wrong usage, a folder that can't be written to"""

_CLIENTS = ("controller", "operator")
_ROBOT = "arm1"  # the one in the shipped files
_LOCAL = ("localhost", "127.0.0.1", "::1")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_LONGEST_NAME = 50


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "certificates", make, "make keys and certificates for mutual TLS", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        type=_name,
        help=f"common names; default: router, {', '.join(_CLIENTS)} and those of the robots",
    )
    parser.add_argument(
        "--robot",
        action="append",
        metavar="ROBOT",
        default=[],
        help=f"a robot's name, for its two certificates; several times if need be; default: {_ROBOT}",
    )
    parser.add_argument(
        "--rules", metavar="FILE", help="add the rules for these robots to the router's file (router.json5 or like it)"
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="the folder; made if it is missing")
    parser.add_argument(
        "--host",
        action="append",
        metavar="HOST",
        default=[],
        help="name or address at which the router, or who is named, will be reached; several times if need be; "
        f"default: {', '.join(_LOCAL)} for the router",
    )


def make(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon certificates``."""
    try:
        from gripmon.io.wire.certificates import Authority, read
    except ImportError:
        text = (
            "certificates: the package cryptography is missing; pip install -e '.[certificates]' in gripmon's checkout"
        )
        raise InputError(text) from None
    if arguments.rules and not arguments.robot:
        raise InputError("certificates: --rules for whom? add --robot NAME")
    wanted = _wanted(arguments)
    folder = common.make_directory(Path(arguments.out))
    if arguments.rules:
        _add_rules(Path(arguments.rules), arguments.robot)
    try:
        authority = Authority(folder)
        if authority.is_new:
            print(f"{folder / 'ca.pem'}: a new authority; keep ca-key.pem away from the robots")
        for name, hosts in wanted.items():
            made = authority.issue(name, hosts)
            what = _in_words(read(folder / f"{name}.pem"))
            if made and not hosts:
                what += " (--host makes it a router's)"
            said = f"made, {what}" if made else f"there already, left alone: {what}; to change that, delete both files"
            print(f"{folder / name}.pem, {name}-key.pem: {said}")
    except OSError as error:
        raise common.not_writable(folder, error) from None
    except ValueError as error:
        raise InputError(f"certificates: {error}") from None
    return common.EXIT_DONE


def _wanted(arguments: argparse.Namespace) -> dict[str, list[str]]:
    """The names for which there shall be certificates, each with its hosts."""
    from gripmon.io.wire.certificates import names_of

    try:
        robots = [name for robot in arguments.robot for name in names_of(robot)]
        if arguments.names:
            return dict.fromkeys(arguments.names, arguments.host) | {name: [] for name in robots}
        names = (*_CLIENTS, *(robots or names_of(_ROBOT)))
    except ValueError as error:
        raise InputError(f"certificates: --robot: {error}") from None
    return {"router": [*_LOCAL, *arguments.host], **{name: [] for name in names}}


def _add_rules(path: Path, robots: list[str]) -> None:
    """Put rules for the robots into a router's file."""
    from gripmon.io.wire.certificates import with_robot
    from gripmon.model.atomic import write_atomically

    try:
        before = text = path.read_text(encoding="utf-8")
        for robot in robots:
            text = with_robot(text, robot)
        if text != before:
            write_atomically(path, text.encode())
    except OSError as error:
        raise common.not_writable(path, error, "--rules") from None
    except ValueError as error:
        said = "is no text" if isinstance(error, UnicodeDecodeError) else str(error)
        raise InputError(f"certificates: --rules {path} {said}") from None
    which = f"{', '.join(robots)} may speak for {'itself' if len(robots) == 1 else 'themselves'}"
    print(f"{path}: {which}{'; restart the router' if text != before else ' already'}")


def _in_words(issued: Issued) -> str:
    if issued.serves:
        return f"common name {issued.name}, for a router (and as a client) at {', '.join(issued.hosts)}"
    return f"common name {issued.name}, for a client only"


def _name(text: str) -> str:
    if not _NAME.fullmatch(text) or len(text) > _LONGEST_NAME or text == "ca":
        raise argparse.ArgumentTypeError(
            f"'{text}' can't be a name; letters, digits, - _ and ., at most {_LONGEST_NAME}, not ca"
        )
    return text
