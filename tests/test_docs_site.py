"""The documentation as a site: generated pages are complete, names exist, the words are the field's."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from gripmon.daemon.config.settings import Settings

pytestmark = pytest.mark.usefixtures("tools_importable")

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
WRITTEN = [page for page in PAGES if page.parent.name != "results"] + [ROOT / "README.md"]
DIALECT = re.compile(
    r"\b(?:is|are|was|were|be) (?:told|said)\b|\bforet[eo]l|\banew\b|\bso many\b|\bnobody\b|\bit is no\b"
    r"|contradict each other",
    re.IGNORECASE,
)


def _help(*words: str) -> str:
    command = [sys.executable, "-m", "gripmon", *words, "--help"]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout


def test_every_command_has_its_help_on_the_page():
    from pages import commands

    page = commands.page()
    listed = _help().split("start:")[1].split("options:")[0]
    names = re.findall(r"^  ([a-z]+)(?: |$)", listed, re.MULTILINE)
    below = re.findall(r"^    ([a-z-]+)(?: |$)", _help("calibrate").partition("\n\n")[2], re.MULTILINE)
    assert len(names) >= 17 and len(below) >= 7
    for name in [f"gripmon {name}" for name in names] + [f"gripmon calibrate {name}" for name in below]:
        assert re.search(rf"^##+ {name}\n\n```text\nusage: {name} ", page, re.MULTILINE), name


def _keys(section: Any, prefix: str = "") -> Iterator[str]:
    for key, value in section.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{key}.")


def test_every_key_of_a_configuration_is_on_the_page():
    """By the JSON Schema of the settings, and by every shipped file: both know nothing of how the page is made."""
    import msgspec
    from pages import configuration

    page = configuration.page()
    schema = json.dumps(msgspec.json.schema(Settings))
    properties = {key for node in _objects(json.loads(schema)) for key in node.get("properties", ())}
    assert len(properties) > 130
    shown = set(re.findall(r"^\| `([\w.]+)` \|", page, re.MULTILINE))
    headings = set(re.findall(r"^##+ `([\w.]+)", page, re.MULTILINE))
    assert properties <= {part for path in shown | headings for part in path.split(".")}
    for path in (ROOT / "configs").glob("*.yaml"):
        assert set(_keys(yaml.safe_load(path.read_text()))) <= shown | headings, path


def _objects(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        yield node
    for below in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from _objects(below)


def test_a_row_of_the_configuration_says_unit_default_and_bounds():
    from pages import configuration

    rows = configuration.page().splitlines()
    (row,) = [row for row in rows if row.startswith("| `monitor.policy.alert_limit_rad` |")]
    assert row.startswith("| `monitor.policy.alert_limit_rad` | number | rad | `0.035` | > 0")
    assert sum(row.startswith("| `source.kind` |") for row in rows) == 8  # one table for each kind


def test_what_the_explanations_name_exists():
    """Every dotted name in Method and Architecture: a module, or what can be reached from one."""
    text = "".join((DOCS / "explanation" / f"{name}.md").read_text() for name in ("method", "architecture"))
    names = set(re.findall(r"`(gripmon(?:\.\w+)+)`", text))
    assert len(names) > 40
    for name in sorted(names):
        _reach(name)


def _reach(name: str) -> object:
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            assert hasattr(found, attribute), name
            found = getattr(found, attribute)
        return found
    raise AssertionError(name)


def test_every_equation_of_both_methods_has_a_function():
    first, second = (DOCS / "explanation" / "method.md").read_text().split("\n## B. ")
    assert _numbers(first) == set(range(1, 18))
    assert _numbers(second) >= {1, 2, *range(7, 36)}


def _numbers(text: str) -> set[int]:
    found: set[int] = set()
    for cell in re.findall(r"^\| (\([^|]+) \|[^|]*\| `gripmon", text, re.MULTILINE):
        ends = [int(number) for number in re.findall(r"\((\d+)\)", cell)]
        found |= set(range(ends[0], ends[-1] + 1)) if " to " in cell else set(ends)
    return found


def test_the_drawing_has_every_room_and_no_circle():
    from pages import rooms

    graph = rooms.imports()
    folders = {path.parent.name for path in (ROOT / "gripmon").glob("*/__init__.py")}
    assert folders <= set(graph) and graph["model"] == set() and "io" in graph["client"]
    heights = rooms.floors(graph)
    assert all(heights[below] < heights[room] for room, lower in graph.items() for below in lower)
    drawing = rooms.svg()
    assert all(f">{room}</text>" in drawing for room in graph)
    with pytest.raises(ValueError, match=r"circle: \['a', 'b'\]"):
        rooms.floors({"a": {"b"}, "b": {"a"}, "c": set()})
    assert rooms.direct({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == {"a": {"b"}, "b": {"c"}, "c": set()}


def test_every_page_of_results_names_the_commit_of_its_figures():
    for page in DOCS.glob("results/*.md"):
        assert re.search(r"commits? `?[0-9a-f]{7,}|gripmon [0-9a-f]{10}", page.read_text()), page.name


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.name)
def test_the_words_are_those_of_the_field(page: Path):
    assert [match[0] for match in DIALECT.finditer(" ".join(page.read_text(encoding="utf-8").split()))] == []


def test_files_that_pages_name_exist():
    for page in [*PAGES, ROOT / "README.md"]:
        named = set(re.findall(r"(?<![\w/.-])((?:configs|tools|tests|docs)/[\w./@-]*\w)(?![\w*])", page.read_text()))
        missing = {path for path in named if not (ROOT / path).exists() and "configs/zenoh/certificates" not in path}
        assert missing == set(), page.name


def test_a_page_that_needs_the_internet_is_found():
    pytest.importorskip("mkdocs")
    from mkdocs_hook import loaded_from_elsewhere

    loading = [
        '<link href="https://fonts.example/css" rel="stylesheet">',
        '<link rel="preconnect" href="//fonts.example/css">',
        '<script async src="https://fonts.example/css"></script>',
        '<img alt="" src=https://fonts.example/css>',
        "a{background:url(https://fonts.example/css)}",
        '@import "https://fonts.example/css";',
    ]
    assert [len(loaded_from_elsewhere(text)) for text in loading] == [1] * 6
    assert all(loaded_from_elsewhere(text)[0].endswith("//fonts.example/css") for text in loading)
    here = '<a href="https://zenoh.io">Zenoh</a><img src="demo.jpg"><link rel="stylesheet" href="../wide.css">'
    assert loaded_from_elsewhere(here) == []
