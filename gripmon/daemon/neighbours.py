"""What the loop needs of those around it, which tests stand in for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from gripmon.laser.matching import ReportedPulse
from gripmon.model.records import (
    Command,
    CommandError,
    CommandReply,
    Frame,
    FrameRecord,
    MeasurementTrace,
    MonitorNotes,
    MonitorState,
    ReferenceRecord,
)


class MonitorLike(Protocol):
    """What the loop needs of :class:`gripmon.monitor.Monitor`."""

    @property
    def reference(self) -> ReferenceRecord: ...
    def process(self, frame: Frame) -> FrameRecord: ...
    def learn(self) -> None: ...
    @property
    def pending(self) -> bool: ...
    def run_pending(self) -> None: ...
    def trace(self) -> MeasurementTrace | None: ...
    def notes(self) -> MonitorNotes: ...
    def command(self, command: Command, stamp_ns: int) -> CommandReply: ...
    def state(self) -> MonitorState: ...
    @property
    def state_revision(self) -> int: ...


class Asked(Protocol):
    """A command whose asker waits for the answer; it may be answered from any thread."""

    @property
    def command(self) -> Command: ...
    def answer(self, answer: CommandReply | CommandError, attachment: bytes | None = None) -> None: ...


class CommandFeed(Protocol):
    """Where commands come from, e.g. :class:`gripmon.io.publish.ZenohCommands`; ``poll`` doesn't wait."""

    def poll(self) -> Asked | None: ...


class PulseFeed(Protocol):
    """Where a laser's pulses come from, e.g. :class:`gripmon.io.publish.ZenohPulses`; ``poll`` doesn't wait."""

    def poll(self) -> ReportedPulse | None: ...


class JawFeed(Protocol):
    """Where the jaw opening at a frame's time comes from when the frames don't bring it, e.g.
    :class:`gripmon.io.publish.ZenohJaw`.
    """

    def opening_m(self, stamp_ns: int | None = None) -> float | None: ...
    def fault(self) -> str: ...


@dataclass(frozen=True)
class Reports:
    """What the state message says of things that the loop doesn't see itself; asked in its thread, at once answered.

    ``faults`` say what is wrong in a few words, empty or None while nothing is; ``unsent`` counts transforms that could
    not be sent, ``malformed`` messages received that were none; ``alert_limit_m`` as configured; ``others`` are the ids
    of other monitors of this name.
    """

    faults: Sequence[Callable[[], str | None]] = ()
    unsent: Callable[[], int] = int
    malformed: Callable[[], int] = int
    alert_limit_m: float | None = None
    others: Callable[[], tuple[str, ...]] = tuple
