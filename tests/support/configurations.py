"""The shipped configurations, changed, for a file in any folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from gripmon.daemon.config import builtin_config


def shipped(name: str = "demo.yaml", *changes: tuple[str, str]) -> str:
    """Its text, with ``changes`` of what is in it."""
    path = builtin_config(name)
    text = path.read_text()
    for old, new in (("gripper: grippers/", f"gripper: {path.parent}/grippers/"), *changes):
        assert old in text, old
        text = text.replace(old, new)
    return text


def with_sections(text: str, **sections: str) -> str:
    """Each section, as YAML in one line, in place of the text's own."""
    for name, section in sections.items():
        text = re.sub(rf"(?ms)^{name}:.*?(?=^\w|\Z)", "", text) + f"{name}: {section}\n"
    return text


def demo_in(folder: Path, **sections: Any) -> Path:
    """A file of the demo's configuration with other sections."""
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(shipped()) | sections))
    return path
