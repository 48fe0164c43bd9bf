"""Lines of a step's output."""

from __future__ import annotations

from typing import Literal

import msgspec

from gripmon.model.errors import input_errors
from gripmon.model.units import jaw_range_in

Level = Literal["", "OK", "WARN", "FAIL"]


class Line(msgspec.Struct, frozen=True):
    """A line of a step's output."""

    text: str
    level: Level = ""


def jaws(text: str) -> Line:
    """The jaw range of an inferred gripper, in words."""
    if not text:
        return Line("no jaw range is given: the jaws are assumed never to move", "WARN")
    with input_errors("jaws move"):
        low_m, high_m = jaw_range_in(text)
    return Line(f"the jaws move from {1e3 * low_m:g} to {1e3 * high_m:g} mm", "OK")


def findings(found: list[dict[str, str]]) -> list[Line]:
    return [Line(f"{each['about']}: {each['text']}", each["level"]) for each in found]  # type: ignore[arg-type]


def last_line(text: str) -> str:
    """The last line of an error output, which is the message."""
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].removeprefix("gripmon: ") if lines else ""
