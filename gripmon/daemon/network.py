"""Opens the network of a configuration: one session, with everything that uses it."""

from __future__ import annotations

import contextlib
import dataclasses
import logging

from gripmon.daemon.config import Config, check_network
from gripmon.daemon.config.typed import faults_of
from gripmon.daemon.neighbours import Asked, Commands, JawFeed, Reports
from gripmon.io.metrics import MetricsServer
from gripmon.io.publish.commands import ZenohCommands
from gripmon.io.publish.inputs import ZenohJaw
from gripmon.io.publish.presence import Presence, in_words
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.ros2.output import Ros2Output
from gripmon.io.sources import ArrivingCamera, Source
from gripmon.io.wire import Keys, Link
from gripmon.model.errors import NoResultError
from gripmon.model.outputs import Output

_log = logging.getLogger(__name__)


class NameTakenError(NoResultError):
    """Another monitor has the same robot and camera name."""

    exit_code = 4


class Network:
    """The session, ``link`` (None: nothing is published), the ``outputs``, the sources of the ``jaw`` opening (None:
    the frames) and of ``commands``, and the ``reports`` of all these for the state message.
    """

    def __init__(self, config: Config, *, take_over: bool = False) -> None:
        """Raises :class:`ConfigError` if it can't be opened as configured, and :class:`NameTakenError` if another
        monitor has the same robot and camera name, unless ``take_over``.
        """
        settings, policy = config.settings, config.settings.monitor.policy
        check_network(config)
        self.link: Link | None = None
        self.outputs: list[Output] = []
        self.jaw: JawFeed | None = _FixedJaw(config.jaw_opening_m) if settings.jaw.source == "fixed" else None
        self._heard: list[Commands] = []
        self._arriving: list[ZenohJaw | ZenohCommands | ArrivingCamera] = []
        self.reports = Reports(
            malformed=lambda: sum(each.malformed for each in self._arriving),
            alert_limit_m=policy.alert_limit_m,
            alert_limit_rad=policy.alert_limit_rad,
        )
        with contextlib.ExitStack() as failed:
            failed.callback(self.close)  # the process must not end while its session is being opened
            if settings.publish.enabled:
                self._join(config, take_over=take_over)
            if settings.ros2.enabled:
                node = Ros2Output(
                    settings.ros2, settings.robot, settings.camera_name, commands=settings.publish.commands,
                    others=self.reports.others,
                )  # fmt: skip
                self.outputs.append(node)
                self._heard.append(node)
                self.reports.faults.append(node.fault)
            if settings.metrics.enabled:
                self._serve_metrics(config)
            failed.pop_all()

    @property
    def commands(self) -> Commands | None:
        """Commands from all networks."""
        return self if self._heard else None

    def poll(self) -> Asked | None:
        return next((asked for each in self._heard if (asked := each.poll()) is not None), None)

    def close(self) -> None:
        """Close the outputs, the link last."""
        for output in reversed(self.outputs):
            output.close()
        if self.link is not None:
            self.link.close()

    def report_on(self, source: Source) -> None:
        """Report also on a camera on a network."""
        if isinstance(source, ArrivingCamera):
            self._arriving.append(source)
            self.reports.faults.append(source.fault)

    def _join(self, config: Config, *, take_over: bool) -> None:
        settings, reports = config.settings, self.reports
        with faults_of(config.path):
            self.link = link = Link(settings.publish, config.directory)
        presence = _alone(link, settings.robot, settings.camera_name, take_over=take_over)
        publisher = ZenohPublisher(link, settings.robot, settings.camera_name, presence)
        self.outputs.append(publisher)
        if settings.jaw.source == "zenoh":
            travel_m = config.gripper.jaw_min_m, config.gripper.jaw_max_m
            self.jaw = jaw = ZenohJaw(link, publisher.keys["jaw"], travel_m=travel_m)
            self._arriving.append(jaw)
        if settings.publish.commands:
            commands = ZenohCommands(link, publisher.keys, presence)
            self._heard.append(commands)
            self._arriving.append(commands)
        reports.faults.append(link.fault)
        reports.unsent, reports.others = lambda: publisher.unsent, presence.others

    def _serve_metrics(self, config: Config) -> None:
        """For Prometheus.  Raises :class:`ConfigError` if the server can't listen."""
        settings = config.settings
        with faults_of(config.path):
            self.outputs.append(MetricsServer(settings.metrics, settings.robot, settings.camera_name))
        _log.info("metrics at http://%s:%d/metrics", settings.metrics.address, settings.metrics.port)


def _alone(link: Link, robot: str, camera: str, *, take_over: bool) -> Presence:
    """The presence of this start of the monitor.  Raises :class:`NameTakenError` if another monitor keeps the name."""
    presence = Presence(link, Keys(robot, camera))
    _log.info("this monitor of %s/%s has the id %s", robot, camera, presence.monitor_id)
    others = () if take_over else presence.wait_alone()
    if others:
        remedy = "stop it, give this one another name, or start it with --take-over and stop the other one then"
        raise NameTakenError(f"{in_words(others)}; {remedy}")
    return presence


@dataclasses.dataclass(frozen=True)
class _FixedJaw:
    """A fixed jaw opening as a :class:`JawFeed`; None for a gripper without jaw."""

    fixed_m: float | None

    def opening_m(self, stamp_ns: int | None = None) -> float | None:
        return self.fixed_m

    def fault(self) -> str:
        return ""
