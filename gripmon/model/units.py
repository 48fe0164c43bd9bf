"""Lengths and angles for people, with two significant digits: 0.61, 1.2, 340."""

from __future__ import annotations

import math


def in_mm(length_m: float) -> str:
    return two_digits(1e3 * length_m)


def in_degrees(angle_rad: float) -> str:
    return two_digits(math.degrees(angle_rad))


def two_digits(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"
