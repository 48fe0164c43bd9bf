"""The one exception of configuration."""

from __future__ import annotations

from pathlib import Path

from gripmon.model.errors import InputError


class ConfigError(InputError):
    """A configuration that can't be used; ``str()`` is one line ``file: key: what is wrong; what would be right``."""

    def __init__(self, path: Path | str, key: str, wrong: str, right: str = ""):
        parts = [str(path), key, f"{wrong}; {right}" if right else wrong]
        super().__init__(" ".join(": ".join(part for part in parts if part).split()))
