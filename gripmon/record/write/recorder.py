"""What the loop sees of a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from gripmon.model.records import (
    AlertRecord,
    Frame,
    FrameRecord,
    Image,
    MeasurementTrace,
    MonitorNotes,
    RecordedCommand,
    ReferenceRecord,
    SpotRecord,
    StateRecord,
)

Trace = Callable[[], MeasurementTrace | None]
Notes = Callable[[], MonitorNotes]


class EventRecorder(Protocol):
    """What every loop sees of a recording: it takes without ever blocking; what it could not take is counted.

    ``dropped`` are frames that are not in the recording, ``images_dropped`` images that others lack; ``failure`` says
    why nothing is being written, None when all is well.  ``has_room``: nothing would be dropped now, or waiting would
    not help; whoever can wait does until then.
    """

    @property
    def dropped(self) -> int: ...
    @property
    def images_dropped(self) -> int: ...
    @property
    def has_room(self) -> bool: ...
    @property
    def failure(self) -> str | None: ...

    def alert(self, alert: AlertRecord) -> None: ...
    def command(self, command: RecordedCommand) -> None: ...
    def state(self, state: StateRecord) -> None: ...
    def close(self, timeout_s: float = 2.0) -> None: ...


class Recorder(EventRecorder, Protocol):
    """The recording of a wrist camera."""

    def offer(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """``trace`` is called before this returns, and only where the picture is recorded; so is ``notes`` always."""

    def reference(self, reference: ReferenceRecord) -> None: ...


class SpotRecorder(EventRecorder, Protocol):
    """The recording of a second camera."""

    def spot(self, record: SpotRecord, image: Image | None) -> None:
        """What became of a pulse, with the image in which its spot was looked for."""


class NullRecorder:
    """Records nothing."""

    dropped = images_dropped = 0
    has_room = True
    failure: str | None = None

    def offer(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        pass

    def spot(self, record: SpotRecord, image: Image | None) -> None:
        pass

    def alert(self, alert: AlertRecord) -> None:
        pass

    def reference(self, reference: ReferenceRecord) -> None:
        pass

    def command(self, command: RecordedCommand) -> None:
        pass

    def state(self, state: StateRecord) -> None:
        pass

    def close(self, timeout_s: float = 2.0) -> None:
        pass
