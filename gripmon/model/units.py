"""Lengths and angles for people, with two significant digits (0.61, 1.2, 340); times; jaw openings as typed."""

from __future__ import annotations

import math
from datetime import UTC, datetime

FIRST_YEAR_NS = 365 * 86_400 * 1_000_000_000
"""Images without time stamps count from 0: below this a stamp is not a date."""


def in_time(stamp_ns: int) -> str:
    """``2026-11-21 12:34:56 UTC``, truncated; ``5.0 s of the images' clock`` where that counts from 0."""
    if 0 <= stamp_ns < FIRST_YEAR_NS:
        return f"{stamp_ns // 100_000_000 / 10:.1f} s of the images' clock"
    return f"{datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M:%S} UTC"


def in_mm(length_m: float) -> str:
    return two_digits(1e3 * length_m)


def in_degrees(angle_rad: float) -> str:
    return two_digits(math.degrees(angle_rad))


def two_digits(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"


def jaw_opening_in(text: str) -> float:
    """A jaw opening, m, 0 to 0.5; ValueError says what would be right."""
    try:
        value_m = float(text)
    except ValueError:
        value_m = math.nan
    if not 0.0 <= value_m <= 0.5:
        raise ValueError(f"'{text}' isn't a jaw opening (millimetres?); metres, 0 to 0.5")
    return value_m


def jaw_range_in(text: str) -> tuple[float, float]:
    """MIN:MAX of jaw openings, m; ValueError says what would be right."""
    low, colon, high = text.partition(":")
    if not colon:
        raise ValueError(f"'{text}' isn't a range; MIN:MAX in metres, e.g. 0:0.06")
    ends_m = jaw_opening_in(low), jaw_opening_in(high)
    if not ends_m[0] < ends_m[1]:
        raise ValueError(f"'{text}' doesn't ascend; MIN:MAX in metres, e.g. 0:0.06")
    return ends_m
