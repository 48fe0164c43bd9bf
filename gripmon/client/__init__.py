"""For programs that use the corrected transform, such as servo controllers.

    from gripmon.client import TransformClient

    with TransformClient("arm1", "wrist") as monitor:
        reading = monitor.latest()  # at once, whatever the network does
        if reading.usable:
            move_by(reading.transform)
        else:
            stop(reading.reason)

:class:`TransformClient` gives the newest transform and whether it may be used.  :class:`Client` reads every message as
it is, and sends commands.  :class:`Fleet` knows how all monitors on the network are.  Nothing here waits for a monitor
to start, and nothing needs help when a monitor or a router ends and comes again.  Neither NumPy nor OpenCV is loaded.
"""

from __future__ import annotations

from gripmon.client.alert_log import AlertLog, Event
from gripmon.client.asking import Ambiguous, NotCarriedOut
from gripmon.client.fleet import Condition, Fleet, MonitorStatus, trouble
from gripmon.client.network import MonitorName
from gripmon.client.reader import Client
from gripmon.client.reading import NotUsable, Policy, Reading, Unusable
from gripmon.client.transforms import TransformClient

__all__ = [
    "AlertLog",
    "Ambiguous",
    "Client",
    "Condition",
    "Event",
    "Fleet",
    "MonitorName",
    "MonitorStatus",
    "NotCarriedOut",
    "NotUsable",
    "Policy",
    "Reading",
    "TransformClient",
    "Unusable",
    "trouble",
]
