"""``gripmon certificates``: keys for mutual TLS."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.wire.certificates import Issued

_DESCRIPTION = """\
Make a small private certificate authority in a folder, and certificates for those who shall talk to
each other: the names that the access rules of configs/zenoh/router.json5 know. What is there already
stays, so that names can be added later. Private keys can be read by their owner alone.

The authority's key, ca-key.pem, makes more certificates: keep it away from the robots."""

_EXAMPLES = """\
  gripmon certificates --out certificates                     router, monitor, controller, operator, robot
  gripmon certificates --out certificates --host 10.0.0.5     the router will be reached at 10.0.0.5
  gripmon certificates arm1 arm2 --out certificates           more clients
  gripmon certificates central --host 10.0.0.1 --out certificates       another router; without --host a client

It needs the package cryptography: pip install -e '.[certificates]' in gripmon's checkout.
exit codes: 0 done; 2 wrong usage, a folder that can't be written to"""

_CLIENTS = ("monitor", "controller", "operator", "robot")
_LOCAL = ("localhost", "127.0.0.1", "::1")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_LONGEST_NAME = 50


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "certificates", make, "make keys and certificates for mutual TLS", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "names", metavar="NAME", nargs="*", type=_name, help=f"common names; default: router, {', '.join(_CLIENTS)}"
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
        from gripmon.wire.certificates import Authority, read
    except ImportError:
        text = (
            "certificates: the package cryptography is missing; pip install -e '.[certificates]' in gripmon's checkout"
        )
        raise common.CommandFailedError(text, common.EXIT_USAGE) from None
    folder = common.make_directory(Path(arguments.out))
    if arguments.names:
        wanted = dict.fromkeys(arguments.names, arguments.host)
    else:
        wanted = {"router": [*_LOCAL, *arguments.host], **{name: [] for name in _CLIENTS}}
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
        raise common.CommandFailedError(f"certificates: {error}", common.EXIT_USAGE) from None
    return common.EXIT_DONE


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
