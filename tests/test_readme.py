"""What the README and the pages promise exists: commands, files, settings."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import msgspec
import pytest

from gripmon.cli import build_parser
from gripmon.daemon.config.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CODE = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


NOT_SETTINGS = {"jaw.nominal_m", "reference.play", "reference.seen"}
"""Of a gripper file, and of a taught one."""


def _options_of(parser: argparse.ArgumentParser, words: list[str]) -> set[str]:
    """Of a command, or of the one below it that the first word names."""
    below = parser._subparsers._group_actions[0].choices if parser._subparsers else {}  # type: ignore[union-attr]
    chosen = below[words[0]] if words and words[0] in below else parser
    return {option for action in chosen._actions for option in action.option_strings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_and_their_options_exist(page: Path):
    subcommands = build_parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    text = page.read_text(encoding="utf-8").replace("\\\n", "")
    shell = "\n".join(re.findall(r"```sh\n.*?```|`gripmon.*?`", text, re.DOTALL))
    for command, rest in re.findall(r"(?:^|[`&] ?)gripmon ([a-z]+)((?: [^`\n|&]*)?)", shell, re.MULTILINE):
        known = _options_of(subcommands[command], rest.split())
        assert set(re.findall(r"--[a-z-]+", rest.split("#")[0])) <= known, command


def test_every_command_is_shown_somewhere():
    used = {name for page in PAGES for name in re.findall(r"gripmon ([a-z]+)", page.read_text(encoding="utf-8"))}
    assert used >= set(build_parser()._subparsers._group_actions[0].choices)  # type: ignore[union-attr]


def test_the_readme_is_short():
    assert len(TEXT.encode()) <= 10_000


def test_settings_that_are_named_exist():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    sections = "monitor|publish|jaw|reference|state|recording|daemon|view|metrics|ros2"
    named = set(re.findall(rf"`((?:{sections})(?:\.\w+)+)`", text)) - NOT_SETTINGS
    named = {name for name in named if not re.search(r"\.(json5?|py)$", name)}
    assert len(named) > 30
    for dotted in named:
        kind: type = Settings
        for key in dotted.split("."):
            fields = {field.name: field.type for field in msgspec.structs.fields(kind)}
            assert key in fields, dotted
            kind = fields[key]


def test_python_examples_compile():
    assert len(CODE) == 1
    for code in CODE:
        compile(code, "README.md", "exec")


def test_the_pictures_are_small():
    pictures = [(page, name) for page in PAGES for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())]
    assert len(pictures) > 15
    assert all((page.parent / picture).stat().st_size < 400_000 for page, picture in pictures)
