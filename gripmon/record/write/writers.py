"""Who writes the rows of a recording: a wrist camera's frames, or the pulses of a second camera's laser."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import rerun as rr

from gripmon.record.write.rows import RowWriter
from gripmon.record.write.spot_rows import SpotWriter
from gripmon.record.write.wire import Events, Scene


class Writer(Protocol):
    """Writes the rows of its kind into one file."""

    def write(self, rows: Sequence[Any], events: Events) -> None: ...
    def write_pictures(self, rows: Sequence[Any]) -> None: ...
    def repeat(self) -> None: ...
    def finish(self) -> None: ...


def make_writer(stream: rr.RecordingStream, scene: Scene, file_number: int) -> Writer:
    """The one for this scene; it has written what is static."""
    kind = RowWriter if scene.laser is None else SpotWriter
    return kind(stream, scene, file_number)
