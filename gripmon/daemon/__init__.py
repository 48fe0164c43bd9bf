"""From a configuration to a running monitor: the configuration, what opens all that it names, the supervised loop.

The names are imported when they are first used: whoever only reads a configuration (:mod:`gripmon.daemon.config`)
needs neither Zenoh nor rerun.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gripmon.daemon.estimates import EstimatesFile
    from gripmon.daemon.keeping import StateKeeper
    from gripmon.daemon.loop import Daemon
    from gripmon.daemon.neighbours import CommandFeed, JawFeed, MonitorLike, PulseFeed, Reports
    from gripmon.daemon.running import log_to_stderr, run, run_second
    from gripmon.daemon.second import SecondCamera
    from gripmon.daemon.settings import DaemonSettings
    from gripmon.daemon.supervised import EXIT_FAILED
    from gripmon.model.stopping import EXIT_DONE, EXIT_INTERRUPTED, StopRequest

_WHERE = {
    "EXIT_DONE": "running",
    "EXIT_FAILED": "supervised",
    "EXIT_INTERRUPTED": "running",
    "CommandFeed": "neighbours",
    "Daemon": "loop",
    "DaemonSettings": "settings",
    "EstimatesFile": "estimates",
    "JawFeed": "neighbours",
    "MonitorLike": "neighbours",
    "PulseFeed": "neighbours",
    "Reports": "neighbours",
    "SecondCamera": "second",
    "StateKeeper": "keeping",
    "StopRequest": "running",
    "log_to_stderr": "running",
    "run": "running",
    "run_second": "running",
}

__all__ = [
    "EXIT_DONE",
    "EXIT_FAILED",
    "EXIT_INTERRUPTED",
    "CommandFeed",
    "Daemon",
    "DaemonSettings",
    "EstimatesFile",
    "JawFeed",
    "MonitorLike",
    "PulseFeed",
    "Reports",
    "SecondCamera",
    "StateKeeper",
    "StopRequest",
    "log_to_stderr",
    "run",
    "run_second",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'gripmon.daemon' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gripmon.daemon.{_WHERE[name]}"), name)
