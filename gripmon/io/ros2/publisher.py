"""The monitor as a ROS 2 node."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gripmon.io.ros2.messages import Messages, inverse
from gripmon.io.ros2.names import Qos
from gripmon.io.ros2.node import Node, TopicPublisher
from gripmon.io.ros2.settings import Layout, Ros2Settings
from gripmon.io.ros2.types import DIAGNOSTICS, POSE, TF
from gripmon.io.wire import Link
from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    FrameRecord,
    ReferenceRecord,
    StandingAlert,
    StateRecord,
    Transform,
)

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

_TF_QOS = Qos(depth=100)
"""That of ``tf2_ros``' broadcasters: reliable, volatile, keep last 100."""

MOST_WAITED_S = 0.5
"""What was judged later than this after its frame came is not broadcast: tf takes the newest that comes for what is
true now.  Twice what the client for controllers lets a transform be old by default, so that a busy machine still says
something.
"""


@dataclass(frozen=True, slots=True)
class _Topics:
    node: Node
    tf: TopicPublisher
    pose: TopicPublisher
    diagnostics: TopicPublisher


class Ros2Publisher:
    """Publishes one monitor's records as a node on a link that somebody else closes.

    Transforms with one of the verdicts that the settings name go to tf and to the pose topic, stamped with the frame's
    capture time; one that waited in the monitor does not.  Diagnostics go out with every state record (once a second
    and on every change) and every alert.  While the link isn't open, nothing is kept: what comes late to tf is old, and
    diagnostics are said again.
    """

    def __init__(self, link: Link, settings: Ros2Settings, layout: Layout) -> None:
        """Raises :class:`gripmon.io.ros2.Ros2Missing` without ``rosbags``."""
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

    def transform(self, record: FrameRecord) -> None:
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

    def state(self, record: StateRecord) -> None:
        """Publish diagnostics."""
        self._state = record
        self._alerts = {alert.alert_id: alert for alert in record.open_alerts}
        self._diagnose()

    def alert(self, record: AlertRecord) -> None:
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

    def reference(self, record: ReferenceRecord) -> None:
        """Nothing: the next diagnostics name it."""

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
        """What to put on; None while there is no session.  Raises RuntimeError if it could not be declared."""
        if self._fault:
            raise RuntimeError(self._fault)
        return self._topics

    def _adopt(self, session: zenoh.Session) -> None:
        """Enter the graph.  Others wait for the session, too: what goes wrong here is said later."""
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
        except Exception as error:  # noqa: BLE001  said with the next record
            self._fault = f"the ROS 2 node could not be declared: {error}"
            _log.debug("%s", self._fault, exc_info=error)
            if node is not None:
                node.close()

    def _leave(self) -> None:
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.node.close()
