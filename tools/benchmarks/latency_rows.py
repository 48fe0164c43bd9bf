"""What ``tools/bench latency`` prints: a figure, its target, and whether that is met."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

_PART, _WHAT, _FIGURE, _TARGET = 11, 66, 14, 20
COUNTED = ("frames",)
"""Units of whole numbers."""


@dataclass(frozen=True)
class Row:
    """``value`` in ``unit`` and what it has to be: ``target`` at most, or ``at_least``; None: nothing is required.

    A row without a value was skipped, or could not be measured: ``note`` says why.
    """

    what: str
    value: float | None
    unit: str
    target: float | None = None
    at_least: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """None where nothing is required or nothing was measured."""
        if self.value is None or self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    @property
    def figure(self) -> str:
        return "skipped" if self.value is None else with_unit(self.value, self.unit)

    @property
    def required(self) -> str:
        if self.target is None:
            return ""
        return f"{'at least' if self.at_least else 'at most'} {with_unit(self.target, self.unit)}"

    @property
    def verdict(self) -> str:
        return {True: "met", False: "missed", None: ""}[self.met]


@dataclass(frozen=True)
class Measured:
    """What a part gave: its rows, and lines of text below them; plain values by :meth:`plain`."""

    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def plain(self) -> dict[str, Any]:
        return {"rows": [asdict(row) for row in self.rows], "notes": list(self.notes)}


def of_plain(measured: dict[str, Any]) -> Measured:
    """The reverse of :meth:`Measured.plain`."""
    return Measured(tuple(Row(**row) for row in measured["rows"]), tuple(measured["notes"]))


def skipped(what: str, why: str) -> Measured:
    return Measured((Row(what, None, "", note=why),))


def with_unit(value: float, unit: str) -> str:
    """Three digits, but counts as they are."""
    if unit in COUNTED:
        return f"{value:,.0f} {unit}"
    digits = f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return f"{digits} {unit}".rstrip()


def as_lines(part: str, measured: Measured) -> list[str]:
    """A part for the terminal."""
    lines = []
    for row in measured.rows:
        line = f"{part:{_PART}} {row.what:{_WHAT}}{row.figure:>{_FIGURE}}  {row.required:{_TARGET}}  {row.verdict:6}"
        lines.append(f"{line}  {row.note}".rstrip())
        part = ""
    return lines + [f"{'':{_PART}}   {note}" for note in measured.notes]
