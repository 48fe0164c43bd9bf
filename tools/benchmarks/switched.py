"""A recorder that can be switched off and on while the loop runs, so that both are measured in the same minute."""

from __future__ import annotations

from pathlib import Path

import msgspec

from gripmon.config import Config
from gripmon.recording import Notes, Trace, open_recorder
from gripmon.records import AlertRecord, Frame, FrameRecord, RecordedCommand, ReferenceRecord, StateRecord


class SwitchedRecorder:
    """The product's recorder with its default settings while ``on``; nothing is offered to it while off."""

    def __init__(self, config: Config, directory: Path) -> None:
        self.on = False
        self._inner = open_recorder(
            msgspec.structs.replace(config.settings.recording, min_free_bytes=0),
            robot=config.settings.robot,
            camera_name=config.settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=config.reference,
            directory=directory,
        )

    @property
    def dropped(self) -> int:
        return self._inner.dropped

    @property
    def failure(self) -> str | None:
        return self._inner.failure

    def offer(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        if self.on:
            self._inner.offer(frame, record, trace, notes)

    def alert(self, record: AlertRecord) -> None:
        self._inner.alert(record)

    def reference(self, record: ReferenceRecord) -> None:
        self._inner.reference(record)

    def command(self, command: RecordedCommand) -> None:
        self._inner.command(command)

    def state(self, state: StateRecord) -> None:
        self._inner.state(state)

    def close(self, timeout_s: float = 5.0) -> None:
        self._inner.close(timeout_s)
