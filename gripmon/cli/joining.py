"""Options of the commands that join the network as somebody's client."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.io.wire import PublishError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # gripmon.io.wire's, which is too heavy for --help
_OPTIONS = {"connect": "--connect", "zenoh_config": "--zenoh-config"}


def add_options(parser: argparse.ArgumentParser, whose: str) -> None:
    """``--connect`` and ``--zenoh-config``; ``whose`` endpoints they are, with article."""
    parser.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help=f"{whose} or a router's Zenoh endpoint, several times if need be; default: {DEFAULT_ENDPOINT}",
    )
    parser.add_argument("--zenoh-config", metavar="FILE", help="a configuration file of Zenoh's instead of --connect")


def misuse(arguments: argparse.Namespace) -> str:
    """What of these options can't go together; empty if all can."""
    both = arguments.connect and arguments.zenoh_config
    return "--connect has no effect beside --zenoh-config; one of them" if both else ""


def failure(command: str, error: PublishError) -> InputError:
    """What to raise when there is no session: it names the option, since no key was written."""
    return InputError(f"{command}: {_OPTIONS.get(error.key, error.key)}: {error.text}")
