"""One page of ``tools/bench integrity``: a line for each condition, beside the same scenes of another revision."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.integrity_stats import collect, figures
from benchmarks.integrity_table import aligned, knock, number, percent

_HEAD = ("frames", "> AL", "> PL", "err/PL", "asked %", "valid %", "PL mm", "first", "knock")
LEGEND = """\
> AL, > PL: valid frames beyond the alert limit, beyond their bound; err/PL: the largest of valid frames
asked %: valid of those that show enough; valid %: of all; PL mm: median of valid frames
first: median of frames until the first valid; knock: medians of frames until it is said, until it is found, and from
then until valid (x: never)"""
_GREY_DN = 0.05
"""By how much the mean grey of the first image may differ where two runs saw the same scene."""


def as_text(lines: list[dict[str, Any]], others: list[dict[str, Any]]) -> str:
    """The table.  With ``others`` each cell is theirs, an arrow, and ours, of the scenes that both have."""
    if not others:
        return "\n".join(["", aligned([["condition", *_HEAD], *_rows(lines)]), LEGEND])
    ours, theirs = _shared(lines, others)
    if not ours:
        return "\nno scene of the other file is among these: the same --seed, --frames and conditions"
    rows = [
        [name, *(_beside(before, after) for before, after in zip(there, here, strict=True))]
        for (name, *here), (_, *there) in zip(_rows(ours), _rows(theirs), strict=True)
    ]
    here, there = collect(ours).valid, collect(theirs).valid
    left_out = len(lines) - len(ours)
    counts = [int(which.sum()) for which in (here & there, there & ~here, here & ~there, ~here & ~there)]
    parts = [
        "",
        f"{_named(theirs)} → {_named(ours)}, seed {ours[0]['seed']}, {len(ours)} scenes of both",
        aligned([["condition", *_HEAD], *rows]),
        LEGEND,
        "valid in both {}, only before {}, only after {}, in neither {}".format(*counts),
    ]
    strange = [one for one, other in zip(ours, theirs, strict=True) if not _same_scene(one, other)]
    if strange:
        parts.append(f"NOT THE SAME images or limits in {len(strange)} scenes, the first: {strange[0]['condition']}")
    return "\n".join([*parts, *([f"{left_out} scenes only here"] if left_out else [])])


def _shared(
    lines: list[dict[str, Any]], others: list[dict[str, Any]]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The scenes that both have, in the order of the first."""
    there = {_key(line): line for line in others}
    ours = [line for line in lines if _key(line) in there]
    return ours, [there[_key(line)] for line in ours]


def _key(line: dict[str, Any]) -> tuple[Any, ...]:
    return line["condition"], line["scene"], line["seed"], line["asked"]


def _same_scene(one: dict[str, Any], other: dict[str, Any]) -> bool:
    limits = all(math.isclose(one[key], other[key], rel_tol=1e-6) for key in ("limit_m", "limit_rad"))
    return limits and abs(one["grey_dn"] - other["grey_dn"]) <= _GREY_DN


def _named(lines: list[dict[str, Any]]) -> str:
    return ", ".join(sorted({line["commit"] for line in lines}))


def _beside(before: str, after: str) -> str:
    return before if before == after else f"{before} → {after}"


def _rows(lines: list[dict[str, Any]]) -> list[list[str]]:
    """A row a condition, and one of all."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        by_name.setdefault(line["condition"], []).append(line)
    return [_row(name, own) for name, own in by_name.items()] + [_row("all", lines)]


def _row(name: str, lines: list[dict[str, Any]]) -> list[str]:
    row = figures(lines)
    level_m = row["median_level_m"]
    return [
        name,
        str(row["frames"]),
        str(row["lies"]),
        str(row["unbounded"]),
        number(row["worst_excess"]),
        percent(row["asked_share"]),
        percent(row["valid_share"]),
        "–" if level_m is None else f"{1e3 * level_m:.3g}",
        "never" if np.isinf(row["first_valid"]) else f"{row['first_valid']:g}",
        knock(row),
    ]
