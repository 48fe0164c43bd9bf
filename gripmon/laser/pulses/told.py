"""A pulse as it was told, checked: by the robot's program, or by a row of a table."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from gripmon.calibrate.tables import Row, check_scale, pose_of
from gripmon.model.records import Array, LaserPulse

LONGEST_S = 60.0
"""Nobody holds an arm still for so long to show a spot: such stamps are of two clocks, or of another unit."""

_NS = 1_000_000_000
_LAST_NS = 2**63 - 1


class Told(NamedTuple):
    """The laser was on, and the hand stood still at ``base_T_ee`` (4, 4), between two stamps (ns)."""

    stamp_ns: int
    until_ns: int
    base_T_ee: Array


def of_message(pulse: LaserPulse) -> Told:
    """ValueError: "what is wrong; what would be right"."""
    pose = pulse.base_T_ee
    row = {
        "base_T_ee": {"translation_m": list(pose.translation_m), "rotation_xyzw": list(pose.rotation_xyzw)},
    }
    return _checked(pulse.stamp_ns, pulse.until_ns, row, "the pulse")


def of_rows(rows: Sequence[Row], places: Sequence[str]) -> list[Told]:
    """A table's, by their stamps.  ValueError: "place: what is wrong; what would be right"."""
    if not rows:
        raise ValueError("holds no pulse; a header line, then a line for each pulse")
    told = [
        _checked(_stamp(row, "stamp_ns", place), _stamp(row, "until_ns", place), row, place)
        for row, place in zip(rows, places, strict=True)
    ]
    order = sorted(range(len(told)), key=lambda k: told[k].stamp_ns)
    for earlier, later in itertools.pairwise(order):
        if told[later].stamp_ns <= told[earlier].until_ns:
            raise ValueError(
                f"{places[later]}: begins before the pulse of {places[earlier]} ends; pulses one after the other"
            )
    return [told[k] for k in order]


def _checked(stamp_ns: int, until_ns: int, row: Row, place: str) -> Told:
    if until_ns <= stamp_ns:
        raise ValueError(f"{place}: until_ns is not after stamp_ns; when the laser went on, and when it went off")
    if until_ns - stamp_ns > LONGEST_S * _NS:
        length_s = (until_ns - stamp_ns) / _NS
        raise ValueError(f"{place}: lasts {length_s:.4g} s; {LONGEST_S:g} s at most, both stamps in nanoseconds")
    base_T_ee = pose_of(row, place)
    try:
        check_scale(base_T_ee[None])
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None
    return Told(stamp_ns, until_ns, base_T_ee)


def _stamp(row: Row, key: str, place: str) -> int:
    value: Any = row.get(key)
    try:
        stamp_ns = int(value)
    except (TypeError, ValueError):
        missing = "has no " + key if value in (None, "") else f"{key} is {value!r}"
        raise ValueError(f"{place}: {missing}; a whole number of nanoseconds, as the frames' stamps") from None
    if not 0 <= stamp_ns <= _LAST_NS:
        raise ValueError(f"{place}: {key} is {stamp_ns}; 0 or more, below 2^63")
    return stamp_ns
