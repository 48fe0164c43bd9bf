"""An inbox whose messages take no time to come, as far as a test doesn't say how long they took."""

from __future__ import annotations

from gripmon.client import MonitorName
from gripmon.client.age import Sent
from gripmon.client.inbox import Inbox
from gripmon.model.records import ClockReading

HOUR_NS = 3600 * 10**9


class TimelyInbox(Inbox):
    """The monitor's clock is an hour ahead of ours."""

    def take(self, monitor: MonitorName, payload: bytes, arrival_s: float, sent: Sent | None = None) -> None:
        arrived_ns = round(1e9 * arrival_s)
        if sent is None:
            sent = Sent(clock(arrived_ns), arrived_ns)
            self.answered(sent.reading, arrived_ns, arrived_ns)
        super().take(monitor, payload, arrival_s, sent)


def clock(now_ns: int, name: str = "its") -> ClockReading:
    """What the monitor's clock shows at ``now_ns`` by ours."""
    return ClockReading(name, now_ns + HOUR_NS)
