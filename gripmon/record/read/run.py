"""What is read of a run, whoever asks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from gripmon.model.records import AlertRecord, Meta, RecordedCommand, ReferenceRecord, StateRecord
from gripmon.record.read.table import FrameTable


class RecordedRun(Protocol):
    """What recordings hold of one run of one monitor, or of a part, as :class:`gripmon.record.read.Recording` does."""

    @property
    def recording_id(self) -> str: ...
    @property
    def meta(self) -> Meta | None: ...
    @property
    def robot(self) -> str: ...
    @property
    def camera(self) -> str: ...
    @property
    def frames(self) -> FrameTable: ...
    @property
    def alerts(self) -> Sequence[AlertRecord]: ...
    @property
    def states(self) -> Sequence[StateRecord]: ...
    @property
    def commands(self) -> Sequence[RecordedCommand]: ...
    @property
    def references(self) -> Sequence[ReferenceRecord]: ...
