"""``gripmon watch --mount``: how one camera must be moved to stand as at its reference, for a terminal or a program."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gripmon.cli.fleet_table import printable
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.mount import DIRECTIONS, Move, afterwards, moves, summary

if TYPE_CHECKING:
    from gripmon.client import MonitorName, TransformClient
    from gripmon.model.records import CommandReply

PERIOD_S = 0.3
"""As fast as somebody with a screwdriver looks up."""
_ANSWER_S, _FIND_S = 2.0, 3.0
_LIMITS_SHOWN, _CELLS = 3, 4  # on each side of a bar's middle, and characters for each
_STYLE = {True: "green", False: "yellow"}
_WIDEST = max(len(end.partition(" ")[2]) for end in ("turn anticlockwise", "turn clockwise"))


def only_monitor(joined: dict[str, Any], robot: str | None, camera: str | None) -> MonitorName:
    """The one monitor of these names that is on the network."""
    from gripmon.client import NotCarriedOut, TransformClient

    with TransformClient(robot or "*", camera, **joined) as client:
        end_s = time.monotonic() + _FIND_S
        try:
            while not (found := client.alive(_FIND_S)) and time.monotonic() < end_s:
                time.sleep(0.05)
        except NotCarriedOut as error:
            raise NoResultError(f"watch: {printable(str(error))}") from None
        if not found:
            raise NoResultError(f"watch: no monitor is on the network; {client.fault() or 'is --connect right?'}")
    if len(found) > 1:
        raise InputError(f"watch: there are {', '.join(map(str, found))}; name one (--robot, --camera)")
    return found[0]


class MountView:
    """What one monitor says of its mount, asked again at each look."""

    def __init__(self, client: TransformClient, name: MonitorName) -> None:
        self._client, self._name = client, name
        self.reply: CommandReply | None = None
        self.fault = ""
        self._told: object = None

    def look(self) -> MountView:
        """Ask the monitor."""
        from gripmon.client import Ambiguous, NotCarriedOut
        from gripmon.model.records import CommandName

        try:
            self.reply, self.fault = self._client.send(CommandName.STATE, timeout_s=_ANSWER_S), ""
        except (NotCarriedOut, Ambiguous) as error:
            self.reply, self.fault = None, printable(str(error))
        if self.reply is not None and self.reply.mount is None:
            self.fault = "it doesn't say how its camera is mounted: a monitor of an earlier version"
        return self

    @property
    def measured(self) -> bool:
        """Whether it is known how to move the camera."""
        return self.reply is not None and self.reply.mount is not None and self.reply.mount.shift_m is not None

    def line(self) -> str:
        """All of it in one line."""
        if self.reply is None or (mount := self.reply.mount) is None:
            return f"{printable(str(self._name))}: {self.fault}"
        rest = ", ".join(move.text for move in moves(mount))
        return printable(f"{self._name}: {summary(mount)}" + (f" | {rest}" if rest else ""))

    def changed(self) -> bool:
        """Whether it is another line than the last time, by more than a quarter of a limit."""
        mount = None if self.reply is None else self.reply.mount
        told = () if mount is None else moves(mount)
        before = self._told
        self._told = (self.fault, mount and (mount.reason, mount.placed), *(round(4.0 * move.share) for move in told))
        return before != self._told

    def as_data(self) -> dict[str, Any]:
        """For ``--json``."""
        mount = None if self.reply is None else self.reply.mount
        told = () if mount is None else moves(mount)
        return {
            "stamp_ns": time.time_ns(), "robot": self._name.robot, "camera": self._name.camera, "fault": self.fault,
            "placed": mount is not None and mount.placed, "mount": mount,
            "moves": [{"text": move.text, "share": move.share, "done": move.done} for move in told],
        }  # fmt: skip

    def rows(self) -> list[tuple[str, str]]:
        """The lines of the display, each with its style of rich."""
        if self.reply is None or (mount := self.reply.mount) is None:
            return [(str(self._name), "bold"), (self.fault, "red")]
        rows = [(f"{self._name}, to stand as at {mount.reference_id} (revision {mount.revision})", "bold")]
        known = mount.tcp_off_m is not None
        rows += [(summary(mount), "bold green" if mount.placed else "bold yellow" if known else "red"), ("", "")]
        rows += [(bar(move), _STYLE[mount.placed or move.done]) for move in moves(mount)]
        rows += [("", ""), ("( ) alert limit", "dim"), (DIRECTIONS, "dim")]
        rows.append((afterwards(self.reply, *self._name), ""))
        return [(printable(text), style) for text, style in rows]


def bar(move: Move) -> str:
    """Both ways, a bar from the middle towards where to go, and what to do: ``left ····(··|██)···· right  shift …``."""
    half = _LIMITS_SHOWN * _CELLS
    filled = min(half, max(int(abs(move.share) * _CELLS + 0.5), int(not move.done)))
    cells = ["█" if k < filled else "·" for k in range(half)]
    cells.insert(_CELLS, ")")
    plain = ["·"] * half
    plain.insert(_CELLS, ")")
    right, left = (cells, plain) if move.share > 0.0 else (plain, cells)
    mirrored = "".join(reversed(left)).replace(")", "(")
    first, second = (end.partition(" ")[2] for end in move.ends)
    ways = f"{first:>{_WIDEST}} {mirrored}|{''.join(right)} {second:<{_WIDEST}}"
    return f"{ways} {'ok' if move.done else '  '} {move.text}"


def plain(rows: Sequence[tuple[str, str]]) -> str:
    """The display without colours."""
    return "\n".join(text.rstrip() for text, _ in rows).rstrip()
