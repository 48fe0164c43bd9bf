"""Where a monitor's records go: Zenoh, ROS 2, metrics, the recording, ``estimates.jsonl`` are outputs in one list.

None may hold a frame up: what takes time waits in a bounded queue of the output's own, which drops and counts.  What an
output raises is reported by the loop, and reaches neither the monitor nor another output.
"""

from __future__ import annotations

from collections.abc import Callable

from gripmon.model.records import (
    AlertRecord,
    Frame,
    FrameRecord,
    MeasurementTrace,
    MonitorNotes,
    RecordedCommand,
    ReferenceRecord,
    StateRecord,
)

Event = ReferenceRecord | StateRecord | AlertRecord | RecordedCommand
"""What happens beside the frames.  A reference comes before the first record that names it; an alert of a frame, which
its record contains as well, after it."""

Trace = Callable[[], MeasurementTrace | None]
"""The pixels behind the newest record, computed when called, which must be before :meth:`Output.frame` returns."""
Notes = Callable[[], MonitorNotes]
"""The limits behind it, likewise."""


class Output:
    """Takes everything in the loop's thread, and returns at once.  This base class keeps nothing."""

    name = "nothing"
    """In messages about its faults."""
    public = False
    """Others act by what it says: while another monitor has this one's name, the records that it gets have no pose."""

    @property
    def has_room(self) -> bool:
        """Whether nothing would be dropped now, or waiting wouldn't help; a source that can wait does so until then."""
        return True

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """A frame and what was made of it."""

    def event(self, event: Event) -> None:
        """Something beside the frames."""

    def close(self) -> None:
        """Deliver what waits if that is quick, and release everything.  Calling it twice does nothing more."""
