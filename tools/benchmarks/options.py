"""What benchmarks parse alike: how long, from which seed, and where the results go."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def add_command(
    commands: Any,
    name: str,
    handler: Callable[[argparse.Namespace], int],
    help_line: str,
    description: str,
    *,
    quick: str = "",
    seed: bool = False,
    as_json: str = "",
    markdown: bool = False,
) -> argparse.ArgumentParser:
    """A benchmark of ``tools/bench``; ``quick`` and ``as_json`` are what the options of these names do, if there."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=help_line, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    if seed:
        parser.add_argument("--seed", type=count, default=1, metavar="N", help="of everything random (default 1)")
    if as_json:
        parser.add_argument("--json", type=Path, metavar="FILE", help=as_json)
    if markdown:
        parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the report as a Markdown file")
    parser.set_defaults(handler=handler)
    return parser


def count(text: str) -> int:
    """A whole number from 0, as an argument's type."""
    return _at_least(0, text)


def positive(text: str) -> int:
    """A whole number from 1."""
    return _at_least(1, text)


def _at_least(lowest: int, text: str) -> int:
    value = int(text)
    if value < lowest:
        raise argparse.ArgumentTypeError(f"{value}; at least {lowest}")
    return value


def deliver(arguments: argparse.Namespace, title: str, text: str, results: Any) -> None:
    """Print the report, and write the files that were asked for."""
    print(text)
    if getattr(arguments, "json", None) is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    if getattr(arguments, "markdown", None) is not None:
        arguments.markdown.write_text(f"# `tools/bench {title}`\n\n```\n{text}\n```\n")
