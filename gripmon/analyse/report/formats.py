"""Numbers and times for people: millimetres, degrees, UTC."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from gripmon.analyse.report.content import Displacement

COVERAGE = 2.0
"""Standard deviations that a ± stands for."""


_FIRST_YEAR_NS = 365 * 86_400 * 1_000_000_000


def clock_time(stamp_ns: int, digits: int = 1) -> str:
    """``12:34:56.7``, UTC, cut, not rounded: no such time lies after the event."""
    whole, part = divmod(stamp_ns, 1_000_000_000)
    return f"{_at(whole):%H:%M:%S}" + (f".{part:09d}"[: digits + 1] if digits else "")


def date(stamp_ns: int) -> str:
    """``2026-11-21``, UTC."""
    return f"{_at(stamp_ns // 1_000_000_000):%Y-%m-%d}"


def period(start_ns: int, end_ns: int) -> str:
    """``2026-11-21, 12:34:56 to 12:34:58 UTC``; images without time stamps count from 0, which is no date."""
    times = f"{clock_time(start_ns, 0)} to {clock_time(end_ns, 0)}"
    if 0 <= start_ns < _FIRST_YEAR_NS:
        return f"{times} by a clock that began with the images, or with 1970"
    return f"{date(start_ns)}, {times} UTC"


def iso(stamp_ns: int) -> str:
    """``2026-11-21T12:34:56.789Z``."""
    return f"{date(stamp_ns)}T{clock_time(stamp_ns, 3)}Z"


def _at(seconds: int) -> datetime:
    """Years that the calendar doesn't have are shown as its ends."""
    return datetime.fromtimestamp(min(max(seconds, -62_135_596_800), 253_402_300_799), UTC)


def duration(seconds: float) -> str:
    """In the two units that fit."""
    if seconds < 0.0995:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    minutes = round(seconds / 60.0)
    if minutes < 1440:
        return f"{minutes // 60} h {minutes % 60} min"
    hours = round(seconds / 3600.0)
    return f"{hours // 24} d {hours % 24} h"


def span(start_ns: int, end_ns: int) -> str:
    """How long from one time to another."""
    return duration(1e-9 * (end_ns - start_ns))


def millimetres(metres: float, sigma_m: float | None = None) -> str:
    """``4.21 ± 0.02 mm``: ± is two standard deviations, and says how many digits there are."""
    if not math.isfinite(metres):
        return "unknown"
    return f"{_measured(1e3 * metres, None if sigma_m is None else 1e3 * sigma_m)} mm"


def degrees(radians: float | None, sigma_rad: float | None = None) -> str:
    """``1.63 ± 0.04°``."""
    if radians is None or not math.isfinite(radians):
        return "unknown"
    sigma = None if sigma_rad is None else math.degrees(sigma_rad)
    return f"{_measured(math.degrees(radians), sigma)}°"


def size(moved: Displacement | None) -> str:
    """Both of a displacement."""
    if moved is None:
        return "–"
    text = millimetres(moved.size_m, moved.sigma_m)
    if moved.rotation_rad is None:
        return text
    return f"{text}, {degrees(moved.rotation_rad, moved.rotation_sigma_rad)}"


def signed_mm(values_m: tuple[float, float, float]) -> str:
    """``+1.178 +0.389 +0.040``."""
    return " ".join(f"{1e3 * value:+.3f}".replace("-", "−") for value in values_m)


def percent(share: float) -> str:
    """A share that isn't whole is never shown as 0 or 100 %."""
    text = f"{100.0 * share:.1f}"
    if text == "100.0" and share < 1.0:
        return "> 99.9 %"
    if text == "0.0" and share > 0.0:
        return "< 0.1 %"
    return f"{text.removesuffix('.0')} %"


def count(number: int, one: str, many: str | None = None) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def _measured(value: float, sigma: float | None) -> str:
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    spread = COVERAGE * sigma
    digits = min(max(1 - math.floor(math.log10(spread)), 0), 4) if spread < 10.0 else 0
    digits = (
        digits - 1 if digits > 1 and round(spread, digits - 1) > 0.0 and spread * 10 ** (digits - 1) >= 2.0 else digits
    )
    return f"{value:.{digits}f} ± {spread:.{digits}f}"
