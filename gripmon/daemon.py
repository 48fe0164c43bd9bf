"""The live loop: newest frame in, transform out, everything supervised, a clean stop.

:func:`run` is what ``gripmon run`` calls.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Protocol

import msgspec

from gripmon.publish import Publisher
from gripmon.records import Frame, FrameRecord, MeasurementTrace, ReferenceRecord


class DaemonSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the loop says that something is wrong, and when it gives up."""

    state_period_s: Annotated[float, msgspec.Meta(gt=0.0, description="pause between unchanged state messages (s)")] = (
        1.0
    )
    stale_after_s: Annotated[float, msgspec.Meta(gt=0.0, description="no frame for this long: state stale (s)")] = 0.5
    no_camera_alert_after_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="without a frame for this long: an alert (s)")
    ] = 3.0
    image_alert_after_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="only refused frames for this long: an alert (s)")
    ] = 2.0
    give_up_after_errors: Annotated[
        int, msgspec.Meta(ge=1, description="internal errors in so many frames in a row: stop, exit code 3")
    ] = 50
    stop_within_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="time for the recording to be completed at the end (s)")
    ] = 1.5


class MonitorLike(Protocol):
    """What the loop needs of :class:`gripmon.monitor.Monitor`."""

    @property
    def reference(self) -> ReferenceRecord: ...
    def process(self, frame: Frame) -> FrameRecord: ...
    def trace(self) -> MeasurementTrace | None: ...


class JawFeed(Protocol):
    """Where the jaw opening comes from when frames don't bring it, e.g. :class:`gripmon.publish.ZenohJaw`."""

    def opening_m(self) -> float | None: ...
    def fault(self) -> str: ...


class Recorder(Protocol):
    """Takes frames without ever blocking; what it could not take is counted."""

    dropped: int

    def offer(self, frame: Frame, record: FrameRecord, trace: MeasurementTrace | None) -> None: ...
    def close(self, timeout_s: float) -> None: ...


class LiveSource(Protocol):
    """What the loop needs of a source."""

    live: bool

    def read(self) -> Frame | None: ...
    def close(self) -> None: ...


def run(
    monitor: MonitorLike,
    source: LiveSource,
    publisher: Publisher,
    recorder: Recorder,
    settings: DaemonSettings,
    *,
    robot: str,
    camera: str,
    estimates: Path | None = None,
    jaw: JawFeed | None = None,
    duration_s: float | None = None,
) -> int:
    """Run until the source ends, ``duration_s`` is over, or a signal comes; then close everything that was passed in.

    Call it from the main thread: it handles SIGINT and SIGTERM while it runs.  ``estimates`` is a file that gets one
    JSON line a frame; ``jaw``, where given, replaces the frames' own jaw opening.  The logger ``gripmon`` is left as
    the caller set it up (see :func:`log_to_stderr`).

    Returns the exit code: 0 the source ended, the time was over, or SIGTERM; 3 no usable frame came, or internal errors
    persisted; 130 SIGINT.
    """
    raise NotImplementedError


def log_to_stderr(*, verbose: bool = False) -> None:
    """Let the ``gripmon`` loggers write human-readable lines on stderr."""
    raise NotImplementedError
