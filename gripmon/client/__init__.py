"""For programs that use the corrected transform, such as servo controllers.

    from gripmon.client import TransformClient

    with TransformClient("arm1", "wrist") as monitor:
        reading = monitor.latest()  # returns immediately, whatever the network does
        if reading.usable:
            move_by(reading.transform)
        else:
            stop(reading.reason)

:class:`TransformClient` returns the newest transform and whether it may be used, each message unchanged
(``reading.record``), and sends commands; :class:`Client` is its earlier name for those who only do the latter.
:class:`Fleet` shows the state of all monitors on the network.  A client may start before the monitor, and reconnects by
itself when a monitor or a router restarts.  Neither NumPy nor OpenCV is loaded.
"""

from __future__ import annotations

from gripmon.client.commands import Ambiguous
from gripmon.client.fleet import Condition, Fleet, MonitorStatus, trouble
from gripmon.client.network import MonitorName, NotCarriedOut
from gripmon.client.reading import NotUsable, Policy, Reading, Unusable
from gripmon.client.transforms import TransformClient

Client = TransformClient

__all__ = [
    "Ambiguous",
    "Client",
    "Condition",
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
