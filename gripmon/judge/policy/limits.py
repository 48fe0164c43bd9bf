"""When will a creep reach a limit?"""

from __future__ import annotations

import math

from gripmon.model.records import Array


def time_left_s(shift: Array, velocity: Array, limit_m: float, limit_rad: float) -> float | None:
    """Until the TCP's shift or the turn reaches its limit at this velocity (6,), both (6,); None if neither ever does.

    Zero if it is past a limit already.
    """
    left = [
        _time_to_radius(shift[part], velocity[part], limit)
        for part, limit in ((slice(0, 3), limit_m), (slice(3, 6), limit_rad))
    ]
    finite = [t for t in left if t is not None]
    return min(finite) if finite else None


def _time_to_radius(position: Array, velocity: Array, radius: float) -> float | None:
    """Smallest t >= 0 with ``|position + velocity t| = radius``, from inside; 0 from outside."""
    a, b, c = float(velocity @ velocity), float(position @ velocity), float(position @ position) - radius**2
    if c >= 0.0:
        return 0.0
    return None if a == 0.0 else (-b + math.sqrt(b * b - a * c)) / a
