"""The per-frame method."""

from gripmon.monitor.core import Monitor
from gripmon.monitor.possible import foresee_bounds, seen_in_images
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import Bounds
from gripmon.monitor.tracker import CORNER_COUNTS, Tracker
from gripmon.monitor.warming import warm_up

__all__ = [
    "CORNER_COUNTS",
    "Bounds",
    "Monitor",
    "MonitorSettings",
    "Tracker",
    "foresee_bounds",
    "seen_in_images",
    "warm_up",
]
