"""Reading recordings: what monitors wrote down, as columns, records and pictures, whatever state the files are in.

``open_recordings(paths, progress)`` takes files and folders, of several runs and robots, in any order, and gives a
:class:`Collection`: the recordings, each one run of one monitor, and the faults, one line each, of what could not be
used.  No file is ever changed, and images stay in the files until they are asked for.
"""

from __future__ import annotations

from gripmon.record.read.opening import (
    Collection,
    is_rrd,
    needed_recordings,
    open_recordings,
    recording_files,
    recordings_below,
)
from gripmon.record.read.recordings import Picture, Recording, Shot, decode_image
from gripmon.record.read.table import FrameTable

__all__ = [
    "Collection",
    "FrameTable",
    "Picture",
    "Recording",
    "Shot",
    "decode_image",
    "is_rrd",
    "needed_recordings",
    "open_recordings",
    "recording_files",
    "recordings_below",
]
