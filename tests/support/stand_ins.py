"""Stand-ins for the daemon's neighbours: monitor and sources that follow a script, outputs that write it all down."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from gripmon.io.sources import Waiting
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertRecord,
    Command,
    CommandReply,
    CornerFault,
    CornerRecord,
    Frame,
    FrameRecord,
    Limits,
    MeasurementTrace,
    MonitorNotes,
    MonitorState,
    Origin,
    RecordedCommand,
    ReferenceRecord,
    StateRecord,
    Verdict,
)
from gripmon.record.recorder import Recorder
from support.loopback import frame_record, reference_record

REFUSED = {
    "verdict": Verdict.UNKNOWN,
    "source": Origin.HELD,
    "corners": (CornerRecord("L_in_near", None, None, used=False, reason=CornerFault.FRAME_REFUSED),),
    "alerts": (),
    "reason": "black",
}

NOTES = MonitorNotes(0.5, Limits(1e-4, 3e-3, 2.5e-3, 0.02, (1e-5,) * 6, None, None, None, (1.0,) * 6, (0.0,) * 6))


def show(output: Output, record: FrameRecord) -> None:
    """A frame's record to an output that needs nothing else of it."""
    output.frame(Frame(record.seq, record.stamp_ns, None), record, lambda: None)


class ScriptedMonitor:
    """Answers frame i with ``answers(i)``; an exception there is raised."""

    def __init__(self, answers: Callable[[int], dict[str, object] | Exception] = lambda seq: {}) -> None:
        self.answers = answers
        self.frames: list[Frame] = []
        self.reference = reference_record(3)
        self.state_revision = 0
        self.obeyed: list[tuple[Command, int]] = []

    def process(self, frame: Frame) -> FrameRecord:
        self.frames.append(frame)
        answer = self.answers(frame.seq)
        if isinstance(answer, Exception):
            raise answer
        values = {
            "stamp_ns": frame.stamp_ns,
            "alerts": (),
            "jaw_opening_m": frame.jaw_opening_m,
            "revision": self.reference.revision,
            **answer,
        }
        record = frame_record(frame.seq, **values)
        if record.revision != self.reference.revision:
            self.reference = reference_record(record.revision)
            self.state_revision += 1
        return record

    def command(self, command: Command, stamp_ns: int) -> CommandReply:
        """Every command makes a new reference, but one with an argument is refused, and with "fail" it raises."""
        if command.argument == "fail":
            raise RuntimeError("out of order")
        self.obeyed.append((command, stamp_ns))
        done = not command.argument
        if done:
            self.reference = reference_record(self.reference.revision + 1)
            self.state_revision += 1
        text = "as you like" if done else "not so"
        return CommandReply(command.name, done, text, self.reference.reference_id, self.reference.revision)

    def state(self) -> MonitorState:
        return MonitorState((self.reference,))

    def learn(self) -> None: ...

    pending = False
    beside = None

    def run_live(self) -> None: ...

    def run_pending(self) -> None: ...

    def trace(self) -> MeasurementTrace | None:
        return None

    def notes(self) -> MonitorNotes:
        return NOTES


class ScriptedSource:
    """Gives the items in order, then None; numbers stand for frames, exceptions are raised, functions called."""

    def __init__(self, items: Iterable[object], *, live: bool = False) -> None:
        self._items = iter(items)
        self.live = live
        self.connected = True
        self.dropped = 0
        self.closed = 0

    def read(self) -> Frame | Waiting | None:
        for item in self._items:
            if isinstance(item, Exception):
                raise item
            if callable(item):
                item(self)
                continue
            self.connected = not isinstance(item, Waiting)
            return Frame(item, 1_000 + item, None) if isinstance(item, int) else item  # type: ignore[return-value]
        return None

    def close(self) -> None:
        self.closed += 1


class Listener(Recorder):
    """A recorder, or any output: writes everything down, except what ``fails`` names ("everything": all)."""

    dropped = images_dropped = 0  # type: ignore[assignment]
    has_room = True  # type: ignore[assignment]
    failure: str | None = None  # type: ignore[assignment]

    def __init__(self, name: str = "listener", *, fails: str = "", closing_fails: bool = False) -> None:
        self.name, self.public = name, name != "recording"
        self.transforms: list[FrameRecord] = []
        self.states: list[StateRecord] = []
        self.alerts: list[AlertRecord] = []
        self.references: list[ReferenceRecord] = []
        self.commands: list[RecordedCommand] = []
        self.offered: list[tuple[Frame, FrameRecord]] = []
        self.closed = 0
        self.order: list[tuple[str, int]] = []  # what came, and the revision that it names
        self.fails, self._closing_fails = fails, closing_fails

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        self._take("transform", record.revision)
        self.transforms.append(record)
        self.offered.append((frame, record))

    def event(self, event: Event) -> None:
        kinds: dict[type, tuple[str, list[Any]]] = {
            StateRecord: ("state", self.states),
            AlertRecord: ("alert", self.alerts),
            ReferenceRecord: ("reference", self.references),
            RecordedCommand: ("command", self.commands),
        }
        what, kept = kinds[type(event)]
        self._take(what, event.seq if isinstance(event, RecordedCommand) else event.revision)
        kept.append(event)

    def _take(self, what: str, revision: int) -> None:
        if self.fails in (what, "everything"):
            raise OSError("the line is cut")
        self.order.append((what, revision))

    def close(self, timeout_s: float = 0.0) -> None:
        self.closed += 1
        if self._closing_fails:
            raise RuntimeError("can't close")


class TickingSource:
    """A camera of so many frames a second; where the machine was late it catches up, so that no number is missing."""

    live = True
    connected = True
    dropped = 0

    def __init__(self, frames_per_s: float) -> None:
        self._period_s = 1.0 / frames_per_s
        self._start_s = time.monotonic()
        self._seq = -1

    def read(self) -> Frame:
        self._seq += 1
        time.sleep(max(0.0, self._start_s + self._seq * self._period_s - time.monotonic()))
        return Frame(self._seq, time.time_ns(), None)

    def close(self) -> None:
        pass


class SilentSource(TickingSource):
    """A camera that is not there."""

    connected = False

    def read(self) -> Waiting:  # type: ignore[override]
        time.sleep(0.5)
        return Waiting("camera 0 can't be opened")
