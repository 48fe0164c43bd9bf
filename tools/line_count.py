"""``tools/lines``: lines of each room of gripmon, of the tests and of the tools; needs only Python and git.

Counted are Python, JavaScript, CSS, HTML and Jinja files, not data, documents and shell scripts.  Code is what remains
without blank lines, and without lines of which all is comment or docstring; a docstring is any string that stands as a
statement by itself.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tarfile
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, BESIDE = "gripmon", ("tests", "tools")

AIMS = {
    "model": 3600, "track": 4500, "belief": 2200, "judge": 3000, "monitor": 1500, "calibrate": 3900, "laser": 1700,
    "simulate": 3100, "io": 3200, "record": 2500, "client": 1500, "teach": 7800, "analyse": 3300, "daemon": 4500,
    "cli": 2700, PACKAGE: 49000, "tests": 32000, "tools": 8000,
}  # fmt: skip
"""Lines that the design aims at; a quarter more needs a reason."""

_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
}  # fmt: skip
_STRING = r'"(?:\\.|[^"\\\n])*"' + r"|'(?:\\.|[^'\\\n])*'" + r"|`(?:\\.|[^`\\])*`"
_BLOCK = r"/\*.*?\*/"
_COMMENTS = {
    ".js": re.compile(rf"{_STRING}|(?P<comment>//[^\n]*|{_BLOCK})", re.DOTALL),
    ".css": re.compile(rf"{_STRING}|(?P<comment>{_BLOCK})", re.DOTALL),
    ".html": re.compile(r"(?P<comment><!--.*?-->|\{#.*?#\})", re.DOTALL),
    ".j2": re.compile(r"(?P<comment><!--.*?-->|\{#.*?#\})", re.DOTALL),
}


@dataclass(frozen=True)
class Count:
    """Lines, and those with code; of files."""

    files: int = 0
    lines: int = 0
    code: int = 0

    def __add__(self, other: Count) -> Count:
        return Count(self.files + other.files, self.lines + other.lines, self.code + other.code)


@cache
def count(name: str, text: str) -> Count | None:
    """Of one file; None for a kind that isn't counted."""
    suffix = PurePosixPath(name).suffix
    if suffix == ".py":
        return Count(1, len(text.splitlines()), _python_code(text))
    if suffix not in _COMMENTS:
        return None
    left = _COMMENTS[suffix].sub(lambda found: "" if found["comment"] is not None else found[0], text)
    return Count(1, len(text.splitlines()), sum(bool(line.strip()) for line in left.splitlines()))


def _python_code(text: str) -> int:
    docstrings = {
        (node.value.lineno, node.value.col_offset)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    }
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE and token.start not in docstrings:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code)


def room_of(path: str) -> str | None:
    """``model`` for ``gripmon/model/…``, the package's own name for files beside its rooms; None: not counted."""
    first, *rest = PurePosixPath(path).parts
    if first == PACKAGE and rest:
        return rest[0] if len(rest) > 1 else f"{PACKAGE}/*"
    return first if first in BESIDE else None


def counts(files: Iterator[tuple[str, bytes]]) -> dict[str, Count]:
    """By room; and the package's sum."""
    rooms: dict[str, Count] = {}
    for path, content in files:
        room = room_of(path)
        found = None if room is None else count(path, content.decode(errors="replace"))
        if room is not None and found is not None:
            rooms[room] = rooms.get(room, Count()) + found
    inside = (found for room, found in rooms.items() if room not in BESIDE)
    return {**rooms, PACKAGE: sum(inside, Count())}


def files_here(root: Path) -> Iterator[tuple[str, bytes]]:
    """The checkout's files, also those not yet added."""
    listed = _git(root, "ls-files", "-z", "--cached", "--others", "--exclude-standard", PACKAGE, *BESIDE)
    for path in sorted(set(listed.decode().split("\0"))):
        if path and (root / path).is_file():
            yield path, (root / path).read_bytes()


def files_at(root: Path, revision: str) -> Iterator[tuple[str, bytes]]:
    """The files of a commit.  Raises ValueError for none."""
    try:
        commit = _git(root, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}").decode().strip()
    except subprocess.CalledProcessError:
        raise ValueError(f"--against {revision}: no commit of this checkout; a hash, a branch or a tag") from None
    there = _git(root, "ls-tree", "--name-only", commit).decode().split()
    packed = _git(root, "archive", commit, *(name for name in (PACKAGE, *BESIDE) if name in there))
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        for member in archive:
            if (content := archive.extractfile(member)) is not None:
                yield member.name, content.read()


def _git(root: Path, *arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, check=True).stdout


def table(now: dict[str, Count], before: dict[str, Count] | None) -> str:
    """Rooms by name, then the package, tests and tools; before and after where there is another commit."""
    rooms = sorted({*now, *(before or {}), *AIMS} - {PACKAGE, *BESIDE})
    heads = ["", "files", "lines", "code", "aim"]
    if before is not None:
        heads = ["", "files", "lines before", "now", "", "code before", "now", "", "aim"]
    rows = [heads]
    for room in [*rooms, PACKAGE, *BESIDE]:
        new, aim = now.get(room, Count()), AIMS.get(room)
        cells = [room, str(new.files)]
        if before is None:
            cells += [f"{new.lines:,}", f"{new.code:,}"]
        else:
            old = before.get(room, Count())
            for was, number in ((old.lines, new.lines), (old.code, new.code)):
                cells += [f"{was:,}", f"{number:,}", f"{number - was:+,}"]
        rows.append([*cells, "" if aim is None else f"{aim:,}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in rows
    )


def main(arguments: list[str], root: Path = ROOT) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="tools/lines", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", metavar="REV", help="also the lines of this commit, and the differences")
    against = parser.parse_args(arguments).against
    try:
        before = None if against is None else counts(files_at(root, against))
    except ValueError as error:
        print(f"tools/lines: {error}", file=sys.stderr)
        return 2
    print(table(counts(files_here(root)), before))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
