"""Opens everything that a configuration names: a running monitor with its network, source, recording and state."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from gripmon.daemon.api import Monitor, look_ahead, open_configured, unlike_light
from gripmon.daemon.config import Config, ConfigError, load_config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.daemon.config.recorded import to_recorded
from gripmon.daemon.config.typed import faults_of
from gripmon.daemon.forecast import limits_warning
from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.network import Network
from gripmon.daemon.running import run
from gripmon.daemon.service import log_to_stderr
from gripmon.io.sources import Source
from gripmon.judge.statefile import StateFile
from gripmon.model.atomic import writable_folder, writing
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


@dataclass(frozen=True)
class RunOptions:
    """How a configuration is run.

    ``out``: a folder for ``estimates.jsonl`` and the recording.  ``stop``: from
    :func:`gripmon.model.stopping.signals_exit`, inside which a program with a terminal runs it.  ``keep_state``: the
    state that survives a restart is read from the configuration's state file, unless ``fresh_state``, and written
    there; and a warning is logged if the view can't meet the alert limits.  ``view``: show it live, "auto", "web",
    "native" or "server"; ``take_over``: see :class:`gripmon.daemon.network.Network`.  ``on_network`` is called when the
    publisher is open, before the camera is; ``truth_tcp_m``, of a simulation: the TCP's true position in the camera
    frame for a frame's ``seq``, for the recording.
    """

    out: Path | None = None
    stop: StopRequest | None = None
    duration_s: float | None = None
    keep_state: bool = True
    fresh_state: bool = False
    view: str | None = None
    take_over: bool = False
    on_network: Callable[[], None] = lambda: None
    recording_name: str | None = None
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None = None


def run_file(path: Path, options: RunOptions, *, verbose: bool = False, log_json: bool = False) -> int:
    """Run the daemon on a configuration file; returns the exit code.  The folder for output is created if missing;
    ``verbose`` and ``log_json``: see :func:`gripmon.daemon.service.log_to_stderr`.
    """
    config = load_config(path)
    look_ahead(config)
    if options.out is not None:
        lines = writable_folder(options.out) / "estimates.jsonl"
        with writing(lines, "out"):
            lines.open("ab").close()
    log_to_stderr(verbose=verbose, as_json=log_json)
    return run_monitor(config, options)


def run_monitor(config: Config, options: RunOptions) -> int:
    """Open everything that a configuration names and run the daemon on it; returns the exit code.

    Raises :class:`InputError` for anything that can't be opened as configured or written.
    """
    settings, out = config.settings, options.out
    cv2.setNumThreads(1)
    if options.keep_state:
        _warn(config)
    live = None if options.view is None else LiveView(settings.view, options.view, config.path)
    with contextlib.ExitStack() as viewed, contextlib.ExitStack() as opened:
        kept = _open_state(config, opened, fresh=options.fresh_state) if options.keep_state else None
        if kept is not None:
            config = dataclasses.replace(config, reference=kept.configured)
        keeper = StateKeeper(kept)
        monitor = _monitor(config, None if kept is None else kept.state, keeper)
        network = Network(config, take_over=options.take_over)
        opened.callback(network.close)
        options.on_network()
        source = _open_source(config, network)
        opened.callback(source.close)
        recorder = _open_recorder(
            config, out, source, live, camera=config.camera, gripper=config.gripper, reference=monitor.reference,
            name=options.recording_name, truth_tcp_m=options.truth_tcp_m,
            configuration=to_recorded(config, None if kept is None else kept.state),
        )  # fmt: skip
        opened.callback(recorder.close)
        if live is not None:
            live.open(viewed)
        opened.pop_all()  # from here on the daemon closes them
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
            duration_s=options.duration_s,
            stop=options.stop,
            outlines=partial(_outlines, config),
            odd_about=partial(unlike_light, config),
        )


def _warn(config: Config) -> None:
    """Log why no transform may be valid, or none as good as it claims."""
    if (text := limits_warning(config)) is not None:
        _log.warning("%s", text)
    if (text := reference_doubt(config.settings)) is not None:
        _log.warning("%s: %s", config.path, text)


def _monitor(config: Config, state: MonitorState | None, keeper: StateKeeper) -> Monitor:
    """The monitor as it was left, with a line for what couldn't be taken up again."""
    monitor = Monitor(config, state, keeper.references)
    for refused in (monitor.strips_refused, monitor.since_refused):
        if refused is not None:
            _log.warning("%s", refused)
    return monitor


def _open_source(config: Config, network: Network) -> Source:
    """The source of frames, once the code that processes them is compiled."""
    compiled = warm_up()
    # The loop's own collection skips what was made so far; collecting that first took 0.06 s and freed nothing.
    gc.freeze()
    source = open_configured(config, network.link)
    if compiled:
        _log.info("%s", compiled)
    network.report_on(source)
    return source


def _outlines(config: Config, cam_T_grip: Array | None, jaw_opening_m: float | None) -> Outlines:
    from gripmon.daemon.overlay import outlines_of  # the drawing code is loaded only when needed

    return outlines_of(config.camera, config.gripper, cam_T_grip, jaw_opening_m)


def _open_state(config: Config, opened: contextlib.ExitStack, *, fresh: bool) -> StateFile | None:
    """The state file, which ``opened`` closes; None without one."""
    path = config.state_path
    if path is None:
        return None
    with faults_of(config.path, "state.file: "):
        kept = StateFile(path, config.state_owner, config.reference, fresh=fresh)
    opened.callback(kept.close)
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
