"""The monitor as a ROS 2 node: transforms, diagnostics, and services for an operator's commands."""

from __future__ import annotations

import functools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np

from gripmon.io.publish.commands import TIMEOUT_S, CommandQueue, PendingCommand
from gripmon.io.publish.presence import in_words
from gripmon.io.ros2.diagnostics import level_of, summary_of, values_of
from gripmon.io.ros2.node import RosNode
from gripmon.io.ros2.settings import Ros2Settings
from gripmon.model.geometry import from_record, inverse_jacobian, invert, to_record
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    Array,
    Cause,
    Command,
    CommandError,
    CommandName,
    CommandReply,
    Frame,
    FrameRecord,
    StandingAlert,
    StateRecord,
    Transform,
)
from gripmon.model.records.values import NS_PER_S

_log = logging.getLogger(__name__)

SERVICES = tuple(name for name in CommandName if name not in (CommandName.STATE, CommandName.SNAPSHOT))
"""Each is ``~/<name>``; a Trigger has no argument: the current proposal, the previous reference, all alerts."""

MOST_WAITED_S = 0.5
"""Longest time from a frame's arrival to its verdict for a broadcast: tf takes the newest message as the present.  More
than twice the controller client's default for the age, so that a busy machine still broadcasts (s).
"""

_MOST_RECORDS = 16  # that wait for the middleware; then the oldest are dropped
_CLOSE_S = 1.0


def inverse(cam_T_grip: Transform, covariance: Sequence[float]) -> tuple[Transform, Array]:
    """``grip_T_cam`` and its covariance (36,), of the camera's position in gripper axes (m²), then of the rotation
    error vector in gripper axes (rad²).
    """
    transform = from_record(cam_T_grip)
    jacobian = inverse_jacobian(transform)
    matrix = np.fromiter(covariance, float, 36).reshape(6, 6)
    return to_record(invert(transform)), (jacobian @ matrix @ jacobian.T).ravel()


class Ros2Output(Output):
    """An output of one monitor: nothing here waits for the middleware, and whatever fails there is in :meth:`fault`.

    One thread publishes, another one handles the services (:class:`RosNode`).  Transforms with an allowed verdict go to
    tf and to the pose topic, stamped with the frame's capture time, except those delayed in the monitor.  Diagnostics
    are sent with every state record and every alert.  While there is no node, nothing is kept: late transforms are old,
    and diagnostics are sent again.
    """

    name = "ROS 2"
    public = True

    def __init__(
        self,
        settings: Ros2Settings,
        robot: str,
        camera: str,
        *,
        commands: bool = True,
        others: Callable[[], tuple[str, ...]] = tuple,
    ) -> None:
        """``commands``: whether there are services; ``others``: ids of other monitors of this name, beside which none
        is carried out.  Raises :class:`gripmon.io.ros2.node.Ros2Missing` for a domain that can't be.
        """
        self._settings = settings = settings.named(robot, camera)
        self._commands, self._others = commands, others
        self._waiting: deque[tuple[float, FrameRecord | StateRecord | AlertRecord]] = deque(maxlen=_MOST_RECORDS)
        self._some, self._closed = threading.Event(), False
        self._asked = CommandQueue()
        self.poll = self._asked.poll
        self._topics: tuple[Any, Any, Any] | None = None
        self._frame: FrameRecord | None = None  # the newest; this and what follows is the publishing thread's
        self._waited_s = 0.0
        self._state: StateRecord | None = None
        self._alerts: dict[str, StandingAlert] = {}  # those that are open
        self._causes: dict[str, Cause] = {}
        self._node = RosNode(settings.node, settings.namespace or "/", settings.domain_id, self._declare)
        self._thread = threading.Thread(target=self._publish, name="ros2 output", daemon=True)
        self._thread.start()

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Publish one frame's transform, if it has one and its verdict allows it."""
        self._waiting.append((time.monotonic(), record))
        self._some.set()

    def event(self, event: Event) -> None:
        """Publish diagnostics for a state, or for an alert that lasts or has lasted."""
        if isinstance(event, StateRecord | AlertRecord):
            self._waiting.append((time.monotonic(), event))
            self._some.set()

    def fault(self) -> str:
        """Why ROS has nothing of this at present, in a few words for a person; empty if it has."""
        return self._node.fault()

    def close(self) -> None:
        """Leave the graph; what waits is dropped, commands are refused.  Calling it twice does nothing more."""
        self._closed = True
        self._some.set()
        self._asked.close()
        self._thread.join(_CLOSE_S)
        self._node.close()

    def _declare(self, node: Any) -> None:
        """The topics and services, in the node's thread."""
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from std_srvs.srv import Trigger

        tf = None
        try:
            from tf2_msgs.msg import TFMessage

            tf = node.create_publisher(TFMessage, self._settings.tf_topic, 100)  # as tf2_ros' broadcasters
        except ImportError:
            _log.warning("nothing goes to %s: this environment has no tf2_msgs", self._settings.tf_topic)
        pose = node.create_publisher(PoseWithCovarianceStamped, self._settings.pose_topic, 10)
        for name in SERVICES if self._commands else ():
            node.create_service(Trigger, f"~/{name}", functools.partial(self._serve, name))
        self._topics = pose, tf, node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def _serve(self, name: CommandName, _request: Any, response: Any) -> Any:
        """Have the loop carry out a command, in the node's thread."""
        told: Future[CommandReply | CommandError] = Future()
        pending = PendingCommand(Command(name), TIMEOUT_S)
        if others := self._others():
            response.message = f"{in_words(others)}; stop it or this one first"
        elif error := self._asked.put(pending, lambda answer, _: told.set_result(answer)):
            response.message = error.text
        else:
            answer = told.result()
            response.success = isinstance(answer, CommandReply) and answer.done
            response.message = answer.text
        return response

    def _publish(self) -> None:
        while self._some.wait() and not self._closed:
            self._some.clear()
            while self._waiting and not self._closed:
                try:
                    self._take(*self._waiting.popleft())
                except Exception as error:  # noqa: BLE001  reported, and tried again with a new node
                    self._node.failed(error)

    def _take(self, came_s: float, record: FrameRecord | StateRecord | AlertRecord) -> None:
        topics = None if self._node.fault() else self._topics
        if isinstance(record, FrameRecord):
            self._frame, self._waited_s = record, 1e-9 * record.latency_ns + time.monotonic() - came_s
            if topics is not None and not self._held_back():
                self._publish_pose(record, *topics[:2])
            return
        if isinstance(record, StateRecord):
            self._state = record
            self._alerts = {alert.alert_id: alert for alert in record.open_alerts}
        elif record.event is AlertEvent.NOTED:
            return
        elif record.event is AlertEvent.CLEARED:
            self._alerts.pop(record.alert_id, None)
        else:
            self._causes[record.alert_id] = record.cause
            self._alerts[record.alert_id] = StandingAlert(
                record.alert_id, record.kind, record.severity, record.text, record.since_ns, record.acknowledged
            )
        self._causes = {each: cause for each, cause in self._causes.items() if each in self._alerts}
        if topics is not None and self._state is not None:
            topics[2].publish(self._diagnostics(self._state))

    def _held_back(self) -> str:
        """Why the newest transform isn't published; empty if it is."""
        record = self._frame
        if record is None:
            return "no frame yet"
        if record.verdict not in self._settings.verdicts:
            return f"verdict {record.verdict}"
        if self._waited_s > MOST_WAITED_S:
            return f"ready {self._waited_s:.2g} s after its frame came, at most {MOST_WAITED_S:g} s"
        return "no transform" if self._chosen(record) is None else ""

    def _chosen(self, record: FrameRecord) -> tuple[Transform, Sequence[float]] | None:
        """``cam_T_grip`` and its covariance, as the settings want them; None if the record has none."""
        if self._settings.transform == "smoothed":
            if (smooth := record.smoothed) is None:
                return None
            return Transform(smooth.translation_m, smooth.rotation_xyzw), smooth.covariance
        if record.cam_T_grip is None or record.covariance is None:
            return None
        return record.cam_T_grip, record.covariance

    def _publish_pose(self, record: FrameRecord, pose: Any, tf: Any) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped

        chosen = self._chosen(record)
        assert chosen is not None, "others are held back"
        transform, covariance = inverse(*chosen) if self._settings.publish == "gripper_from_camera" else chosen
        message = PoseWithCovarianceStamped()
        _stamp(message.header, record.stamp_ns, self._settings.parent_frame or "")
        _place(message.pose.pose.position, transform.translation_m)
        _place(message.pose.pose.orientation, transform.rotation_xyzw)
        # ROS defines it as we do: x, y, z, then rotations about x, y, z, in the axes of the header's frame, row by row.
        message.pose.covariance = np.fromiter(covariance, np.float64, 36)
        pose.publish(message)
        if tf is not None:
            placed = TransformStamped(header=message.header, child_frame_id=self._settings.child_frame)
            _place(placed.transform.translation, transform.translation_m)
            _place(placed.transform.rotation, transform.rotation_xyzw)
            tf.publish(tf.msg_type(transforms=[placed]))

    def _diagnostics(self, state: StateRecord) -> Any:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        alerts, name = list(self._alerts.values()), f"{state.robot}/{state.camera}"
        values = values_of(state, self._frame, alerts, self._causes)
        values["broadcast"] = f"no: {held_back}" if (held_back := self._held_back()) else "yes"
        status = DiagnosticStatus(
            level=bytes([level_of(state, alerts)]), name=f"{self._settings.node}: {name}", hardware_id=name,
            message=summary_of(state, alerts), values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )  # fmt: skip
        array = DiagnosticArray(status=[status])
        _stamp(array.header, state.stamp_ns)
        return array


def _stamp(header: Any, stamp_ns: int, frame_id: str = "") -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
    header.frame_id = frame_id


def _place(part: Any, values: Sequence[float]) -> None:
    for name, value in zip("xyzw", values, strict=False):
        setattr(part, name, float(value))
