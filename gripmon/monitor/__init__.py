"""The per-frame method."""

from gripmon.monitor.anchor import foresee_protection
from gripmon.monitor.core import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.tracker import CORNER_COUNTS, Tracker

__all__ = ["CORNER_COUNTS", "Monitor", "MonitorSettings", "Tracker", "foresee_protection"]
