"""Frames that can wait, through the monitor as the daemon drives it."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.daemon.api import Monitor, open_source
from gripmon.daemon.config import Config
from gripmon.io.sources import Source
from gripmon.model.records import (
    Command,
    Frame,
    FrameRecord,
    MonitorState,
    RecordedCommand,
    unmeasured_record,
)
from gripmon.record.write import NullRecorder, Recorder

_log = logging.getLogger(__name__)


class Past(NamedTuple):
    """What a monitor went through beside its frames."""

    state: MonitorState | None = None
    """What it began with; None: with the configured reference."""
    commands: tuple[RecordedCommand, ...] = ()
    """In their order; each came after the frame that it names."""


NOTHING_BEFORE = Past()


def replay(
    source: str | Path | Source,
    config: Config,
    recorder: Recorder | None = None,
    past: Past = NOTHING_BEFORE,
    warn: Callable[[str], None] = _log.warning,
) -> Iterator[FrameRecord]:
    """Process every frame of a source that isn't live: one record for each, in order; the same input gives the same
    records, ``latency_ns`` aside.

    ``source``: a folder of images or a video file, or what :func:`gripmon.open_source` gave, which the caller closes.
    ``recorder`` gets what a recording holds; ``past`` is what the monitor went through before and beside the frames;
    ``warn`` gets a line of text when something beside the frames is wrong.

    Raises :class:`SourceError` for a source that can't be read.  A frame that can't be used is a record with a reason.
    """
    if isinstance(source, str | Path):
        with open_source(source) as opened:
            yield from replay(opened, config, recorder, past, warn)
        return
    recorder = NullRecorder() if recorder is None else recorder
    monitor = Monitor(config, past.state)
    waiting = deque(past.commands)
    revision = monitor.reference.revision
    ignored = False
    while (frame := source.read()) is not None:
        assert isinstance(frame, Frame), "only a live source waits"
        while waiting and waiting[0].seq < frame.seq:
            recorder.command(_told(monitor, waiting.popleft()))
        if not ignored and monitor.ignores_opening(frame):
            ignored = True
            warn("the frames bring jaw openings, but jaw.source is fixed: they are not used")
        frame = monitor.with_opening(frame)
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
        yield record


def _told(monitor: Monitor, then: RecordedCommand) -> RecordedCommand:
    """Give the monitor a command as it was given then, at the same time; what became of it now."""
    try:
        answer = monitor.command(Command(then.name, then.argument), then.stamp_ns)
    except Exception as error:  # noqa: BLE001  as the daemon does
        return msgspec.structs.replace(then, done=False, text=f"internal error: {_in_short(error)}")
    return msgspec.structs.replace(then, done=answer.done, text=answer.text)


def _in_short(error: Exception) -> str:
    """As the daemon says it."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
