"""Numbers, times and sizes as a report has them for people: millimetres, degrees, UTC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

from gripmon.model.units import FIRST_YEAR_NS

COVERAGE = 2.0
"""Standard deviations of a frame's noise that count as significant, decide the digits and make the curves' bands."""


def clock_time(stamp_ns: int, digits: int = 1) -> str:
    """``12:34:56.7``, UTC, truncated, so that no time is shown after the event."""
    whole, part = divmod(stamp_ns, 1_000_000_000)
    return f"{_at(whole):%H:%M:%S}" + (f".{part:09d}"[: digits + 1] if digits else "")


def date(stamp_ns: int) -> str:
    """``2026-11-21``, UTC."""
    return f"{_at(stamp_ns // 1_000_000_000):%Y-%m-%d}"


def period(start_ns: int, end_ns: int) -> str:
    """``2026-11-21, 12:34:56 to 12:34:58 UTC``; images without time stamps count from 0, which is not a date."""
    times = f"{clock_time(start_ns, 0)} to {clock_time(end_ns, 0)}"
    if 0 <= start_ns < FIRST_YEAR_NS:
        return f"{times} by a clock that began with the images, or with 1970"
    return f"{date(start_ns)}, {times} UTC"


def iso(stamp_ns: int) -> str:
    """``2026-11-21T12:34:56.789Z``."""
    return f"{date(stamp_ns)}T{clock_time(stamp_ns, 3)}Z"


def _at(seconds: int) -> datetime:
    """Years outside the calendar are clipped to it."""
    return datetime.fromtimestamp(min(max(seconds, -62_135_596_800), 253_402_300_799), UTC)


def duration(seconds: float) -> str:
    """A duration in the two units that fit."""
    if seconds < 0.0995:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    if (whole := round(seconds)) < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if (minutes := round(seconds / 60.0)) < 1440:
        return f"{minutes // 60} h {minutes % 60} min"
    hours = round(seconds / 3600.0)
    return f"{hours // 24} d {hours % 24} h"


def span(start_ns: int, end_ns: int) -> str:
    """How long from one time to another."""
    return duration(1e-9 * (end_ns - start_ns))


def millimetres(metres: float, sigma_m: float | None = None) -> str:
    """``4.21 mm``: two standard deviations of the frames' noise determine the digits.  They aren't shown as ±: light
    and bevels, which they leave out, may shift a measurement by more.
    """
    return f"{_digits(1e3 * metres, 1e3 * (sigma_m or 0.0))} mm" if math.isfinite(metres) else "unknown"


def degrees(radians: float | None, sigma_rad: float | None = None) -> str:
    """``1.63°``, digits as :func:`millimetres`."""
    if radians is None or not math.isfinite(radians):
        return "unknown"
    return f"{_digits(math.degrees(radians), math.degrees(sigma_rad or 0.0))}°"


def _digits(value: float, sigma: float) -> str:
    if not 0.0 < sigma < math.inf:
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    digits = -math.floor(math.log10(COVERAGE * sigma))  # the spread's first digit is the last one shown
    return f"{value:.{min(max(digits, 0), 4)}f}"


def signed_mm(values_m: Sequence[float]) -> str:
    """``+1.178 +0.389 +0.040``."""
    return " ".join(f"{1e3 * value:+.3f}".replace("-", "−") for value in values_m)


def percent(share: float) -> str:
    """Per cent; a fraction between 0 and 1 is never shown as 0 or 100 %."""
    text = f"{100.0 * share:.1f}"
    if text == "100.0" and share < 1.0:
        return "> 99.9 %"
    if text == "0.0" and share > 0.0:
        return "< 0.1 %"
    return f"{text.removesuffix('.0')} %"


def rate(per_s: float) -> str:
    return f"{per_s:.1f} frames/s"


def count(number: int, one: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {one if number == 1 else one + 's'}"


def often(number: int) -> str:
    return {0: "no", 1: "once", 2: "twice"}.get(number, f"{number} times")


def listed(parts: Sequence[str]) -> str:
    """``a, b and c``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
