"""``gripmon router``: a Zenoh router, by a configuration file of Zenoh's."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.io.wire import Router

_DESCRIPTION = """\
Route between monitors, controllers and operators until interrupted (Ctrl-C or SIGTERM).

FILE is a configuration of Zenoh's (json5 or yaml); zenohd, Zenoh's own router, takes the same one.
Paths of certificates in it count from its folder. A router that is to connect to another one tries
again for ever, and says so."""

_EXAMPLES = """\
  gripmon certificates --out certificates              once: keys for everyone
  gripmon router configs/zenoh/router.json5            mutual TLS, and who may do what
  gripmon router configs/zenoh/local.json5             without security, on this machine alone

exit codes: 0 SIGTERM; 2 wrong usage or configuration; 130 Ctrl-C"""

_LOOK_EVERY_S = 1.0


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "router", route, "a Zenoh router between monitors and their readers", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("config", metavar="FILE", help="Zenoh's configuration (json5, yaml)")


def route(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon router``."""
    from gripmon.io.wire import Router, ZenohFileError
    from gripmon.model.errors import InputError
    from gripmon.model.stopping import signals_exit

    with signals_exit():
        try:
            router = Router(Path(arguments.config))
        except ZenohFileError as error:
            raise InputError(f"router: {error}") from None
        with router:
            try:
                _say(f"listening on {', '.join(router.listens_on)}")
                _watch(router)
            finally:
                _say("stopped")


def _watch(router: Router) -> NoReturn:
    """Say whom the router misses, until a signal ends it."""
    said = ""
    while True:
        time.sleep(_LOOK_EVERY_S)
        if (fault := router.fault()) != said:
            _say(fault or "connected")
            said = fault


def _say(text: str) -> None:
    print(f"router: {text}", file=sys.stderr, flush=True)
