"""``gripmon run``: the daemon."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import camera_source, common, promising, second_run, viewing
from gripmon.model.stopping import StopRequest, signals_exit

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.judge.statefile import StateFile
    from gripmon.model.records import Alert, MonitorState
    from gripmon.monitor import Monitor
    from gripmon.record.write import Recorder

_log = logging.getLogger(__name__)

_DESCRIPTION = """\
Watch a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
interrupted (Ctrl-C or SIGTERM).  A camera that is missing or goes away is tried again for ever, and
the state on the network says so.

The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
that state.file names: a live camera's in ~/.local/state/gripmon.  After a restart the monitor goes on
from the last reference, checks in the picture that it still fits, and says so (alert restarted).

A configuration with a section laser is that of a second camera, beside the robot: its calibration is
tested with every pulse of a laser pointer on the arm, which the robot's program tells
(docs/howto/laser.md, Watching)."""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     begin anew; the kept state is set aside
  gripmon send undo --robot arm1                         back to the reference before
  gripmon run configs/live_camera.yaml --view web        watch it live in a browser, on this machine

  gripmon run configs/second_camera.yaml                 a fixed camera, watched with a pulsed laser

Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}; a second
camera's on {spot,state,alert}, and it hears pulses on …/pulse.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, pulses of which none showed its spot, or an internal error that persisted; 4 another
monitor of this robot and camera is on the network; 130 Ctrl-C"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "run", run, "the daemon: watch a camera, publish and record", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("config", metavar="CONFIG", help="configuration file (YAML)")
    parser.add_argument(
        "--duration", type=common.positive_number, metavar="S", help="stop after so many seconds (s); default: never"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="put the recording and estimates.jsonl (one JSON line a frame; spots.jsonl, a line a pulse) here; made if "
        "it is missing, and what is there is kept (estimates-1.jsonl …) within daemon.estimates_budget_bytes",
    )
    parser.add_argument(
        "--fresh-state",
        action="store_true",
        help="start from the configured reference; a kept state is set aside as <file>.replaced-<n>",
    )
    parser.add_argument(
        "--take-over",
        action="store_true",
        help="start also where another monitor of this robot and camera is on the network; nothing is usable until "
        "one of the two is stopped",
    )
    viewing.add_option(parser)
    parser.add_argument("--verbose", action="store_true", help="say more on stderr")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon run``."""
    with signals_exit() as stop:
        return _run(arguments, stop)


def _run(arguments: argparse.Namespace, stop: StopRequest) -> int:
    second = second_run.load(arguments.config)
    if second is not None:
        if arguments.fresh_state:
            text = f"run: --fresh-state is for wrist cameras, {arguments.config} is a second camera's; leave it out"
            raise common.CommandFailedError(text, common.EXIT_USAGE)
        out = None if arguments.out is None else common.make_directory(Path(arguments.out))
        return second_run.run_second(
            second,
            out=out,
            duration_s=arguments.duration,
            verbose=arguments.verbose,
            view=arguments.view,
            take_over=arguments.take_over,
            stop=stop,
        )
    config = common.load(arguments.config)
    camera_source.look_ahead(config)
    out = None if arguments.out is None else common.make_directory(Path(arguments.out))
    return run_daemon(
        config,
        out=out,
        duration_s=arguments.duration,
        verbose=arguments.verbose,
        warns=True,
        keep_state=True,
        fresh_state=arguments.fresh_state,
        view=arguments.view,
        take_over=arguments.take_over,
        stop=stop,
    )


def run_daemon(
    config: Config,
    *,
    out: Path | None,
    stop: StopRequest,
    duration_s: float | None = None,
    verbose: bool = False,
    recording_name: str | None = None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None = None,
    on_network: Callable[[], None] = lambda: None,
    warns: bool = False,
    keep_state: bool = False,
    fresh_state: bool = False,
    view: str | None = None,
    take_over: bool = False,
) -> int:
    """Open everything that a configuration names and run the daemon on it; returns the exit code.

    ``stop``: from :func:`gripmon.model.stopping.signals_exit`, in which this is called.
    ``truth_tcp_m``, which a simulation has, gives the TCP's true position in the camera frame for a frame's ``seq``; it
    goes into the recording.  ``on_network`` is called when the publisher is open, before the camera is.
    ``warns``: it is logged when the view can't keep the alert limits.  ``keep_state``: what survives a restart is read
    from the configuration's state file, unless ``fresh_state``, and kept there.  ``view`` is one of
    :data:`gripmon.cli.viewing.KINDS`; ``take_over``: see :func:`gripmon.cli.network.open_network`.
    """
    import cv2

    from gripmon import daemon
    from gripmon.cli.network import open_network, with_metrics, with_source
    from gripmon.monitor import Monitor

    settings = config.settings
    estimates = None if out is None else out / "estimates.jsonl"
    if estimates is not None:
        common.check_file(estimates)
    cv2.setNumThreads(1)
    daemon.log_to_stderr(verbose=verbose)
    if warns and (said := promising.warning(config)) is not None:
        _log.warning("%s", said)
    live = None if view is None else viewing.LiveView(settings.view, view, str(config.path))
    with contextlib.ExitStack() as viewed, contextlib.ExitStack() as opened:
        kept = _open_state(config, fresh=fresh_state) if keep_state else None
        if kept is not None:
            opened.callback(kept.close)
            config = dataclasses.replace(config, reference=kept.configured)
        state = None if kept is None else kept.state
        keeper = daemon.StateKeeper(kept)
        monitor = Monitor(
            config.camera, config.gripper, settings.monitor, config.reference, config.taught_edges, state,
            keeper.references,
        )  # fmt: skip
        if monitor.look_refused is not None:
            _log.warning("%s", monitor.look_refused)
        network = open_network(config, take_over=take_over)
        opened.callback(network.publisher.close)
        publisher = with_metrics(config, network.publisher)
        opened.callback(publisher.close)
        on_network()
        source = camera_source.open_source(config, network.link)
        opened.callback(source.close)
        patience_s = 0.0 if source.live else common.RECORDING_PATIENCE_S
        recorder = _open_recorder(config, monitor, state, out, recording_name, truth_tcp_m, live, patience_s)
        opened.callback(recorder.close)
        if live is not None:
            live.open(viewed)
        opened.pop_all()  # from here on the daemon closes them
        return daemon.run(
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
    from gripmon.judge.statefile import StateFile, StateFileError
    from gripmon.model.records import MonitorState

    path = config.state_path
    if path is None:
        return None
    try:
        kept = StateFile(path, config.state_owner, config.reference, fresh=fresh)
    except StateFileError as error:
        raise common.CommandFailedError(f"{config.path}: state.file: {error}", common.EXIT_USAGE) from None
    if kept.configured.revision != config.reference.revision:
        # The one who knew the revisions so far was set aside, and what follows may fail: a camera that can't be opened.
        kept.write(MonitorState((kept.configured,)))
    return kept


def _notices(kept: StateFile | None) -> list[Alert]:
    """What was found at the start, as alerts."""
    from gripmon.model.records import Alert, AlertKind, Cause, Severity

    texts = () if kept is None else kept.notices
    return [Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.WARNING, text) for text in texts]


def _open_recorder(
    config: Config,
    monitor: Monitor,
    state: MonitorState | None,
    out: Path | None,
    name: str | None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None,
    live: viewing.LiveView | None,
    patience_s: float,
) -> Recorder:
    from gripmon.daemon.config.recorded import to_recorded
    from gripmon.record.write import open_recorder

    settings = config.settings
    try:
        configuration = to_recorded(config, state)
    except OSError as error:
        text = f"{config.path}: {error.filename}: can't be read any more ({error.strerror})"
        raise common.CommandFailedError(text, common.EXIT_USAGE) from None
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
            view=None if live is None else live.settings,
        )
    except OSError as error:
        if out is not None:
            raise common.not_writable(out, error) from None
        raise common.CommandFailedError(
            f"{config.path}: recording.directory: {settings.recording.directory} can't be made ({error.strerror}); "
            "a folder that may be written",
            common.EXIT_USAGE,
        ) from None
