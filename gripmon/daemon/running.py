"""The live monitor: newest frame in, transform out, everything supervised, a clean stop.

One thread runs the loop; the source, Zenoh and the recording have their own threads and processes.
"""

from __future__ import annotations

import contextlib
import gc
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Unpack

from gripmon.daemon.estimates import EstimatesFile
from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.loop import Daemon
from gripmon.daemon.neighbours import JawFeed, Reports
from gripmon.daemon.snapshots import OutlinesOf, Snapshots, no_outlines
from gripmon.daemon.supervised import Parts
from gripmon.daemon.watch import DaemonSettings
from gripmon.model.records import Image
from gripmon.model.stopping import StopRequest, signals_request
from gripmon.monitor import Monitor

_UNHURRIED_S = 10.0  # for the recording, if no stop was requested
_SHORTEST_CLOSE_S = 0.5
_SWITCH_INTERVAL_S = 0.0005


def run(
    monitor: Monitor,
    *,
    estimates: Path | None = None,
    jaw: JawFeed | None = None,
    keeper: StateKeeper | None = None,
    duration_s: float | None = None,
    outlines: OutlinesOf = no_outlines,
    odd_about: Callable[[Image], str | None] = lambda _: None,
    **parts: Unpack[Parts],
) -> int:
    """Run until the source ends, ``duration_s`` is over, or a signal arrives; then close everything that was passed in.

    In the main thread it handles SIGINT and SIGTERM while it runs.  ``estimates``: a file that gets one JSON line per
    frame; raises OSError if it can't be opened.  ``jaw``, if given, replaces the frames' own jaw opening.  ``keeper``
    stores the monitor's state for a restart.  ``reports``: additional values of the state message; ``notices``: alerts
    from the start-up; ``stop``: a stop request from the start-up (:func:`gripmon.model.stopping.signals_exit`);
    ``outlines``: the gripper's outlines for snapshots; ``odd_about``: what the log says of the first image.  The logger
    ``gripmon`` is left as the caller set it up (see :func:`gripmon.daemon.service.log_to_stderr`).

    Returns the exit code: 0 the source ended, the time was over, or SIGTERM; 3 no usable frame, the source failed, or
    internal errors persisted; 130 SIGINT.
    """
    with _closing(parts, estimates, jaw, keeper, outlines):
        return Daemon(monitor, jaw=jaw, keeper=keeper, odd_about=odd_about, **parts).run(duration_s)


@contextlib.contextmanager
def _closing(
    parts: Parts,
    lines: Path | None,
    jaw: JawFeed | None = None,
    keeper: StateKeeper | None = None,
    outlines: OutlinesOf = no_outlines,
) -> Iterator[None]:
    """Adds the file for lines to the outputs, and the faults of all these and the snapshots to ``parts``.

    Signals request a stop.  Everything is closed in any case, which a second signal can't interrupt.
    """
    recorder, settings = parts["recorder"], parts["settings"]
    stop = parts["stop"] = parts.get("stop") or StopRequest()
    with signals_request(stop), contextlib.ExitStack() as closing:
        # All of these run, in reverse order.
        if keeper is not None:
            closing.callback(keeper.close)
        for output in parts["outputs"]:  # closed in reverse order: the link last
            closing.callback(output.close)
        closing.callback(lambda: recorder.close(timeout_s=_time_to_close_s(stop, settings)))
        closing.callback(parts["source"].close)
        file = None if lines is None else EstimatesFile(lines, settings.estimates_budget_bytes)
        if file is not None:
            closing.callback(file.close)
            parts["outputs"] = (*parts["outputs"], file)
        parts["snapshots"] = closing.enter_context(contextlib.closing(Snapshots(outlines)))
        faults: list[Callable[[], str | None]] = [] if jaw is None else [jaw.fault]
        faults += [lambda: recorder.failure]
        faults += [] if file is None else [lambda: file.failure]
        faults += [] if keeper is None else [lambda: keeper.failure]
        reports = parts.get("reports") or Reports()
        parts["reports"] = replace(reports, faults=(*faults, *reports.faults))
        with _steady_interpreter():
            yield


def _time_to_close_s(stop: StopRequest, settings: DaemonSettings) -> float:
    if stop.requested_s is None:
        return _UNHURRIED_S
    return max(_SHORTEST_CLOSE_S, stop.requested_s + settings.stop_within_s - time.monotonic())


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
