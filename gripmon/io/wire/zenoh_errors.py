"""Zenoh's error messages in words for a person."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh


_SOURCE_PLACE = re.compile(r"\s+at \S+\.rs:\d+\.?")
_PARSER = re.compile(r"\s*--> (?P<line>\d+):(?P<column>\d+)\n.*\n\s*= (?P<text>.*)", re.DOTALL)
_MESSAGE = re.compile(
    r'.*?(?:Message \{ msg: |Error\()"(?P<text>(?:[^"\\]|\\.)*)"'
    r"(?:.*?line: (?P<line>\d+), column: (?P<column>\d+))?.*",
    re.DOTALL,
)
_SCANNER = re.compile(
    r'.*Error \{.* problem: "(?P<text>(?:[^"\\]|\\.)*)".*problem_mark: Mark \{ line: (?P<line>\d+), '
    r"column: (?P<column>\d+) \}.*",
    re.DOTALL,
)
_UNREACHED = re.compile(r"Unable to connect to any of \[(?P<ends>.*)\]")
_ENCRYPTED = ("tls/", "quic/")


def in_short(error: zenoh.ZError) -> str:
    """Zenoh's message on one line: ``line 3, column 5: what is wrong`` for a file, without its own data structures and
    the places in its source files.
    """
    text = _SOURCE_PLACE.sub("", str(error))
    for form in (_PARSER, _SCANNER, _MESSAGE):
        if found := form.fullmatch(text):
            place = f"line {found['line']}, column {found['column']}: " if found["line"] else ""
            said = re.sub(r"expected struct \w+", "a mapping was expected", found["text"].replace('\\"', '"'))
            return place + " ".join(said.split())
    if found := _UNREACHED.search(text):
        return _unreached(found["ends"])
    return " ".join(text.split())


def _unreached(ends: str) -> str:
    """Whom there is no connection to, and what may be the reason: Zenoh says the same of all of them."""
    endpoints = re.findall(r"Single\((.*?)\)(?=, |$)", ends) or [ends]
    reason = "nobody listens there"
    if any(endpoint.startswith(_ENCRYPTED) for endpoint in endpoints):
        reason += (
            ", or the certificates don't fit: of another authority, expired, or the router's is not for this address"
        )
    return f"no connection to {' or '.join(endpoints)} ({reason})"
