"""What the README promises exists: commands, files, settings."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import msgspec

from gripmon.cli import build_parser
from gripmon.daemon.config.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
CODE = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def _options_of(parser: argparse.ArgumentParser, words: list[str]) -> set[str]:
    """Of a command, or of the one below it that the first word names."""
    below = parser._subparsers._group_actions[0].choices if parser._subparsers else {}  # type: ignore[union-attr]
    chosen = below[words[0]] if words and words[0] in below else parser
    return {option for action in chosen._actions for option in action.option_strings}


def test_commands_and_their_options_exist():
    parser = build_parser()
    subcommands = parser._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    shell = "\n".join(re.findall(r"```sh\n.*?```|`gripmon.*?`", TEXT, re.DOTALL))
    used = re.findall(r"gripmon ([a-z]+)((?: [^`\n|]*)?)", shell)
    assert {command for command, _ in used} == set(subcommands)
    for command, rest in used:
        known = _options_of(subcommands[command], rest.split())
        assert set(re.findall(r"--[a-z-]+", rest.split("#")[0])) <= known, command


def test_files_that_are_named_exist():
    paths = set(re.findall(r"(?<![\w/.])((?:configs|tools|tests|docs)/[\w./]*\w)", TEXT))
    assert len(paths) > 6
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_settings_that_are_named_exist():
    named = set(re.findall(r"`((?:monitor|publish|jaw|reference|state)(?:\.\w+)+)`", TEXT)) - {"jaw.nominal_m"}
    assert len(named) >= 4
    for dotted in named:
        kind: type = Settings
        for key in dotted.split("."):
            fields = {field.name: field.type for field in msgspec.structs.fields(kind)}
            assert key in fields, dotted
            kind = fields[key]


def test_python_examples_compile():
    assert len(CODE) == 3
    for code in CODE:
        compile(code, "README.md", "exec")


def test_the_pictures_are_small():
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", TEXT)
    assert {"docs/demo.jpg", "docs/sweep.jpg"} <= set(pictures)
    assert all((ROOT / picture).stat().st_size < 400_000 for picture in pictures)
