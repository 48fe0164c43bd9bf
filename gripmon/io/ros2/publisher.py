"""The monitor as a ROS 2 node: its records as messages."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gripmon.io.ros2.names import Layout, Qos, Ros2Settings
from gripmon.io.ros2.node import DIAGNOSTICS, POSE, TF, Node, TopicPublisher, prepare, typestore
from gripmon.io.wire import Link
from gripmon.model.geometry import from_record, inverse_jacobian, invert, to_record
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    Array,
    Frame,
    FrameRecord,
    Severity,
    StandingAlert,
    State,
    StateRecord,
    Transform,
    Verdict,
)
from gripmon.model.records.values import NS_PER_S

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

OK, WARN, ERROR, STALE = range(4)
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

_OF_VERDICT = {Verdict.VALID: OK, Verdict.SUSPECT: WARN, Verdict.UNKNOWN: ERROR}
_OF_SEVERITY = {Severity.INFO: OK, Severity.WARNING: WARN, Severity.ERROR: ERROR}


def inverse(cam_T_grip: Transform, covariance: Iterable[float]) -> tuple[Transform, Array]:
    """``grip_T_cam`` and its covariance (36,), of the camera's position in gripper axes (m²), then of the rotation
    error vector in gripper axes (rad²).
    """
    transform = from_record(cam_T_grip)
    jacobian = inverse_jacobian(transform)
    matrix = np.fromiter(covariance, float, 36).reshape(6, 6)
    return to_record(invert(transform)), (jacobian @ matrix @ jacobian.T).ravel()


class Messages:
    """Makes the messages of one camera; ``transform`` stands for ``parent_T_child``."""

    def __init__(self, parent_frame: str, child_frame: str) -> None:
        """Raises :class:`gripmon.io.ros2.node.Ros2Missing`."""
        self._parent, self._child = parent_frame, child_frame
        prepare(TF, POSE, DIAGNOSTICS)
        types = typestore().types
        self._time = types["builtin_interfaces/msg/Time"]
        self._header = types["std_msgs/msg/Header"]
        self._vector, self._quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        self._transform, self._stamped = (
            types["geometry_msgs/msg/Transform"],
            types["geometry_msgs/msg/TransformStamped"],
        )
        self._tf = types["tf2_msgs/msg/TFMessage"]
        self._point, self._pose = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Pose"]
        self._with_covariance = types["geometry_msgs/msg/PoseWithCovariance"]
        self._pose_stamped = types["geometry_msgs/msg/PoseWithCovarianceStamped"]
        self._key_value = types["diagnostic_msgs/msg/KeyValue"]
        self._status = types["diagnostic_msgs/msg/DiagnosticStatus"]
        self._diagnostics = types["diagnostic_msgs/msg/DiagnosticArray"]

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        """``std_msgs/Header`` in the parent frame, or another."""
        return self._header(self._time(*divmod(stamp_ns, NS_PER_S)), self._parent if frame is None else frame)

    def tf(self, header: Any, transform: Transform) -> Any:
        """``tf2_msgs/TFMessage``: the child's pose in the parent."""
        placed = self._transform(self._vector(*transform.translation_m), self._quaternion(*transform.rotation_xyzw))
        return self._tf([self._stamped(header, self._child, placed)])

    def pose(self, header: Any, transform: Transform, covariance: Iterable[float]) -> Any:
        """``geometry_msgs/PoseWithCovarianceStamped``.

        ROS defines the covariance as we do: x, y, z, then rotations about x, y, z, all in the axes of the header's
        frame, row by row.
        """
        pose = self._pose(self._point(*transform.translation_m), self._quaternion(*transform.rotation_xyzw))
        return self._pose_stamped(header, self._with_covariance(pose, np.fromiter(covariance, np.float64, 36)))

    def diagnostics(
        self, name: str, state: StateRecord, frame: FrameRecord | None, alerts: Sequence[StandingAlert], broadcast: str
    ) -> Any:
        """``diagnostic_msgs/DiagnosticArray`` with one status.

        ``frame`` is the newest, ``alerts`` are those that are open, ``broadcast`` says whether tf has the transform.
        """
        status = self._status(
            level_of(state, alerts),
            name,
            summary_of(state, alerts),
            f"{state.robot}/{state.camera}",
            [self._key_value(key, value) for key, value in values_of(state, frame, alerts, broadcast)],
        )
        return self._diagnostics(self.header(state.stamp_ns, frame=""), [status])


def level_of(state: StateRecord, alerts: Iterable[StandingAlert]) -> int:
    """Stale without frames; otherwise the worst of the verdict, the state's message, and the open alerts that are not
    acknowledged.
    """
    if state.state is State.STALE:
        return STALE
    levels = [_OF_SEVERITY[alert.severity] for alert in alerts if not alert.acknowledged]
    return max(_OF_VERDICT[state.verdict], WARN if state.message else OK, *levels, OK)


def summary_of(state: StateRecord, alerts: Iterable[StandingAlert]) -> str:
    """One line of text."""
    parts = [f"{state.state}, transform {state.verdict}", state.message, *(alert.text for alert in alerts)]
    return "; ".join(part for part in parts if part)


def values_of(
    state: StateRecord, frame: FrameRecord | None, alerts: Iterable[StandingAlert], broadcast: str
) -> list[tuple[str, str]]:
    """The keys and values of the status."""
    values = [
        ("state", str(state.state)),
        ("verdict", str(state.verdict)),
        ("broadcast", broadcast),
        ("reference", state.reference_id),
        ("revision", str(state.revision)),
    ]
    if frame is not None:
        values.append(("frame age (s)", f"{1e-9 * (state.stamp_ns - frame.stamp_ns):.3f}"))
        values.append(("reason", frame.reason or ""))
    if state.tcp_shift_m is not None:
        shift_mm = [1e3 * m for m in state.tcp_shift_m]
        values.append(("tcp shift (mm)", f"{math.hypot(*shift_mm):.4f}"))
        values.append(("tcp shift x y z in the camera frame (mm)", " ".join(f"{mm:.4f}" for mm in shift_mm)))
    if frame is not None and frame.drift is not None:
        values.append(("rotation (deg)", f"{math.degrees(frame.drift.rotation_rad):.4f}"))
    if state.sigma_m is not None:
        values.append(("position sigma (mm)", f"{1e3 * state.sigma_m:.4f}"))
    values += _bounds_of(state, frame)
    values += [
        ("alerts", ", ".join(f"{alert.kind} ({alert.severity})" for alert in alerts)),
        ("camera connected", str(state.camera_connected).lower()),
        ("frames per s", f"{state.frames_per_s:.2f}"),
        ("frames", str(state.frames)),
        ("frames refused", str(state.frames_refused)),
        ("frames dropped", str(state.frames_dropped)),
        ("uptime (s)", f"{state.uptime_s:.0f}"),
        ("version", state.version),
    ]
    return values


def _bounds_of(state: StateRecord, frame: FrameRecord | None) -> list[tuple[str, str]]:
    """The newest transform's protection levels, their risk, and the alert limit."""
    values = []
    protection = None if frame is None else frame.protection
    if frame is not None and protection is not None:
        values = [
            ("valid by", str(frame.valid_by)),
            ("protection level (mm)", f"{1e3 * protection.position_m:.4f}"),
            ("rotation protection level (deg)", f"{math.degrees(protection.rotation_rad):.4f}"),
            ("integrity risk per frame", f"{protection.risk:g}"),
            ("hypothesis", protection.hypothesis),
        ]
        for name, bound in (("since the reference", frame.since_reference), ("absolute", frame.absolute)):
            if bound is not None:
                values.append((f"protection level {name} (mm)", f"{1e3 * bound.position_m:.4f}"))
    if state.alert_limit_m is not None:
        values.append(("alert limit (mm)", f"{1e3 * state.alert_limit_m:g}"))
    return values


_TF_QOS = Qos(depth=100)
"""That of ``tf2_ros``' broadcasters: reliable, volatile, keep last 100."""

MOST_WAITED_S = 0.5
"""Longest time from a frame's arrival to its verdict for a broadcast: tf takes the newest message as the present.  More
than twice the controller client's default for the age, so that a busy machine still broadcasts (s).
"""


@dataclass(frozen=True, slots=True)
class _Topics:
    node: Node
    tf: TopicPublisher
    pose: TopicPublisher
    diagnostics: TopicPublisher


class Ros2Publisher(Output):
    """Publishes one monitor's records as a node on a link that it doesn't own.

    Transforms with an allowed verdict go to tf and to the pose topic, stamped with the frame's capture time, except
    those delayed in the monitor.  Diagnostics are sent with every state record (once a second and on every change) and
    every alert.  While the link isn't open, nothing is kept: late transforms are old, and diagnostics are sent again.
    """

    def __init__(self, link: Link, settings: Ros2Settings, layout: Layout) -> None:
        """Raises :class:`gripmon.io.ros2.node.Ros2Missing` without ``rosbags``."""
        self._layout = layout
        self._verdicts = frozenset(settings.verdicts)
        self._smoothed = settings.transform == "smoothed"
        self._inverse = settings.publish == "gripper_from_camera"
        self._messages = Messages(layout.parent_frame, layout.child_frame)
        self._topics: _Topics | None = None  # set whole by the opening thread
        self._fault = ""
        self._frame: FrameRecord | None = None
        self._state: StateRecord | None = None
        self._alerts: dict[str, StandingAlert] = {}  # those that are open
        link.attach(self._adopt, self._leave)

    name = "ROS 2"
    public = True

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Publish one frame's transform, if it has one and its verdict allows it."""
        self._frame = record
        topics = self._ready()
        chosen = self._chosen(record)
        if topics is None or chosen is None or self._held_back():
            return
        transform, covariance = inverse(*chosen) if self._inverse else chosen
        header = self._messages.header(record.stamp_ns)
        topics.tf.put(self._messages.tf(header, transform))
        topics.pose.put(self._messages.pose(header, transform, covariance))

    def event(self, event: Event) -> None:
        """Publish diagnostics with a state, and with an alert."""
        if isinstance(event, StateRecord):
            self._of_state(event)
        elif isinstance(event, AlertRecord):
            self._of_alert(event)

    def _of_state(self, record: StateRecord) -> None:
        self._state = record
        self._alerts = {alert.alert_id: alert for alert in record.open_alerts}
        self._diagnose()

    def _of_alert(self, record: AlertRecord) -> None:
        """Publish diagnostics if the alert lasts, or has lasted."""
        if record.event is AlertEvent.NOTED:
            return
        if record.event is AlertEvent.CLEARED:
            self._alerts.pop(record.alert_id, None)
        else:
            self._alerts[record.alert_id] = StandingAlert(
                record.alert_id, record.kind, record.severity, record.text, record.since_ns, record.acknowledged
            )
        self._diagnose()

    def close(self) -> None:
        """Leave the graph.  Calling it twice does nothing more."""
        self._leave()

    def _diagnose(self) -> None:
        topics = self._ready()
        if topics is None or self._state is None:
            return
        state, held_back = self._state, self._held_back()
        name = f"{self._layout.node.name}: {state.robot}/{state.camera}"
        broadcast = f"no: {held_back}" if held_back else "yes"
        alerts = list(self._alerts.values())
        topics.diagnostics.put(self._messages.diagnostics(name, state, self._frame, alerts, broadcast))

    def _held_back(self) -> str:
        """Why the newest transform isn't published; empty if it is."""
        if self._frame is None:
            return "no frame yet"
        if self._frame.verdict not in self._verdicts:
            return f"verdict {self._frame.verdict}"
        if (waited_s := 1e-9 * self._frame.latency_ns) > MOST_WAITED_S:
            return f"judged {waited_s:.2g} s after its frame came, at most {MOST_WAITED_S:g} s"
        return "no transform" if self._chosen(self._frame) is None else ""

    def _chosen(self, record: FrameRecord) -> tuple[Transform, Iterable[float]] | None:
        """``cam_T_grip`` and its covariance, as the settings want them; None if the record has none."""
        if self._smoothed:
            smoothed = record.smoothed
            if smoothed is None:
                return None
            return Transform(smoothed.translation_m, smoothed.rotation_xyzw), smoothed.covariance
        if record.cam_T_grip is None or record.covariance is None:
            return None
        return record.cam_T_grip, record.covariance

    def _ready(self) -> _Topics | None:
        """The topics; None while there is no session.  Raises RuntimeError if they could not be declared."""
        if self._fault:
            raise RuntimeError(self._fault)
        return self._topics

    def _adopt(self, session: zenoh.Session) -> None:
        """Enter the graph.  Failures are reported later, because others also wait for the session."""
        import zenoh

        layout = self._layout
        node = None
        try:
            node = Node(session, layout.domain_id, layout.node)
            # Not express: three such messages a frame would crowd the queue that the transform itself goes through.
            priority = zenoh.Priority.INTERACTIVE_LOW
            self._topics = _Topics(
                node,
                node.publisher(layout.tf_topic, TF, _TF_QOS, priority=priority),
                node.publisher(layout.pose_topic, POSE, priority=priority),
                node.publisher(layout.diagnostics_topic, DIAGNOSTICS),
            )
        except Exception as error:  # noqa: BLE001  reported with the next record
            self._fault = f"the ROS 2 node could not be declared: {error}"
            _log.debug("%s", self._fault, exc_info=error)
            if node is not None:
                node.close()

    def _leave(self) -> None:
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.node.close()
