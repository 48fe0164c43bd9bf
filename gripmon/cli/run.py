"""``gripmon run``: the daemon."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.config import Config
    from gripmon.daemon import JawFeed, Reports
    from gripmon.publish import Publisher, ZenohCommands
    from gripmon.recording import Recorder
    from gripmon.records import Alert, ReferenceRecord
    from gripmon.sources import Source
    from gripmon.statefile import StateFile
    from gripmon.wire import Keys, Link

_DESCRIPTION = """\
Watch a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
interrupted (Ctrl-C or SIGTERM).  A camera that is missing or goes away is tried again for ever, and
the state on the network says so.

The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
that state.file names: a live camera's in ~/.local/state/gripmon.  After a restart the monitor goes on
from the last reference, checks in the picture that it still fits, and says so (alert restarted)."""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     begin anew; the kept state is set aside
  gripmon send undo --robot arm1                         back to the reference before

Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, or an internal error that persisted; 130 Ctrl-C"""


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
        help="put the recording and estimates.jsonl (one JSON line a frame) here; made if it is missing",
    )
    parser.add_argument(
        "--fresh-state",
        action="store_true",
        help="start from the configured reference; a kept state is set aside as <file>.replaced-<n>",
    )
    parser.add_argument("--verbose", action="store_true", help="say more on stderr")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon run``."""
    config = common.load(arguments.config)
    out = None if arguments.out is None else common.make_directory(Path(arguments.out))
    return run_daemon(
        config,
        out=out,
        duration_s=arguments.duration,
        verbose=arguments.verbose,
        keep_state=True,
        fresh_state=arguments.fresh_state,
    )


def run_daemon(
    config: Config,
    *,
    out: Path | None,
    duration_s: float | None = None,
    verbose: bool = False,
    recording_name: str | None = None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None = None,
    on_network: Callable[[], None] = lambda: None,
    keep_state: bool = False,
    fresh_state: bool = False,
) -> int:
    """Open everything that a configuration names and run the daemon on it; returns the exit code.

    ``truth_tcp_m``, which a simulation has, gives the TCP's true position in the camera frame for a frame's ``seq``; it
    goes into the recording.  ``on_network`` is called when the publisher is open, before the camera is.
    ``keep_state``: what survives a restart is read from the configuration's state file, unless ``fresh_state``, and
    kept there.
    """
    import cv2

    from gripmon import daemon
    from gripmon.monitor import Monitor
    from gripmon.sources import SourceError, open_source
    from gripmon.wire import Keys

    settings = config.settings
    estimates = None if out is None else out / "estimates.jsonl"
    if estimates is not None:
        common.check_file(estimates)
    cv2.setNumThreads(1)
    daemon.log_to_stderr(verbose=verbose)
    with daemon.sigterm_exits(), contextlib.ExitStack() as opened:
        kept = _open_state(config, fresh=fresh_state) if keep_state else None
        if kept is not None:
            opened.callback(kept.close)
            config = dataclasses.replace(config, reference=kept.configured)
        state = None if kept is None else kept.state
        monitor = Monitor(
            config.camera, config.gripper, settings.monitor, config.reference, config.taught_edges, state=state
        )
        link = _open_link(config)
        network = _open_network(config, link)
        opened.callback(network.publisher.close)
        on_network()
        recorder = _open_recorder(config, monitor.reference, out, recording_name, truth_tcp_m)
        opened.callback(recorder.close)
        try:
            keys = Keys(settings.robot, settings.camera_name)
            source = open_source(settings.source, config.directory, scene=config.scene, link=link, keys=keys)
        except SourceError as error:
            raise common.CommandFailedError(f"{config.path}: source.{error}", common.EXIT_USAGE) from None
        _show_listeners(config, link)
        opened.pop_all()  # from here on the daemon closes them
        return daemon.run(
            monitor,
            source,
            network.publisher,
            recorder,
            settings.daemon,
            robot=settings.robot,
            camera=settings.camera_name,
            estimates=estimates,
            jaw=network.jaw,
            keeper=daemon.StateKeeper(kept),
            commands=network.commands,
            reports=_with_source(network.reports, source),
            notices=_notices(kept),
            duration_s=duration_s,
        )


@dataclasses.dataclass(frozen=True)
class _FixedJaw:
    """A jaw that never moves, in the form that the daemon asks for; None for a gripper without jaw."""

    fixed_m: float | None

    def opening_m(self) -> float | None:
        return self.fixed_m

    def fault(self) -> str:
        return ""


def _open_state(config: Config, *, fresh: bool) -> StateFile | None:
    """The file for what survives a restart; None without one."""
    from gripmon.records import MonitorState
    from gripmon.statefile import StateFile, StateFileError

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
    from gripmon.records import Alert, AlertKind, Cause, Severity

    texts = () if kept is None else kept.notices
    return [Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.WARNING, text) for text in texts]


def _open_link(config: Config) -> Link | None:
    """The session; None if nothing is published."""
    from gripmon.ros2 import network_of
    from gripmon.wire import Link, PublishError

    if not config.settings.publish.enabled:
        return None
    try:
        return Link(network_of(config.settings.publish, config.settings.ros2), config.directory)
    except PublishError as error:
        raise common.CommandFailedError(f"{config.path}: {error}", common.EXIT_USAGE) from None


class _Network(NamedTuple):
    """The publisher, where the jaw opening comes from (None: with the frames), where commands come from, and what the
    state message says of all this.
    """

    publisher: Publisher
    jaw: JawFeed | None
    commands: ZenohCommands | None
    reports: Reports


def _open_network(config: Config, link: Link | None) -> _Network:
    from gripmon.daemon import Reports
    from gripmon.publish import NullPublisher, Publishers, ZenohCommands, ZenohJaw, ZenohPublisher

    settings = config.settings
    jaw: JawFeed | None = _FixedJaw(config.jaw_opening_m) if settings.jaw.source == "fixed" else None
    if link is None:
        return _Network(NullPublisher(), jaw, None, Reports())
    publisher = ZenohPublisher(link, settings.robot, settings.camera_name)
    if settings.jaw.source in ("zenoh", "ros2_joint_state"):
        jaw = _network_jaw(config, link, publisher.keys)
    commands = ZenohCommands(link, publisher.keys) if settings.publish.commands else None
    heard = [each for each in (jaw, commands) if isinstance(each, (ZenohJaw, ZenohCommands))]
    ros2 = _ros2_node(config, link)
    publishers = Publishers(publisher, {} if ros2 is None else {"ROS 2": ros2})
    faults = (link.fault, publishers.fault)
    reports = Reports(faults, lambda: publisher.unsent, lambda: sum(each.malformed for each in heard))
    return _Network(publishers, jaw, commands, reports)


def _with_source(reports: Reports, source: Source) -> Reports:
    """The reports, and what a camera on the network says beside them."""
    from gripmon.sources import NetworkCamera

    if not isinstance(source, NetworkCamera):
        return reports
    return dataclasses.replace(
        reports,
        faults=(*reports.faults, source.fault),
        malformed=lambda: reports.malformed() + source.malformed,
    )


def _ros2_node(config: Config, link: Link) -> Publisher | None:
    """The monitor as a ROS 2 node, where the configuration wants one."""
    from gripmon.ros2 import Ros2Missing, Ros2Publisher, layout_of

    settings = config.settings
    if not settings.ros2.enabled:
        return None
    try:
        return Ros2Publisher(link, settings.ros2, layout_of(settings.ros2, settings.robot, settings.camera_name))
    except Ros2Missing as error:
        link.close()
        raise common.CommandFailedError(f"{config.path}: ros2.enabled: {error}", common.EXIT_USAGE) from None


def _show_listeners(config: Config, link: Link | None) -> None:
    """Let ROS 2 know of the topics that frames and jaw opening come from."""
    from gripmon.ros2 import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, HeardTopic, Listeners, NodeName, as_token
    from gripmon.sources import NetworkSettings

    settings = config.settings
    jaw, source = settings.jaw, settings.source
    topics = []
    if jaw.source == "ros2_joint_state" and jaw.topic is not None:
        topics.append(HeardTopic(jaw.domain_id, jaw.topic, JOINT_STATE))
    if isinstance(source, NetworkSettings) and source.topic is not None:
        type_name = IMAGE if source.format == "ros2_image" else COMPRESSED_IMAGE
        topics.append(HeardTopic(source.domain_id, source.topic, type_name))
    if link is not None and topics:
        namespace = f"/{as_token(settings.robot)}/{as_token(settings.camera_name)}"
        Listeners(link, NodeName("gripmon_input", namespace), topics)


def _network_jaw(config: Config, link: Link, keys: Keys) -> JawFeed:
    """The jaw opening that the robot publishes, on a key of ours or on a topic of ROS 2."""
    from gripmon.publish import ZenohJaw
    from gripmon.publish.jaw import opening_of_joints
    from gripmon.ros2 import JOINT_STATE, Ros2Missing, subscription_key
    from gripmon.ros2.types import typestore

    jaw = config.settings.jaw
    travel_m = config.gripper.jaw_min_m, config.gripper.jaw_max_m
    if jaw.source == "zenoh":
        return ZenohJaw(link, keys["jaw"], travel_m=travel_m)
    assert jaw.topic is not None and jaw.opening is not None, "checked with the configuration"
    try:
        typestore()
    except Ros2Missing as error:
        raise common.CommandFailedError(f"{config.path}: jaw.source: {error}", common.EXIT_USAGE) from None
    key = subscription_key(jaw.domain_id, jaw.topic, JOINT_STATE)
    return ZenohJaw(link, key, opening_of_joints(jaw.opening), travel_m=travel_m)


def _open_recorder(
    config: Config,
    reference: ReferenceRecord,
    out: Path | None,
    name: str | None,
    truth_tcp_m: Callable[[int], tuple[float, float, float]] | None,
) -> Recorder:
    from gripmon.recording import open_recorder

    settings = config.settings
    try:
        return open_recorder(
            settings.recording,
            robot=settings.robot,
            camera_name=settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=reference,
            directory=out,
            name=name,
            truth_tcp_m=truth_tcp_m,
        )
    except OSError as error:
        if out is not None:
            raise common.not_writable(out, error) from None
        raise common.CommandFailedError(
            f"{config.path}: recording.directory: {settings.recording.directory} can't be made ({error.strerror}); "
            "a folder that may be written",
            common.EXIT_USAGE,
        ) from None
