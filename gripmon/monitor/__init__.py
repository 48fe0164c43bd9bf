"""The per-frame method."""

from gripmon.monitor.core import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.tracker import CORNER_COUNTS, Tracker
from gripmon.monitor.warming import warm_up
from gripmon.monitor.weigher import foresee_protection

__all__ = ["CORNER_COUNTS", "Monitor", "MonitorSettings", "Tracker", "foresee_protection", "warm_up"]
