"""For programs that use the corrected transform, such as servo controllers.

    from gripmon.client import TransformClient

    with TransformClient("arm1", "wrist") as monitor:
        reading = monitor.latest()  # returns immediately, whatever the network does
        if reading.usable:
            move_by(reading.transform)
        else:
            stop(reading.reason)

:class:`TransformClient` returns the newest transform and whether it may be used.  :class:`Client` reads every message
unchanged, and sends commands.  :class:`Fleet` shows the state of all monitors on the network.  A client may start
before the monitor, and reconnects by itself when a monitor or a router restarts.  Neither NumPy nor OpenCV is loaded.
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
