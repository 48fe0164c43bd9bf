"""Frames that can wait, through the monitor as the daemon drives it."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.io.sources import Source
    from gripmon.model.records import FrameRecord, MonitorState, RecordedCommand
    from gripmon.monitor import Monitor
    from gripmon.record.write import Recorder


class Past(NamedTuple):
    """What a monitor went through beside its frames."""

    state: MonitorState | None = None
    """What it began with; None: with the configured reference."""
    commands: tuple[RecordedCommand, ...] = ()
    """In their order; each came after the frame that it names."""


NOTHING_BEFORE = Past()


def replay(
    config: Config, source: Source, recorder: Recorder, past: Past = NOTHING_BEFORE
) -> Iterator[tuple[bytes, FrameRecord]]:
    """Process every frame of a source that isn't live: yields each record with its JSON line."""
    import msgspec

    from gripmon.model.records import Frame, to_json, unmeasured_record
    from gripmon.monitor import Monitor

    monitor = Monitor(
        config.camera, config.gripper, config.settings.monitor, config.reference, config.taught_edges, past.state
    )
    with_jaw = _jaw_of(config)
    waiting = deque(past.commands)
    revision = monitor.reference.revision
    while (frame := source.read()) is not None:
        assert isinstance(frame, Frame), "only a live source waits"
        while waiting and waiting[0].seq < frame.seq:
            recorder.command(_told(monitor, waiting.popleft()))
        frame = with_jaw(frame)
        start_ns = time.perf_counter_ns()
        try:
            record = monitor.process(frame)
        except Exception as error:  # noqa: BLE001  said in the record and in the summary
            record = unmeasured_record(frame, monitor.reference, f"internal error: {_in_short(error)}")
        record = msgspec.structs.replace(record, latency_ns=time.perf_counter_ns() - start_ns)
        if monitor.reference.revision != revision:
            revision = monitor.reference.revision
            recorder.reference(monitor.reference)
        recorder.offer(frame, record, monitor.trace, monitor.notes)
        yield to_json(record) + b"\n", record
        try:
            monitor.ponder()  # now, as the daemon: a command would find other thoughts
        except Exception as error:  # noqa: BLE001  as the daemon does
            print(f"replay: frame {frame.seq}: reflection failed: {_in_short(error)}", file=sys.stderr)


def _told(monitor: Monitor, then: RecordedCommand) -> RecordedCommand:
    """Give the monitor a command as it was given then, at the same time; what became of it now."""
    import msgspec

    from gripmon.model.records import Command

    try:
        answer = monitor.command(Command(then.name, then.argument), then.stamp_ns)
    except Exception as error:  # noqa: BLE001  as the daemon does
        return msgspec.structs.replace(then, done=False, text=f"internal error: {_in_short(error)}")
    return msgspec.structs.replace(then, done=answer.done, text=answer.text)


def _in_short(error: Exception) -> str:
    """As the daemon says it."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _jaw_of(config: Config) -> Callable[[Any], Any]:
    """How a frame gets its jaw opening: from the configuration, or it keeps what it came with."""
    if config.settings.jaw.source != "fixed":
        return lambda frame: frame
    warned = False

    def with_fixed_jaw(frame: Any) -> Any:
        nonlocal warned
        other = frame.jaw_opening_m is not None and frame.jaw_opening_m != config.jaw_opening_m
        if other and not warned and config.gripper.has_jaw:
            warned = True
            print("replay: the frames bring jaw openings, but jaw.source is fixed: they are not used", file=sys.stderr)
        return dataclasses.replace(frame, jaw_opening_m=config.jaw_opening_m)

    return with_fixed_jaw
