"""The black box: everything that was seen and decided, as ``.rrd`` files that tell their story when opened.

The loop's thread only appends to a bounded queue (:meth:`Recorder.offer`).  A thread of the daemon hands the queue over
to a process of its own, which encodes the images, logs to rerun and looks after the files; so neither JPEG, rerun nor a
slow disk ever hold the interpreter that the loop runs in.  The daemon itself never imports rerun.
"""

from __future__ import annotations

from gripmon.record.write.feed import ProcessRecorder
from gripmon.record.write.opened import open_recorder, open_spot_recorder
from gripmon.record.write.recorder import EventRecorder, Notes, NullRecorder, Recorder, SpotRecorder, Trace
from gripmon.record.write.settings import RecordingSettings
from gripmon.record.write.view import ViewSettings

__all__ = [
    "EventRecorder",
    "Notes",
    "NullRecorder",
    "ProcessRecorder",
    "Recorder",
    "RecordingSettings",
    "SpotRecorder",
    "Trace",
    "ViewSettings",
    "open_recorder",
    "open_spot_recorder",
]
