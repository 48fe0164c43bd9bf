"""A camera of ROS 2: the newest image of a topic, the jaw opening of joint states, and a watch on its calibration."""

from __future__ import annotations

import time
from typing import Annotated, Any

import msgspec

from gripmon.io.jaw import LARGEST_OPENING_M, Openings, ReportedOpening
from gripmon.io.ros2.node import Ros2Missing, RosNode, check_rclpy
from gripmon.io.ros2.settings import Domain, Topic
from gripmon.io.sources.base import SourceError
from gripmon.io.sources.camera_info import is_rectified, lens_fault, lens_of
from gripmon.io.sources.network import Arrival, ArrivingCamera, Content, SilentAfter, largest_bytes_of
from gripmon.io.sources.payload import PayloadError, file_image, message_image
from gripmon.io.wire.malformed import Malformed
from gripmon.model.camera import Camera
from gripmon.model.errors import one_line
from gripmon.model.images import JPEG, PNG
from gripmon.model.jaw import JointOpening, positions_by_joint
from gripmon.model.pixels import without_mosaic
from gripmon.model.records.values import NS_PER_S

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
JAW_MAX_AGE_S = 1.0
"""As ``publish.jaw_max_age_s`` by default: an opening that came longer ago isn't used."""
_INFO_EVERY_S = 1.0


class Ros2CameraSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="ros2"
):
    """A camera of ROS 2, by rclpy."""

    image: Annotated[Topic, msgspec.Meta(description="topic of the images, Image or CompressedImage, its full name")]
    camera_info: Annotated[Topic, msgspec.Meta(description="topic of the CameraInfo, to be watched")] | None = None
    joint_states: Annotated[Topic, msgspec.Meta(description="topic of the JointState with the jaw")] | None = None
    opening: JointOpening | None = None
    domain_id: Domain | None = None
    silent_after_s: SilentAfter = 1.0

    def fault(self) -> tuple[str, str, str] | None:
        """Key, what is wrong and what would be right; None if nothing is."""
        if self.opening is None and self.joint_states is not None:
            return "source.opening", "is missing", "a section: joints (their names), scale, offset_m"
        if self.opening is not None and self.joint_states is None:
            return "source.joint_states", "is missing", "the topic of the opening's joints, /joint_states"
        return None


class Ros2Camera(ArrivingCamera):
    """The newest image of a topic, whichever of the two types its publisher has, in sensor-data quality of service.

    Stamps are the headers'.  Images stay serialised until they are read.  Of joint states, those of other joints are
    passed over; a malformed one, or an opening that the gripper can't have, is counted and reported, and the one before
    stays in use until it is too old.
    """

    def __init__(
        self, settings: Ros2CameraSettings, size_px: tuple[int, int], camera: Camera | None = None,
        travel_m: tuple[float, float] = (0.0, LARGEST_OPENING_M),
    ) -> None:  # fmt: skip
        """``size_px`` is (width, height) of every image; ``camera``: the configuration's, to be compared with the
        CameraInfo; ``travel_m``: smallest and largest opening.  Raises :class:`SourceError` without ROS 2.
        """
        super().__init__(settings.image, settings.silent_after_s)
        self._settings, self._size_px, self._camera = settings, size_px, camera
        self._openings = Openings(travel_m, JAW_MAX_AGE_S)
        self._joints = Malformed("joint state", settings.joint_states or "")
        self._subscription: Any = None
        self._type = self._waits = self._several = self._info = self._info_fault = self._contradiction = ""
        self._next_info_s = 0.0
        try:
            check_rclpy()
            self._node = RosNode("gripmon_input", "/", settings.domain_id, self._set_up, self._tend)
        except Ros2Missing as error:
            raise SourceError(f"kind: ros2 {error}") from None

    @property
    def malformed(self) -> int:
        return super().malformed + self._joints.count

    def fault(self) -> str:
        opening = "" if self._settings.opening is None else self._openings.fault()
        faults = (
            self._node.fault(), super().fault(), self._several, self._info_fault, opening, self._joints.fault(),
        )  # fmt: skip
        return "; ".join(fault for fault in faults if fault)

    def close(self) -> None:
        super().close()
        self._node.close()

    def _set_up(self, node: Any) -> None:
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, JointState

        self._subscription, self._type = None, ""
        if (topic := self._settings.joint_states) is not None:
            node.create_subscription(JointState, topic, self._heard_joints, qos_profile_sensor_data, raw=True)
        if (topic := self._settings.camera_info) is not None:
            node.create_subscription(CameraInfo, topic, self._heard_info, qos_profile_sensor_data, raw=True)

    def _tend(self, node: Any) -> None:
        """Subscribe to what the topic's publisher has, and keep why nothing comes."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import CompressedImage, Image

        known = {IMAGE: Image, COMPRESSED_IMAGE: CompressedImage}
        publishers = node.get_publishers_info_by_topic(self.key)
        types = {found.topic_type for found in publishers}
        mixed = f"{self.key} has {len(publishers)} publishers, whose images come mixed; one"
        self._several = mixed if len(publishers) > 1 else ""
        domain = f"in ROS domain {self._node.domain_id}"
        if not types:
            there = node.get_topic_names_and_types()
            others = sorted(name for name, kinds in there if known.keys() & set(kinds) and name != self.key)
            self._waits = f"{self.key} has no publisher {domain}; images there: {', '.join(others)[:200] or 'none'}"
        elif not types & known.keys():
            self._waits = f"{self.key} {domain} is {', '.join(sorted(types))[:200]}; {IMAGE} or CompressedImage"
        else:
            self._waits = f"{self.key} is silent {domain}"
            if self._type not in types:
                if self._subscription is not None:
                    node.destroy_subscription(self._subscription)
                self._type = max(types & known.keys())  # pixels before files
                self._subscription = node.create_subscription(
                    known[self._type], self.key, lambda payload, kind=self._type: self._arrived((kind, payload)),
                    QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT), raw=True,
                )  # fmt: skip

    def _heard_joints(self, payload: bytes) -> None:
        from rclpy.serialization import deserialize_message
        from sensor_msgs.msg import JointState

        assert self._settings.opening is not None, "checked with the settings"
        try:
            message = deserialize_message(payload, JointState)
            positions = positions_by_joint(message.name, message.position)
            if (opening_m := self._settings.opening.opening_m(positions)) is not None:
                self._openings.take(ReportedOpening(_stamp_ns(message), opening_m))
                self._joints.good()
        except Exception as error:  # noqa: BLE001  rclpy's own for what it can't decode
            self._joints.add(one_line(error))

    def _heard_info(self, message: bytes) -> None:
        """Compare the calibration with the configuration's, then with the first one."""
        from rclpy.serialization import deserialize_message
        from sensor_msgs.msg import CameraInfo

        if (now_s := time.monotonic()) < self._next_info_s:
            return
        self._next_info_s = now_s + _INFO_EVERY_S
        topic = self._settings.camera_info
        try:
            info = deserialize_message(message, CameraInfo)
            lens = lens_of(info, rectified=is_rectified(self.key))
            told = repr((lens, info.roi, info.binning_x, info.binning_y))
            if not self._info and self._camera is not None and lens is not None:
                self._contradiction = lens_fault(lens, self._camera.settings) or ""
        except Exception as error:  # noqa: BLE001  rclpy's own for what it can't decode
            self._info_fault = f"{topic}: {one_line(error)}"
            return
        self._info = self._info or told
        self._info_fault = f"{topic}: {self._contradiction}" if self._contradiction else ""
        if told != self._info:
            self._info_fault = f"{topic} isn't that of the start any more; start again"

    def _content(self, arrival: Arrival) -> Content:
        from rclpy.serialization import deserialize_message
        from sensor_msgs.msg import CompressedImage, Image

        kind, payload = arrival.sample
        if len(payload) > (most := largest_bytes_of(self._size_px)):
            raise PayloadError(f"{len(payload)} bytes; at most {most} for an image of this camera")
        message = deserialize_message(payload, Image if kind == IMAGE else CompressedImage)
        data = bytes(message.data)
        if kind == IMAGE:
            image = message_image(message, data, self._size_px)
        elif data.startswith((JPEG, PNG)) and "compressedDepth" not in message.format:
            image = without_mosaic(file_image(data, self._size_px), data, message.format)
        else:
            raise PayloadError(f"format {message.format[:40]!r}, first {data[:8].hex() or 'nothing'}; JPEG or PNG")
        stamp_ns = _stamp_ns(message) or arrival.unix_ns
        return Content(image, stamp_ns, self._openings.opening_m(stamp_ns))

    def _why_silent(self) -> str:
        return self._node.fault() or self._waits or f"{self.key} is looked for"


def _stamp_ns(message: Any) -> int:
    """Of the header; 0 if the sender left it empty."""
    stamp = message.header.stamp
    if stamp.sec < 0 or stamp.nanosec >= NS_PER_S:
        raise PayloadError(f"header.stamp: {stamp.sec} s and {stamp.nanosec} ns isn't a time")
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
