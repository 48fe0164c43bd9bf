"""The live monitor: newest frame in, transform out, everything supervised, a clean stop.

One thread runs the loop; the source, Zenoh and the recording have their own threads and processes.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from gripmon.daemon.estimates import EstimatesFile
from gripmon.daemon.loop import Daemon
from gripmon.daemon.snapshots import Snapshots
from gripmon.daemon.telling import Parts
from gripmon.daemon.watch import DaemonSettings
from gripmon.model.priority import real_time
from gripmon.model.stopping import StopRequest, signals_request
from gripmon.monitor import Monitor

_log = logging.getLogger(__name__)

_UNHURRIED_S = 10.0  # for the recording, if no stop was requested
_SHORTEST_CLOSE_S = 0.5
_SWITCH_INTERVAL_S = 0.0005


def run(
    monitor: Monitor, *, estimates: Path | None = None, duration_s: float | None = None, **parts: Any
) -> int:
    """Run until the source ends, ``duration_s`` is over, or a signal arrives; then close everything that was passed in.

    In the main thread it handles SIGINT and SIGTERM while it runs.  ``estimates``: a file that gets one JSON line per
    frame; raises OSError if it can't be opened.  ``parts``: those of :class:`gripmon.daemon.telling.Parts`, None for a
    default.  The logger ``gripmon`` is left as the caller set it up (see :func:`gripmon.daemon.service.log_to_stderr`).

    Returns the exit code: 0 the source ended, the time was over, or SIGTERM; 3 no usable frame, the source failed, or
    internal errors persisted; 130 SIGINT.
    """
    given = Parts(**{name: part for name, part in parts.items() if part is not None})
    with _closing(given, estimates) as (whole, snapshots):
        return Daemon(monitor, whole, snapshots).run(duration_s)


@contextlib.contextmanager
def _closing(parts: Parts, lines: Path | None) -> Iterator[tuple[Parts, Snapshots]]:
    """The parts, with the file for lines among the outputs and the faults of all these among the reports.

    Signals request a stop.  Everything is closed in any case, which a second signal can't interrupt.
    """
    recorder, settings, keeper, jaw = parts.recorder, parts.settings, parts.keeper, parts.jaw
    with signals_request(parts.stop), contextlib.ExitStack() as closing:
        # All of these run, in reverse order.
        closing.callback(keeper.close)
        for output in parts.outputs:  # closed in reverse order: the link last
            closing.callback(output.close)
        closing.callback(lambda: recorder.close(timeout_s=_time_to_close_s(parts.stop, settings)))
        closing.callback(parts.source.close)
        faults: list[Callable[[], str | None]] = [] if jaw is None else [jaw.fault]
        faults.append(lambda: recorder.failure)
        outputs = list(parts.outputs)
        if lines is not None:
            file = EstimatesFile(lines, settings.estimates_budget_bytes)
            closing.callback(file.close)
            outputs.append(file)
            faults.append(lambda: file.failure)
        faults.append(lambda: keeper.failure)
        snapshots = closing.enter_context(contextlib.closing(Snapshots(parts.outlines)))
        reports = replace(parts.reports, faults=[*faults, *parts.reports.faults])
        with _steady_interpreter(), _prioritised(settings):
            yield replace(parts, outputs=outputs, reports=reports), snapshots


def _time_to_close_s(stop: StopRequest, settings: DaemonSettings) -> float:
    if stop.requested_s is None:
        return _UNHURRIED_S
    return max(_SHORTEST_CLOSE_S, stop.requested_s + settings.stop_within_s - time.monotonic())


@contextlib.contextmanager
def _prioritised(settings: DaemonSettings) -> Iterator[None]:
    """With real-time priority where the settings ask for it; the log says what the system gave."""
    if not settings.real_time:
        yield
        return
    with real_time() as (given, said):
        _log.log(logging.INFO if given else logging.WARNING, "%s", said)
        yield


@contextlib.contextmanager
def _steady_interpreter() -> Iterator[None]:
    """Avoid unexpected pauses: the loop collects garbage itself, and other threads yield sooner."""
    interval_s, collected = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.freeze()  # later collections skip the objects created at start-up
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
        gc.unfreeze()
        if collected:
            gc.enable()
