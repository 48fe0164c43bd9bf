"""Opens everything that a configuration names: a running monitor with its network, source, recording and state."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from gripmon.daemon.api import Monitor, look_ahead, open_configured, unlike_light
from gripmon.daemon.config import Config, ConfigError, load_config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.daemon.config.recorded import to_recorded
from gripmon.daemon.forecast import limits_warning
from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.network import Network
from gripmon.daemon.running import run
from gripmon.daemon.service import log_to_stderr
from gripmon.io.sources import Source
from gripmon.judge.statefile import StateFile, StateFileError
from gripmon.model.atomic import writable_folder
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.records import Alert, AlertKind, Array, Cause, MonitorState, Outlines, Severity
from gripmon.model.stopping import StopRequest
from gripmon.monitor import warm_up
from gripmon.record.recorder import RECORDING_PATIENCE_S, Recorder, ViewSettings
from gripmon.record.viewer import NativeViewer, ViewerError, WebPage, has_display, is_free
from gripmon.record.write import open_recorder

_log = logging.getLogger(__name__)

_SERVER_STARTS_S = 60.0
_LOOK_EVERY_S = 0.1


def run_file(
    path: Path,
    *,
    out: Path | None,
    stop: StopRequest,
    duration_s: float | None = None,
    verbose: bool = False,
    log_json: bool = False,
    fresh_state: bool = False,
    view: str | None = None,
    take_over: bool = False,
) -> int:
    """Run the daemon on a configuration file; returns the exit code.

    ``out``: a folder for the recording and ``estimates.jsonl``, created if missing.  ``view``:
    "auto", "web", "native" or "server"; ``verbose`` and ``log_json``: see
    :func:`gripmon.daemon.service.log_to_stderr`; the rest as in :func:`run_monitor`.
    """
    config = load_config(path)
    look_ahead(config)
    if out is not None:
        lines = writable_folder(out) / "estimates.jsonl"
        try:
            lines.open("ab").close()
        except OSError as error:
            raise InputError(f"{lines}: can't be written ({error.strerror}); a file", "out") from None
    log_to_stderr(verbose=verbose, as_json=log_json)
    return run_monitor(
        config, out=out, stop=stop, duration_s=duration_s, keep_state=True, fresh_state=fresh_state,
        view=view, take_over=take_over,
    )  # fmt: skip


def run_monitor(
    config: Config,
    *,
    out: Path | None,
    stop: StopRequest | None = None,
    duration_s: float | None = None,
    recording_name: str | None = None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None = None,
    on_network: Callable[[], None] = lambda: None,
    keep_state: bool = False,
    fresh_state: bool = False,
    view: str | None = None,
    take_over: bool = False,
) -> int:
    """Open everything that a configuration names and run the daemon on it; returns the exit code.

    ``out``: a folder for ``estimates.jsonl`` and the recording.  ``stop``: from
    :func:`gripmon.model.stopping.signals_exit`, inside which a program with a terminal calls this.  ``truth_tcp_m``, of
    a simulation: the TCP's true position in the camera frame for a frame's ``seq``, for the recording.  ``on_network``
    is called when the publisher is open, before the camera is.  ``keep_state``: the state that survives a restart is
    read from the configuration's state file, unless ``fresh_state``, and written there; and a warning is logged if the
    view can't meet the alert limits.  ``view``: show it live; ``take_over``: see
    :class:`gripmon.daemon.network.Network`.

    Raises :class:`InputError` for anything that can't be opened as configured or written to ``out``.
    """
    settings = config.settings
    cv2.setNumThreads(1)
    if keep_state and (text := limits_warning(config)) is not None:
        _log.warning("%s", text)
    if keep_state and (text := reference_doubt(settings)) is not None:
        _log.warning("%s: %s", config.path, text)
    live = None if view is None else LiveView(settings.view, view, config.path)
    with contextlib.ExitStack() as viewed, contextlib.ExitStack() as opened:
        kept = _open_state(config, fresh=fresh_state) if keep_state else None
        if kept is not None:
            opened.callback(kept.close)
            config = dataclasses.replace(config, reference=kept.configured)
        state = None if kept is None else kept.state
        keeper = StateKeeper(kept)
        monitor = Monitor(config, state, keeper.references)
        for refused in (monitor.strips_refused, monitor.since_refused):
            if refused is not None:
                _log.warning("%s", refused)
        network = Network(config, take_over=take_over)
        opened.callback(network.close)
        on_network()
        compiled = warm_up()  # before the first frame
        # The loop's own collection skips what was made so far; collecting that first took 0.06 s and freed nothing.
        gc.freeze()
        source = open_configured(config, network.link)
        opened.callback(source.close)
        if compiled:
            _log.info("%s", compiled)
        recorder = _open_recorder(
            config, out, source, live, camera=config.camera, gripper=config.gripper, reference=monitor.reference,
            name=recording_name, truth_tcp_m=truth_tcp_m, configuration=to_recorded(config, state),
        )  # fmt: skip
        opened.callback(recorder.close)
        if live is not None:
            live.open(viewed)
        opened.pop_all()  # from here on the daemon closes them
        network.report_on(source)
        return run(
            monitor,
            source=source,
            outputs=network.outputs,
            recorder=recorder,
            settings=settings.daemon,
            robot=settings.robot,
            camera=settings.camera_name,
            estimates=None if out is None else out / "estimates.jsonl",
            jaw=network.jaw,
            keeper=keeper,
            commands=network.commands,
            reports=network.reports,
            notices=_notices(kept),
            duration_s=duration_s,
            stop=stop,
            outlines=lambda transform, opening_m: _outlines(config, transform, opening_m),
            odd_about=lambda image: unlike_light(config, image),
        )


def _outlines(config: Config, cam_T_grip: Array | None, jaw_opening_m: float | None) -> Outlines:
    from gripmon.daemon.overlay import outlines_of  # the drawing code is loaded only when needed

    return outlines_of(config.camera, config.gripper, cam_T_grip, jaw_opening_m)


def _open_state(config: Config, *, fresh: bool) -> StateFile | None:
    """The state file; None without one."""
    path = config.state_path
    if path is None:
        return None
    try:
        kept = StateFile(path, config.state_owner, config.reference, fresh=fresh)
    except StateFileError as error:
        raise ConfigError(config.path, "state.file", str(error)) from None
    if kept.configured.revision != config.reference.revision:
        # The file that knew the revisions was set aside, and what follows may fail, e.g. opening the camera.
        kept.write(MonitorState((kept.configured,)))
    return kept


def _notices(kept: StateFile | None) -> list[Alert]:
    """Findings at the start, as alerts."""
    texts = () if kept is None else kept.notices
    return [Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.WARNING, text) for text in texts]


def _open_recorder(
    config: Config, out: Path | None, source: Source, live: LiveView | None, **recorded: Any
) -> Recorder:
    """``recorded``: arguments of :func:`gripmon.record.write.open_recorder`."""
    settings, patience_s = config.settings, 0.0 if source.live else RECORDING_PATIENCE_S
    view = None if live is None else live.settings
    try:
        return open_recorder(
            settings.recording, robot=settings.robot, camera_name=settings.camera_name, directory=out,
            patience_s=patience_s, view=view, **recorded,
        )  # fmt: skip
    except OSError as error:
        if out is not None:
            raise InputError(f"{out}: can't be written ({error.strerror or error}); another folder") from None
        wrong = f"{config.settings.recording.directory} can't be made ({error.strerror})"
        raise ConfigError(config.path, "recording.directory", wrong, "a folder that may be written") from None


class LiveView:
    """A viewer for the stream that the recording serves."""

    def __init__(self, settings: ViewSettings, kind: str, config_path: Path) -> None:
        """Raises :class:`InputError` if it can't be shown."""
        self.settings = settings
        self._native = kind == "native" or (kind == "auto" and has_display())
        self._web = kind == "web" or (kind == "auto" and not has_display())
        if kind == "native" and not has_display():
            raise InputError("native: there is no display; web", "view")
        ports = [("port", settings.port)] + [("web_port", settings.web_port)] * self._web
        for key, port in ports:
            if not is_free(port):
                raise ConfigError(config_path, f"view.{key}", f"{port} is in use on 127.0.0.1", "another port")

    def open(self, opened: contextlib.ExitStack) -> None:
        """Start the viewer, which shows the stream as soon as it exists; a web page ends with ``opened``."""
        url = self.settings.stream_url
        if self._web:
            try:
                page = WebPage(self.settings.web_port, [url])
            except ViewerError as error:
                raise NoResultError(f"--view web: {error}") from None
            opened.callback(page.close)
            _log.info("live view: %s", page.url)
        _log.info("live view: rerun viewers connect to %s", url)
        if self._native:
            threading.Thread(target=self._open_window, name="viewer", daemon=True).start()

    def _open_window(self) -> None:
        """Start the viewer when there is a server, without which it exits.  The window belongs to the user: it stays
        until it is closed.
        """
        end_s = time.monotonic() + _SERVER_STARTS_S
        while is_free(self.settings.port):
            if time.monotonic() > end_s:
                return
            time.sleep(_LOOK_EVERY_S)
        try:
            NativeViewer([self.settings.stream_url], tied=False)
        except ViewerError as error:
            _log.error("no window for the live view: %s", error)
