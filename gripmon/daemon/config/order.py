"""Pairs of settings of which one can't lie beyond the other."""

from __future__ import annotations

import functools
from typing import NamedTuple

from gripmon.daemon.config.settings import Settings
from gripmon.daemon.config.typed import Fault
from gripmon.io.sources import LiveSettings


class _Pair(NamedTuple):
    """``lower`` and ``upper`` are keys of one section; ``why`` the first may be at most as large as the second."""

    section: str
    lower: str
    upper: str
    why: str


_WARNS_FIRST = "a drift is a warning before it is an error"
_GROWS = "the pauses grow from the one to the other"
_PAIRS = (
    _Pair("monitor.policy", "warn_m", "limit_m", _WARNS_FIRST),
    _Pair("monitor.policy", "warn_rad", "limit_rad", _WARNS_FIRST),
    _Pair("monitor.recalibration", "frames", "most_frames", "the fewest frames that are averaged and the most"),
    _Pair("monitor.recalibration", "sure_sigma_m", "largest_sigma_m", "an operator is asked before it is refused"),
    _Pair("publish", "retry_first_s", "retry_longest_s", _GROWS),
)
_OF_A_CAMERA = (_Pair("source", "retry_first_s", "retry_longest_s", _GROWS),)


def order_fault(settings: Settings) -> Fault | None:
    """The first pair that is in the wrong order."""
    for pair in _PAIRS + _OF_A_CAMERA * isinstance(settings.source, LiveSettings):
        section = functools.reduce(getattr, pair.section.split("."), settings)
        lower, upper = getattr(section, pair.lower), getattr(section, pair.upper)
        if lower > upper:
            right = f"at most {pair.upper}, or a larger {pair.upper}: {pair.why}"
            return Fault(f"{pair.section}.{pair.lower}", f"{lower:g} is above {pair.upper}, {upper:g}", right)
    return None
