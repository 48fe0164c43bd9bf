"""The per-frame method."""

from gripmon.monitor.core import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import Bounds
from gripmon.monitor.tracker import CORNER_COUNTS, Tracker
from gripmon.monitor.warming import warm_up
from gripmon.monitor.weigher import foresee_bounds

__all__ = ["CORNER_COUNTS", "Bounds", "Monitor", "MonitorSettings", "Tracker", "foresee_bounds", "warm_up"]
