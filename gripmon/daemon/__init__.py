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
    "EXIT_DONE": "gripmon.model.stopping",
    "EXIT_FAILED": "gripmon.daemon.supervised",
    "EXIT_INTERRUPTED": "gripmon.model.stopping",
    "CommandFeed": "gripmon.daemon.neighbours",
    "Daemon": "gripmon.daemon.loop",
    "DaemonSettings": "gripmon.daemon.settings",
    "EstimatesFile": "gripmon.daemon.estimates",
    "JawFeed": "gripmon.daemon.neighbours",
    "MonitorLike": "gripmon.daemon.neighbours",
    "PulseFeed": "gripmon.daemon.neighbours",
    "Reports": "gripmon.daemon.neighbours",
    "SecondCamera": "gripmon.daemon.second",
    "StateKeeper": "gripmon.daemon.keeping",
    "StopRequest": "gripmon.model.stopping",
    "log_to_stderr": "gripmon.daemon.running",
    "run": "gripmon.daemon.running",
    "run_second": "gripmon.daemon.running",
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
    return getattr(importlib.import_module(_WHERE[name]), name)
