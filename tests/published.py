"""A publisher with everything that the daemon attaches to its link."""

from __future__ import annotations

from pathlib import Path

from gripmon.publish import ZenohCommands, ZenohJaw, ZenohPublisher
from gripmon.wire import Link, PublishSettings


class Published(ZenohPublisher):
    """``jaw``, ``commands`` and ``link`` beside the publisher's own."""

    def __init__(
        self, settings: PublishSettings, robot: str = "arm", camera: str = "wrist", *, relative_to: Path = Path()
    ) -> None:
        self.link = Link(settings, relative_to)
        try:
            super().__init__(self.link, robot, camera)
        except ValueError:
            self.link.close()
            raise
        self.jaw = ZenohJaw(self.link, self.keys["jaw"])
        if settings.commands:
            self.commands = ZenohCommands(self.link, self.keys)

    @property
    def connected(self) -> bool:
        return self.link.connected
