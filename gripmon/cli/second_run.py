"""``gripmon run`` with the configuration of a second camera."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common
from gripmon.cli.viewing import LiveView
from gripmon.model.errors import InputError
from gripmon.model.stopping import StopRequest

if TYPE_CHECKING:
    from gripmon.daemon import Reports
    from gripmon.daemon.config import SecondConfig
    from gripmon.io.publish import SpotPublisher, ZenohCommands, ZenohPulses
    from gripmon.io.wire import Link
    from gripmon.record.write import SpotRecorder


@dataclasses.dataclass(frozen=True)
class _Network:
    """The session (None: nothing is published), what is said on it, and what is heard."""

    link: Link | None
    publisher: SpotPublisher
    pulses: ZenohPulses | None
    commands: ZenohCommands | None
    reports: Reports


def load(path: str, *, check_source: bool = True) -> SecondConfig | None:
    """The configuration if it is a second camera's, else None."""
    from gripmon.daemon.config import is_second, load_second

    return load_second(Path(path), check_source=check_source) if is_second(Path(path)) else None


def with_pulses(config: SecondConfig) -> SecondConfig:
    """The same with the pulses of its table, where that was left out before."""
    from gripmon.daemon.config import load_pulses

    return load_pulses(config)


def run_second(
    config: SecondConfig,
    *,
    out: Path | None,
    duration_s: float | None,
    verbose: bool,
    view: str | None = None,
    take_over: bool = False,
    stop: StopRequest,
) -> int:
    """Open everything that the configuration names and run the daemon on it; returns the exit code."""
    import cv2

    from gripmon import daemon
    from gripmon.daemon import camera_source
    from gripmon.daemon.network import with_source
    from gripmon.daemon.starting import RECORDING_PATIENCE_S

    settings, laser = config.settings, config.settings.laser
    camera_source.look_ahead(config)
    lines = None if out is None else out / "spots.jsonl"
    if lines is not None:
        common.check_file(lines)
    cv2.setNumThreads(1)
    daemon.log_to_stderr(verbose=verbose)
    live = None if view is None else LiveView(settings.view, view, str(config.path))
    with contextlib.ExitStack() as viewed, contextlib.ExitStack() as opened:
        pulsed = config.pulsed_watch()
        network = _open_network(config, take_over=take_over)
        opened.callback(network.publisher.close)
        publisher = _with_metrics(config, network.publisher)
        opened.callback(publisher.close)
        source = camera_source.open_source(config, network.link)
        opened.callback(source.close)
        recorder = _open_recorder(config, out, live, 0.0 if source.live else RECORDING_PATIENCE_S)
        opened.callback(recorder.close)
        if live is not None:
            live.open(viewed)
        opened.pop_all()  # from here on the daemon closes them
        return daemon.run_second(
            pulsed,
            source,
            publisher,
            recorder,
            settings.daemon,
            robot=settings.robot,
            camera=settings.camera_name,
            lines=lines,
            table=config.pulses,
            feed=network.pulses,
            no_spot_alert_after_s=laser.no_spot_alert_after_s,
            commands=network.commands,
            reports=with_source(network.reports, source),
            duration_s=duration_s,
            stop=stop,
        )


def _open_network(config: SecondConfig, *, take_over: bool) -> _Network:
    """Open all of it; ends the command as :func:`gripmon.daemon.network.open_network` does."""
    from gripmon.daemon import Reports
    from gripmon.daemon.config import check_second_network
    from gripmon.io.publish import NullPublisher
    from gripmon.io.wire import Link, PublishError

    try:
        check_second_network(config)
        if not config.settings.publish.enabled:
            return _Network(None, NullPublisher(), None, None, Reports())
        link = Link(config.settings.publish, config.directory)
    except PublishError as error:
        raise InputError(f"{config.path}: {error}") from None
    with contextlib.ExitStack() as failed:
        failed.callback(link.close)  # a process must not end while its session is being opened
        network = _on_link(config, link, take_over=take_over)
        failed.pop_all()
    return network


def _on_link(config: SecondConfig, link: Link, *, take_over: bool) -> _Network:
    from gripmon.daemon import Reports
    from gripmon.daemon.network import alone
    from gripmon.io.publish import ZenohCommands, ZenohPulses, ZenohSpotPublisher

    settings = config.settings
    presence = alone(link, settings.robot, settings.camera_name, take_over=take_over)
    publisher = ZenohSpotPublisher(link, settings.robot, settings.camera_name, presence)
    pulses = ZenohPulses(link, publisher.keys["pulse"]) if settings.laser.pulses is None else None
    commands = ZenohCommands(link, publisher.keys, presence) if settings.publish.commands else None
    heard = [each for each in (pulses, commands) if each is not None]
    faults = [link.fault] if pulses is None else [link.fault, pulses.fault]
    return _Network(
        link,
        publisher,
        pulses,
        commands,
        Reports(faults, malformed=lambda: sum(h.malformed for h in heard), others=presence.others),
    )


def _with_metrics(config: SecondConfig, publisher: SpotPublisher) -> SpotPublisher:
    """The publisher, and beside it the server for Prometheus where the configuration wants one."""
    from gripmon.daemon.network import metrics_server
    from gripmon.io.publish import Publishers

    metrics = metrics_server(config)
    return publisher if metrics is None else Publishers(publisher, {"metrics": metrics})


def _open_recorder(config: SecondConfig, out: Path | None, live: LiveView | None, patience_s: float) -> SpotRecorder:
    """The recording that the configuration wants; ends the command with exit code 2 where it can't be made."""
    from gripmon.daemon.config.recorded import second_to_recorded
    from gripmon.record.write import open_spot_recorder

    settings = config.settings
    try:
        configuration = second_to_recorded(config)
    except OSError as error:
        text = f"{config.path}: {error.filename}: can't be read any more ({error.strerror})"
        raise InputError(text) from None
    try:
        return open_spot_recorder(
            settings.recording,
            robot=settings.robot,
            camera_name=settings.camera_name,
            calibration=config.calibration,
            directory=out,
            patience_s=patience_s,
            configuration=configuration,
            view=None if live is None else live.settings,
        )
    except OSError as error:
        if out is not None:
            raise common.not_writable(out, error) from None
        raise InputError(
            f"{config.path}: recording.directory: {settings.recording.directory} can't be made ({error.strerror}); "
            "a folder that may be written"
        ) from None
