"""Everything that a configuration names, opened: a running monitor with its network, source, recording and state."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import cv2

from gripmon.daemon.api import Monitor
from gripmon.daemon.camera_source import open_source
from gripmon.daemon.config import Config, ConfigError
from gripmon.daemon.config.recorded import to_recorded
from gripmon.daemon.forecast import limits_warning
from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.network import open_network, with_metrics, with_source
from gripmon.daemon.running import log_to_stderr, run
from gripmon.judge.statefile import StateFile, StateFileError
from gripmon.model.errors import InputError
from gripmon.model.records import Alert, AlertKind, Cause, MonitorState, Severity
from gripmon.model.stopping import StopRequest
from gripmon.record.write import Recorder, ViewSettings, open_recorder

_log = logging.getLogger(__name__)

RECORDING_PATIENCE_S = 30.0
"""Images that can wait outrun any camera: they wait so long for the recording, none is dropped (s)."""


class LiveView(Protocol):
    """What shows the stream that the recording serves, until ``opened`` is closed."""

    settings: ViewSettings

    def open(self, opened: contextlib.ExitStack) -> None: ...


def run_monitor(
    config: Config,
    *,
    out: Path | None,
    stop: StopRequest | None = None,
    duration_s: float | None = None,
    verbose: bool = False,
    recording_name: str | None = None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None = None,
    on_network: Callable[[], None] = lambda: None,
    warns: bool = False,
    keep_state: bool = False,
    fresh_state: bool = False,
    view: LiveView | None = None,
    take_over: bool = False,
) -> int:
    """Open everything that a configuration names and run the daemon on it; returns the exit code.

    ``out`` is a folder for ``estimates.jsonl`` and the recording.  ``stop``: from
    :func:`gripmon.model.stopping.signals_exit`, in which a program with a terminal calls this.  ``truth_tcp_m``, which
    a simulation has, gives the TCP's true position in the camera frame for a frame's ``seq``; it goes into the
    recording.  ``on_network`` is called when the publisher is open, before the camera is.  ``warns``: it is logged when
    the view can't keep the alert limits.  ``keep_state``: what survives a restart is read from the configuration's
    state file, unless ``fresh_state``, and kept there.  ``view`` shows it live; ``take_over``: see
    :func:`gripmon.daemon.network.open_network`.

    Raises :class:`InputError` for what can't be opened as configured or written to ``out``.
    """
    settings = config.settings
    estimates = None if out is None else out / "estimates.jsonl"
    cv2.setNumThreads(1)
    log_to_stderr(verbose=verbose)
    if warns and (text := limits_warning(config)) is not None:
        _log.warning("%s", text)
    with contextlib.ExitStack() as viewed, contextlib.ExitStack() as opened:
        kept = _open_state(config, fresh=fresh_state) if keep_state else None
        if kept is not None:
            opened.callback(kept.close)
            config = dataclasses.replace(config, reference=kept.configured)
        state = None if kept is None else kept.state
        keeper = StateKeeper(kept)
        monitor = Monitor(config, state, keeper.references)
        if monitor.look_refused is not None:
            _log.warning("%s", monitor.look_refused)
        network = open_network(config, take_over=take_over)
        opened.callback(network.publisher.close)
        publisher = with_metrics(config, network.publisher)
        opened.callback(publisher.close)
        on_network()
        source = open_source(config, network.link)
        opened.callback(source.close)
        patience_s = 0.0 if source.live else RECORDING_PATIENCE_S
        recorder = _open_recorder(config, monitor, state, out, recording_name, truth_tcp_m, view, patience_s)
        opened.callback(recorder.close)
        if view is not None:
            view.open(viewed)
        opened.pop_all()  # from here on the daemon closes them
        return run(
            monitor,
            source,
            publisher,
            recorder,
            settings.daemon,
            robot=settings.robot,
            camera=settings.camera_name,
            estimates=estimates,
            jaw=network.jaw,
            keeper=keeper,
            commands=network.commands,
            reports=dataclasses.replace(
                with_source(network.reports, source), alert_limit_m=settings.monitor.policy.alert_limit_m
            ),
            notices=_notices(kept),
            duration_s=duration_s,
            stop=stop,
        )


def _open_state(config: Config, *, fresh: bool) -> StateFile | None:
    """The file for what survives a restart; None without one."""
    path = config.state_path
    if path is None:
        return None
    try:
        kept = StateFile(path, config.state_owner, config.reference, fresh=fresh)
    except StateFileError as error:
        raise ConfigError(config.path, "state.file", str(error)) from None
    if kept.configured.revision != config.reference.revision:
        # The one who knew the revisions so far was set aside, and what follows may fail: a camera that can't be opened.
        kept.write(MonitorState((kept.configured,)))
    return kept


def _notices(kept: StateFile | None) -> list[Alert]:
    """What was found at the start, as alerts."""
    texts = () if kept is None else kept.notices
    return [Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.WARNING, text) for text in texts]


def _open_recorder(
    config: Config,
    monitor: Monitor,
    state: MonitorState | None,
    out: Path | None,
    name: str | None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None,
    view: LiveView | None,
    patience_s: float,
) -> Recorder:
    settings = config.settings
    try:
        configuration = to_recorded(config, state)
    except OSError as error:
        raise ConfigError(config.path, "", f"{error.filename}: can't be read any more ({error.strerror})") from None
    try:
        return open_recorder(
            settings.recording,
            robot=settings.robot,
            camera_name=settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=monitor.reference,
            directory=out,
            name=name,
            truth_tcp_m=truth_tcp_m,
            patience_s=patience_s,
            configuration=configuration,
            view=None if view is None else view.settings,
        )
    except OSError as error:
        if out is not None:
            raise InputError(f"{out}: can't be written ({error.strerror or error}); another folder") from None
        wrong = f"{settings.recording.directory} can't be made ({error.strerror})"
        raise ConfigError(config.path, "recording.directory", wrong, "a folder that may be written") from None
