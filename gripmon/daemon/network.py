"""Opens the network of a configuration: one session, with everything that uses it."""

from __future__ import annotations

import contextlib
import dataclasses
import logging

from gripmon.daemon.config import Config, ConfigError, check_network
from gripmon.daemon.neighbours import Asked, Commands, JawFeed, Reports
from gripmon.io.metrics import MetricsError, MetricsServer
from gripmon.io.publish.commands import ZenohCommands
from gripmon.io.publish.inputs import ZenohJaw
from gripmon.io.publish.presence import Presence, in_words
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.ros2.output import Ros2Output
from gripmon.io.sources import ArrivingCamera, Source
from gripmon.io.wire import Keys, Link, PublishError
from gripmon.model.errors import NoResultError
from gripmon.model.outputs import Output

_log = logging.getLogger(__name__)


class NameTakenError(NoResultError):
    """Another monitor has the same robot and camera name."""

    exit_code = 4


@dataclasses.dataclass(frozen=True)
class Network:
    """The session (None: nothing is published), the outputs, the sources of the jaw opening (None: the frames) and
    of commands, and the reports of all these for the state message.
    """

    link: Link | None
    outputs: tuple[Output, ...] = ()
    jaw: JawFeed | None = None
    commands: Commands | None = None
    reports: Reports = dataclasses.field(default_factory=Reports)

    def close(self) -> None:
        """Close the outputs, the link last."""
        for output in reversed(self.outputs):
            output.close()


def open_network(config: Config, *, take_over: bool = False) -> Network:
    """Open the network.  Raises :class:`ConfigError` if it can't be opened as configured, and :class:`NameTakenError`
    if another monitor has the same robot and camera name, unless ``take_over``.
    """
    jaw = None
    if config.settings.jaw.source == "fixed":
        jaw = _FixedJaw(config.jaw_opening_m)
    network = Network(None, jaw=jaw)
    link = _open_link(config)
    if link is not None:
        settings = config.settings
        with contextlib.ExitStack() as failed:
            failed.callback(link.close)  # the process must not end while its session is being opened
            presence = _alone(link, settings.robot, settings.camera_name, take_over=take_over)
            network = _on_link(config, link, jaw, presence)
            failed.pop_all()
    return _with_metrics(config, _with_ros2(config, network))


def _open_link(config: Config) -> Link | None:
    """The session, None if nothing is published."""
    check_network(config)
    settings = config.settings
    if not settings.publish.enabled:
        return None
    try:
        return Link(settings.publish, config.directory)
    except PublishError as error:
        raise ConfigError(config.path, "", str(error)) from None


def _alone(link: Link, robot: str, camera: str, *, take_over: bool) -> Presence:
    """The presence of this start of the monitor.  Raises :class:`NameTakenError` if another monitor keeps the name."""
    presence = Presence(link, Keys(robot, camera))
    _log.info("this monitor of %s/%s has the id %s", robot, camera, presence.monitor_id)
    others = () if take_over else presence.wait_alone()
    if others:
        remedy = "stop it, give this one another name, or start it with --take-over and stop the other one then"
        raise NameTakenError(f"{in_words(others)}; {remedy}")
    return presence


def _on_link(config: Config, link: Link, jaw: JawFeed | None, presence: Presence) -> Network:
    settings = config.settings
    publisher = ZenohPublisher(link, settings.robot, settings.camera_name, presence)
    if settings.jaw.source == "zenoh":
        jaw = ZenohJaw(link, publisher.keys["jaw"], travel_m=(config.gripper.jaw_min_m, config.gripper.jaw_max_m))
    commands = ZenohCommands(link, publisher.keys, presence) if settings.publish.commands else None
    heard = [each for each in (jaw, commands) if isinstance(each, (ZenohJaw, ZenohCommands))]
    reports = Reports(
        (link.fault,), lambda: publisher.unsent, lambda: sum(each.malformed for each in heard), others=presence.others
    )
    return Network(link, (publisher,), jaw, commands, reports)


def _with_ros2(config: Config, network: Network) -> Network:
    """Add the monitor as a node of ROS 2, if configured."""
    settings, reports = config.settings, network.reports
    if not settings.ros2.enabled:
        return network
    node = Ros2Output(
        settings.ros2, settings.robot, settings.camera_name,
        commands=settings.publish.commands, others=reports.others,
    )  # fmt: skip
    return dataclasses.replace(
        network,
        outputs=(*network.outputs, node),
        commands=node if network.commands is None else _EitherCommands(network.commands, node),
        reports=dataclasses.replace(reports, faults=(*reports.faults, node.fault)),
    )


class _EitherCommands:
    """Commands from two networks."""

    def __init__(self, *heard: Commands) -> None:
        self._heard = heard

    def poll(self) -> Asked | None:
        return next((asked for each in self._heard if (asked := each.poll()) is not None), None)


def _with_metrics(config: Config, network: Network) -> Network:
    """Add the metrics server for Prometheus to the outputs if configured.  Raises :class:`ConfigError` if it can't
    listen.
    """
    settings = config.settings
    if not settings.metrics.enabled:
        return network
    try:
        metrics = MetricsServer(settings.metrics, settings.robot, settings.camera_name)
    except MetricsError as error:
        network.close()
        raise ConfigError(config.path, "", str(error)) from None
    _log.info("metrics at http://%s:%d/metrics", settings.metrics.address, settings.metrics.port)
    return dataclasses.replace(network, outputs=(*network.outputs, metrics))


def with_source(reports: Reports, source: Source) -> Reports:
    """The reports, extended by those of a camera on a network."""
    if not isinstance(source, ArrivingCamera):
        return reports
    malformed = reports.malformed
    return dataclasses.replace(
        reports, faults=(*reports.faults, source.fault), malformed=lambda: malformed() + source.malformed
    )


@dataclasses.dataclass(frozen=True)
class _FixedJaw:
    """A fixed jaw opening as a :class:`JawFeed`; None for a gripper without jaw."""

    fixed_m: float | None

    def opening_m(self, stamp_ns: int | None = None) -> float | None:
        return self.fixed_m

    def fault(self) -> str:
        return ""
