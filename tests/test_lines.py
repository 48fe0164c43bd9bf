"""``tools/lines`` against files whose lines were counted by hand."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent

PYTHON = '''\
"""What the module is for.

Two paragraphs of it."""

from __future__ import annotations

import math  # a comment beside code is code

LIMIT = 3.0
"""What follows a constant is a docstring, too."""
TEXT = """A text that is used,

# with a line that looks like a comment,
and an empty one."""


# A comment.
def area(radius_m: float) -> float:
    """One line."""
    return (
        math.pi
        # in between
        * radius_m**2
    )


def named(name: str) -> str:
    'Quoted otherwise.'

    return f"""
{name}
"""
'''
PYTHON_LINES, PYTHON_CODE = 32, 16

JAVASCRIPT = """\
// What it does.
/* and more,

   over lines */
const here = "http://a.b/*c"; // an address

function f() {
  /* alone */
  return `a // b
  /* not a comment */` /* beside */
}
"""
JAVASCRIPT_LINES, JAVASCRIPT_CODE = 11, 5

CSS = """\
/* Colours */
a { color: red; } /* of links */

b::after { content: "/*"; }
"""
CSS_LINES, CSS_CODE = 4, 2

HTML = """\
<!DOCTYPE html>
<!-- what it is,
     in words -->
{# a note #}

<p>Text <!-- beside --></p>
"""
HTML_LINES, HTML_CODE = 6, 2


@pytest.fixture(scope="module")
def counting() -> ModuleType:
    spec = spec_from_file_location("line_count", ROOT / "tools" / "line_count.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("name", "text", "lines", "code"),
    [
        ("a.py", PYTHON, PYTHON_LINES, PYTHON_CODE),
        ("a.js", JAVASCRIPT, JAVASCRIPT_LINES, JAVASCRIPT_CODE),
        ("a.css", CSS, CSS_LINES, CSS_CODE),
        ("a.html", HTML, HTML_LINES, HTML_CODE),
        ("a.txt.j2", HTML, HTML_LINES, HTML_CODE),
        ("empty/__init__.py", "", 0, 0),
    ],
)
def test_lines_and_code_as_counted_by_hand(counting: ModuleType, name: str, text: str, lines: int, code: int):
    found = counting.count(name, text)
    assert (found.files, found.lines, found.code) == (1, lines, code)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with one commit, and more in its folder."""

    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

    def write(path: str, text: str) -> None:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)

    git("init")
    write("gripmon/__init__.py", PYTHON)
    write("gripmon/model/gripper/shape.py", PYTHON)
    write("gripmon/model/old.js", JAVASCRIPT)
    write("gripmon/model/data.yaml", "a: 1\n")
    write("docs/examples/a.py", PYTHON)
    write("tools/a.py", PYTHON)
    write(".gitignore", "ignored.py\n")
    git("add", ".")
    git("commit", "-m", "first")
    (tmp_path / "gripmon/model/old.js").unlink()
    write("gripmon/model/new.py", PYTHON)
    write("gripmon/model/ignored.py", PYTHON)
    write("gripmon/belief/page.html", HTML)
    return tmp_path


def table(
    counting: ModuleType, root: Path, capsys: pytest.CaptureFixture[str], *arguments: str
) -> dict[str, list[str]]:
    assert counting.main(list(arguments), root) == 0
    rows = (line.split() for line in capsys.readouterr().out.splitlines()[1:])
    return {room: cells for room, *cells in rows}


def test_rooms_of_the_folder_as_it_is(counting: ModuleType, checkout: Path, capsys: pytest.CaptureFixture[str]):
    rows = table(counting, checkout, capsys)
    assert rows["model"][:3] == ["2", str(2 * PYTHON_LINES), str(2 * PYTHON_CODE)]  # what git ignores isn't counted
    assert rows["belief"][:3] == ["1", str(HTML_LINES), str(HTML_CODE)]
    assert rows["gripmon/*"] == ["1", str(PYTHON_LINES), str(PYTHON_CODE)]
    assert rows["gripmon"][:3] == ["4", str(3 * PYTHON_LINES + HTML_LINES), str(3 * PYTHON_CODE + HTML_CODE)]
    assert rows["tools"][:3] == ["1", str(PYTHON_LINES), str(PYTHON_CODE)]
    assert rows["tests"][:3] == ["0", "0", "0"]
    assert rows["model"][3] == "3,600"


def test_the_rooms_aims_are_the_packages(counting: ModuleType):
    beside = ("gripmon", "tests", "tools")
    assert sum(aim for room, aim in counting.AIMS.items() if room not in beside) == counting.AIMS["gripmon"]
