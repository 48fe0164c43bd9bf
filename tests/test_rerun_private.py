"""rerun without the parts that it doesn't call public: they go with any version."""

from __future__ import annotations

import re
from pathlib import Path

GRIPMON = Path(__file__).resolve().parent.parent / "gripmon"


def test_none_is_used():
    private = re.compile(r"\brr\.bindings|rerun_bindings|\._chunk_index|rerun\.\w*\._|rerun\._")
    assert not [path.name for path in GRIPMON.rglob("*.py") if private.search(path.read_text())]
