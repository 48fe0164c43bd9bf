"""A recorder that can be switched off and on while the loop runs, so that both are measured in the same minute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from gripmon.daemon.config import Config
from gripmon.model.outputs import Event, Notes, Trace
from gripmon.model.records import Frame, FrameRecord
from gripmon.record.recorder import Recorder
from gripmon.record.write import ProcessRecorder, open_recorder


class SwitchedRecorder(Recorder):
    """The product's recorder while ``on``, with its default settings but for ``changes``; idle while off."""

    def __init__(self, config: Config, directory: Path, **changes: Any) -> None:
        self.on = False
        self._offered = 0
        inner = open_recorder(
            msgspec.structs.replace(config.settings.recording, min_free_bytes=0, **changes),
            robot=config.settings.robot,
            camera_name=config.settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=config.reference,
            directory=directory,
        )
        assert isinstance(inner, ProcessRecorder)
        self._inner = inner

    @property
    def dropped(self) -> int:
        return self._inner.dropped

    @property
    def images_dropped(self) -> int:
        return self._inner.images_dropped

    @property
    def has_room(self) -> bool:
        return self._inner.has_room

    @property
    def waiting(self) -> int:
        """Frames that were taken and are not yet written."""
        return self._offered - self._inner.frames_written - self._inner.dropped

    @property
    def process_id(self) -> int | None:
        return self._inner.process_id

    @property
    def failure(self) -> str | None:
        return self._inner.failure

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        if self.on:
            self._offered += 1
            self._inner.frame(frame, record, trace, notes)

    def event(self, event: Event) -> None:
        self._inner.event(event)

    def close(self, timeout_s: float = 5.0) -> None:
        self._inner.close(timeout_s)
