"""Results as text for a person, from the values that ``--json`` prints: a line a value, a table for rows of a kind.

A key's ending is its value's unit: ``_m`` is shown in mm, ``_rad`` in degrees.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_UNITS = {
    "_m": (1e3, " mm"), "_rad": (math.degrees(1.0), "°"), "_px": (1.0, " px"), "_s": (1.0, " s"),
}  # fmt: skip
_NO_UNIT = (1.0, "")
_OF = {"_m": "of position", "_rad": "of rotation"}
_WORDS = {"tcp": "TCP", "rms": "RMS"}
_NOTHING = "-"
_LONGEST = 110
"""Characters of a line up to which the values of a mapping share it."""
_MOST = 20
"""Numbers of a list that a person may read in a line; a covariance has 36."""


def lines(values: Mapping[str, Any]) -> list[str]:
    """A line a value; a mapping's values in one line if they fit, otherwise indented below its name; lists of mappings
    with equal keys as tables.
    """
    return _section(values, "", _NO_UNIT)


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Rows with the same keys, below a head of the keys and their units."""
    if not rows:
        return []
    head = [f"{named(key)} {_unit(key)[1].strip()}".strip() for key in rows[0]]
    return columns([head, *([_cell(value, _unit(key)[0]) for key, value in row.items()] for row in rows)])


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Aligned columns below their heads, the first row; numbers to the right."""
    turned = list(zip(*rows, strict=True))
    aligned = [
        [text.rjust(width) if numbers else text.ljust(width) for text in column]
        for column in turned
        for width, numbers in [(max(map(len, column)), all(map(_is_number, column[1:])))]
    ]
    return ["  ".join(row).rstrip() for row in zip(*aligned, strict=True)]


def named(key: str) -> str:
    """A key in words, without its unit: ``field_of_view_rad`` is "field of view", ``m`` nothing."""
    words = f"_{key}".removesuffix(_ending(key)).removeprefix("_").split("_")
    return " ".join(_WORDS.get(word, word) for word in words)


def amount(key: str, value: float) -> str:
    """A single value of a key with its unit."""
    factor, unit = _unit(key)
    return _cell(value, factor) + unit


def _names(keys: Iterable[str]) -> dict[str, str]:
    """Keys in words; of those whose words are the same, a length is the position's and an angle the rotation's."""
    words = {key: named(key) for key in keys}
    twice = {word for word, count in Counter(words.values()).items() if word and count > 1}
    return {k: f"{word} {_OF.get(_ending(k), '')}".strip() if word in twice else word for k, word in words.items()}


def _section(values: Mapping[str, Any], indent: str, unit: tuple[float, str]) -> list[str]:
    out: list[str] = []
    short = {key: text for key, value in values.items() if (text := _short(key, value, unit)) is not None}
    names = _names(values)
    width = max((len(names[key]) for key in short), default=0)
    for key, value in values.items():
        if key in short:
            out.append(f"{indent}{names[key]:<{width}}  {short[key]}")
            continue
        out.append(f"{indent}{names[key]}")
        if isinstance(value, Mapping):
            out += _section(value, f"{indent}  ", _unit(key, unit))
        else:
            rows = table(value) if isinstance(value[0], Mapping) else map(_cell, value)
            out += (f"{indent}  {row}" for row in rows)
    return out


def _short(key: str, value: Any, outer: tuple[float, str]) -> str | None:
    """The value in one line, with its unit, which may be that of the mapping around it; None if that is too long."""
    unit = _unit(key, outer)
    if isinstance(value, Mapping) and value:
        inside = {each: _short(each, of, unit) for each, of in value.items() if not isinstance(of, Mapping)}
        names = _names(inside)
        text = ", ".join(f"{names[each]} {of}".strip() for each, of in inside.items())
        return text if len(inside) == len(value) and None not in inside.values() and len(text) <= _LONGEST else None
    if isinstance(value, list | tuple) and any(isinstance(each, Mapping) or " " in str(each) for each in value):
        return None
    if isinstance(value, list | tuple) and len(value) > _MOST:
        return f"{len(value)} numbers, in --json"
    text = _cell(value, unit[0])
    return text if text.strip("- ") == "" or isinstance(value, bool | str) else text + unit[1]


def _cell(value: Any, factor: float = 1.0) -> str:
    """A value as text, in its shown unit by ``factor``; numbers with four digits, whole ones with all."""
    if value is None or value in ("", [], (), {}):
        return _NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        if isinstance(value, int) and factor == 1.0:
            return str(value)
        shown = factor * value + 0.0
        return f"{shown:.0f}" if 1e4 <= abs(shown) < 1e7 else f"{shown:.4g}"
    if isinstance(value, str):
        return value
    return " ".join(_cell(each, factor) for each in value)


def _ending(key: str) -> str:
    """A key's unit; of a rate, such as ``frames_per_s``, it is said in words."""
    return "" if "_per_" in key else next((ending for ending in _UNITS if f"_{key}".endswith(ending)), "")


def _unit(key: str, outer: tuple[float, str] = _NO_UNIT) -> tuple[float, str]:
    return _UNITS.get(_ending(key), outer)


def _is_number(text: str) -> bool:
    try:
        return text == _NOTHING or math.isfinite(float(text))
    except ValueError:
        return False
