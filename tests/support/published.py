"""A publisher with everything that the daemon attaches to its link."""

from __future__ import annotations

from pathlib import Path

from gripmon.io.publish.commands import ZenohCommands
from gripmon.io.publish.inputs import ZenohJaw
from gripmon.io.publish.presence import Presence
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Keys, Link, PublishSettings
from gripmon.model.records import FrameRecord
from support.stand_ins import show


class Published(ZenohPublisher):
    """``jaw``, ``commands``, ``link`` and, with ``identified``, ``presence`` beside the publisher's own."""

    def __init__(
        self,
        settings: PublishSettings,
        robot: str = "arm",
        camera: str = "wrist",
        *,
        relative_to: Path = Path(),
        identified: bool = False,
    ) -> None:
        self.link = Link(settings, relative_to)
        try:
            self.presence = Presence(self.link, Keys(robot, camera)) if identified else None
            super().__init__(self.link, robot, camera, self.presence)
        except ValueError:
            self.link.close()
            raise
        self.jaw = ZenohJaw(self.link, self.keys["jaw"])
        if settings.commands:
            self.commands = ZenohCommands(self.link, self.keys, self.presence)

    def transform(self, record: FrameRecord) -> None:
        """One frame's record."""
        show(self, record)

    @property
    def connected(self) -> bool:
        return self.link.connected
