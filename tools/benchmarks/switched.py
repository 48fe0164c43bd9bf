"""A recorder that can be switched off and on while the loop runs, so that both are measured in the same minute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from gripmon.daemon.config import Config
from gripmon.model.outputs import Notes, Trace
from gripmon.model.records import Frame, FrameRecord
from gripmon.record.recorder import Scene
from gripmon.record.write import ProcessRecorder


def described(config: Config, directory: Path, **changes: Any) -> Scene:
    """What a recording process is told, with the default settings but for ``changes``; a full disk doesn't stop it."""
    settings = config.settings
    return Scene(
        name="bench", directory=str(directory), robot=settings.robot, camera=settings.camera_name,
        settings=msgspec.structs.replace(settings.recording, min_free_bytes=0, **changes),
        lens=config.camera.settings, gripper=config.gripper.model, reference=config.reference,
    )  # fmt: skip


class SwitchedRecorder(ProcessRecorder):
    """The product's recorder while ``on``; idle while off."""

    def __init__(self, config: Config, directory: Path, **changes: Any) -> None:
        self.on = False
        self._offered = 0
        super().__init__(described(config, directory, **changes))

    @property
    def waiting(self) -> int:
        """Frames that were taken and are not yet written."""
        return self._offered - self.frames_written - self.dropped

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        if self.on:
            self._offered += 1
            super().frame(frame, record, trace, notes)
