"""The worked examples of ``docs/examples`` as one page: the text of each, then its code."""

from __future__ import annotations

import ast
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "examples"

_HEAD = """\
# Worked examples

Programs for a notebook or a script, as they lie in `docs/examples/`; the tests run them.
"""


def page() -> str:
    """The page in Markdown."""
    return "\n".join([_HEAD, *map(_section, sorted(FOLDER.glob("*.py")))])


def _section(path: Path) -> str:
    source = path.read_text(encoding="utf-8")
    about = (ast.get_docstring(ast.parse(source)) or "").replace("``", "`")
    return f"## {path.stem.replace('_', ' ').capitalize()}\n\n{about}\n\n```python\n{source.rstrip()}\n```\n"
