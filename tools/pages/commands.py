"""The reference of the command line: what ``--help`` prints, of every command and every command below one."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from unittest.mock import patch

_WIDTH = 100
_HEAD = """\
# Command line

What `--help` prints. Every command ends with one of these exit codes:

| exit code | means |
| --- | --- |
| 0 | done; also a daemon that SIGTERM ended |
| 2 | wrong usage or configuration: one line says file, key, what is wrong and what would be right |
| 3 | what was to be monitored or done failed, for example no usable frame |
| 4 | `run`: another monitor of this robot and camera is on the network |
| 130 | interrupted by Ctrl-C |
"""


def page() -> str:
    """The page in Markdown."""
    from gripmon.cli import build_parser

    parts = [_HEAD]
    with patch.dict(os.environ, {"COLUMNS": str(_WIDTH), "NO_COLOR": "1"}):
        for name, parser in parsers(build_parser()):
            mark = "#" * (2 + max(0, name.count(" ") - 1))
            parts.append(f"{mark} {name}\n\n```text\n{parser.format_help().rstrip()}\n```\n")
    return "\n".join(parts)


def parsers(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """The parser and all below it, each with its whole name: ``gripmon calibrate plane``."""
    yield parser.prog, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from parsers(below)
