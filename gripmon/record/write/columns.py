"""What of a frame is recorded, and how columns of it get into a stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from gripmon.model.records import FrameRecord, Limits, SpotRecord
from gripmon.record.write.wire import TraceNote


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded image and what was measured on it (grey values 0..255)."""

    blob: bytes
    media_type: str
    mean_grey: float
    contrast_grey: float
    saturated_percent: float
    sharpness: float


@dataclass(frozen=True, slots=True)
class Row:
    """A frame; its ``limits`` are the ones that were in force, as far as anybody said."""

    record: FrameRecord
    picture: Picture | None
    trace: TraceNote | None
    truth_tcp_m: tuple[float, float, float] | None
    jaw_reported_m: float | None = None
    statistic_share: float | None = None
    limits: Limits | None = None


@dataclass(frozen=True, slots=True)
class SpotRow:
    """A pulse of a second camera's laser."""

    record: SpotRecord
    picture: Picture | None


AnyRow = Row | SpotRow


class Sender:
    """Sends columns with both timelines."""

    def __init__(self, stream: rr.RecordingStream):
        self.stream = stream

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        for archetype in archetypes:
            self.stream.log(path, archetype, static=True)

    def columns(self, path: str, stamps_ns: list[int], seqs: list[int], columns: rr.ComponentColumnList) -> None:
        """Without stamps they are on the timeline of frames only."""
        indexes = [rr.TimeColumn("frame", sequence=seqs)]
        if stamps_ns:
            times = np.array(stamps_ns, np.int64).astype("datetime64[ns]")
            indexes.insert(0, rr.TimeColumn("capture_time", timestamp=times))
        self.stream.send_columns(path, indexes, columns)

    def frames(self, path: str, rows: Sequence[AnyRow], columns: rr.ComponentColumnList) -> None:
        self.columns(path, [r.record.stamp_ns for r in rows], [r.record.seq for r in rows], columns)

    def scalars(self, path: str, rows: Sequence[AnyRow], values: Sequence[Sequence[float]]) -> None:
        """Several curves; a row without values leaves a gap in them."""
        flat = np.array([v for some in values for v in some], dtype=np.float64)
        self.frames(path, rows, rr.Scalars.columns(scalars=flat).partition([len(some) for some in values]))

    def curve(self, path: str, rows: Sequence[AnyRow], values: Sequence[float | None]) -> None:
        """One curve; None leaves a gap in it."""
        self.scalars(path, rows, [() if value is None else (value,) for value in values])
