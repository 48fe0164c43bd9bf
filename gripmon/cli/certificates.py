"""``gripmon certificates``: keys for mutual TLS."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from gripmon.cli import common

_DESCRIPTION = """\
Make a small private certificate authority in a folder, and certificates for those who shall talk to
each other: the names that the access rules of configs/zenoh/router.json5 know. What is there already
stays, so that names can be added later. Private keys can be read by their owner alone.

The authority's key, ca-key.pem, makes more certificates: keep it away from the robots."""

_EXAMPLES = """\
  gripmon certificates --out certificates                     router, monitor, controller, operator, robot
  gripmon certificates --out certificates --host 10.0.0.5     the router will be reached at 10.0.0.5
  gripmon certificates arm1 arm2 --out certificates           more clients
  gripmon certificates site7 --host site7.example --out certificates    another router

It needs the package cryptography: pip install 'gripmon[certificates]'.
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
        from gripmon.wire.certificates import Authority
    except ImportError:
        text = "certificates: the package cryptography is missing; pip install 'gripmon[certificates]'"
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
            place = f", reached at {', '.join(hosts)}" if hosts and made else ""
            print(f"{folder / name}.pem, {name}-key.pem: {'made' if made else 'there already, left alone'}{place}")
    except OSError as error:
        raise common.not_writable(folder, error) from None
    except ValueError as error:
        raise common.CommandFailedError(f"certificates: {error}", common.EXIT_USAGE) from None
    return common.EXIT_DONE


def _name(text: str) -> str:
    if not _NAME.fullmatch(text) or len(text) > _LONGEST_NAME or text == "ca":
        raise argparse.ArgumentTypeError(
            f"'{text}' can't be a name; letters, digits, - _ and ., at most {_LONGEST_NAME}, not ca"
        )
    return text
