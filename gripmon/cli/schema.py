"""``gripmon schema``: what the messages look like."""

from __future__ import annotations

import argparse
import json
from typing import Any

from gripmon.cli import common

_NAMES = (
    "transform", "state", "alert", "reference", "clock", "jaw", "frame", "pulse", "spot", "command", "reply", "error",
)  # fmt: skip

_DESCRIPTION = """\
Print the JSON Schema (draft 2020-12) of one message, or of any message: its fields with units, frames
and when they are null.

Every message says its own schema and that one's major version: "schema": "gripmon.transform/1".  Within
a major version fields and names may be added, and nothing else changes."""

_EXAMPLES = """\
  gripmon schema --list
  gripmon schema transform > transform.schema.json
  gripmon schema                                      any message

exit codes: 0 done; 2 wrong usage"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "schema", schema, "print the JSON Schema of the messages", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("message", metavar="MESSAGE", nargs="?", choices=_NAMES, help=", ".join(_NAMES))
    parser.add_argument("--list", action="store_true", help="print name, schema and content of every message")


def schema(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon schema``."""
    from gripmon.model.errors import InputError
    from gripmon.model.records import MESSAGES, json_schema, schema_name, summary

    if arguments.list and arguments.message:
        raise InputError(f"schema: --list is about all messages, but {arguments.message} is given; one of them")
    names = tuple(MESSAGES) if arguments.message is None else (arguments.message,)
    if arguments.list:
        for name in names:
            print(f"{name:10} {schema_name(MESSAGES[name]):20} {summary(name)}")
    else:
        print(json.dumps(json_schema(names), indent=2, ensure_ascii=False))
    return common.EXIT_DONE
