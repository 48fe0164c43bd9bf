"""The loop's interfaces to its surroundings, which tests replace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from gripmon.model.records import Command, CommandError, CommandReply


class JawFeed(Protocol):
    """Provides the jaw opening at a frame's time if the frames don't contain it, e.g.
    :class:`gripmon.io.publish.inputs.ZenohJaw`.
    """

    def opening_m(self, stamp_ns: int | None = None) -> float | None: ...
    def fault(self) -> str: ...


class Asked(Protocol):
    """A command that somebody waits for, e.g. :class:`gripmon.io.publish.commands.PendingCommand`."""

    command: Command

    def answer(self, answer: CommandReply | CommandError, attachment: bytes | None = None, /) -> None: ...


class Commands(Protocol):
    """Commands to be carried out between two frames; ``poll`` returns the next one, None if there is none."""

    def poll(self) -> Asked | None: ...


@dataclass
class Reports:
    """Values for the state message that the loop doesn't know itself; called in its thread, and must not block.

    ``faults`` return what is wrong in a few words, empty or None while nothing is; ``unsent`` counts transforms that
    could not be sent, ``malformed`` invalid messages received; the alert limits as configured; ``others``: ids of
    other monitors with this name.
    """

    faults: list[Callable[[], str | None]] = field(default_factory=list)
    unsent: Callable[[], int] = int
    malformed: Callable[[], int] = int
    alert_limit_m: float | None = None
    alert_limit_rad: float | None = None
    others: Callable[[], tuple[str, ...]] = tuple
