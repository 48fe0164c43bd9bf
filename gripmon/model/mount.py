"""How a camera must be moved by hand to stand as at a reference, in words for whoever holds the screwdriver.

All of it is in the camera's own directions: right, left, up and down as in its picture, forward where it looks,
clockwise as seen from behind it.
"""

from __future__ import annotations

import math

import msgspec

from gripmon.model.records import CommandReply, Mount

DIRECTIONS = (
    "right, left, up, down as in the camera's picture; forward: where it looks; clockwise: seen from behind the camera"
)
# Both ends of each axis: x right, y down, z forward, and the right-handed turns about them.
_SHIFTS = (("shift left", "shift right"), ("shift up", "shift down"), ("shift back", "shift forward"))
_TURNS = (("turn down", "turn up"), ("turn left", "turn right"), ("turn anticlockwise", "turn clockwise"))
_SHOWN_MM, _SHOWN_DEG = 0.005, 0.005  # less is shown as zero


class Move(msgspec.Struct, frozen=True):
    """One of six: what to do, in words; ``ends``: the words of both ways; ``share``: how much, positive towards the
    second, 1 for what alone would use up the alert limit; ``done``: no more than that.
    """

    text: str
    ends: tuple[str, str]
    share: float
    done: bool


def moves(mount: Mount) -> tuple[Move, ...]:
    """Three shifts and three turns; none while it is unknown where the camera is."""
    if mount.shift_m is None or mount.turn_rad is None or mount.turn_limits_rad is None:
        return ()
    limit_mm = 1e3 * mount.alert_limit_m
    shifts = [
        _move(ends, 1e3 * value, limit_mm, "mm", _SHOWN_MM) for ends, value in zip(_SHIFTS, mount.shift_m, strict=True)
    ]
    turns = [
        _move(ends, math.degrees(value), math.degrees(limit), "°", _SHOWN_DEG)
        for ends, value, limit in zip(_TURNS, mount.turn_rad, mount.turn_limits_rad, strict=True)
    ]
    return (*shifts, *turns)


def _move(ends: tuple[str, str], value: float, limit: float, unit: str, shown: float) -> Move:
    amount = f"{abs(value):.2f}{unit if unit == '°' else f' {unit}'}"
    what, _, one = ends[value > 0.0].partition(" ")
    text = f"{what} {one} {amount}" if abs(value) >= shown else f"{what} {' or '.join(e.split()[1] for e in ends)} 0"
    return Move(text, ends, value / limit, abs(value) <= limit)


def afterwards(reply: CommandReply, robot: str, camera: str) -> str:
    """What remains to be done once the camera is in place; empty if the reference to stand at is in force."""
    mount = reply.mount
    if mount is None or (reply.reference_id, reply.revision) == (mount.reference_id, mount.revision):
        return ""
    undo = f"gripmon send undo {mount.reference_id} --robot {robot} --camera {camera}"
    return f"{reply.reference_id}, which the monitor made, is in force: once in place, {undo}"


def summary(mount: Mount) -> str:
    """In a line: whether the camera stands as at the reference, else by how much not and what to do first."""
    if mount.tcp_off_m is None or mount.turned_rad is None:
        return f"can't tell where the camera stands: {mount.reason or 'no frame has come yet'}"
    off = f"the TCP is {1e3 * mount.tcp_off_m:.2f} mm off, the view turned by {math.degrees(mount.turned_rad):.2f}°"
    allowed = f"(alert limits {1e3 * mount.alert_limit_m:.2f} mm, {math.degrees(mount.alert_limit_rad):.2f}°)"
    if mount.placed:
        return f"in place: {off} {allowed}"
    if mount.reason and mount.within:
        return f"within the limits, but not certain: {mount.reason}"
    first = max(moves(mount), key=lambda move: abs(move.share))
    return f"{first.text} first: {off} {allowed}" + (f"; not certain: {mount.reason}" if mount.reason else "")
