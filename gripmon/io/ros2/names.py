"""ROS 2 names, the Zenoh keys that ``rmw_zenoh`` makes of them, and the settings that they follow from.

Source: the design document of ``rmw_zenoh`` (https://github.com/ros2/rmw_zenoh, ``docs/design.md``), sections "Topic
and Service name mapping to Zenoh key expressions" and "Graph Cache"; the text of a QoS is ``qos_to_keyexpr`` in its
``liveliness_utils.cpp``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.io.wire import DEFAULT_ENDPOINT, PublishSettings
from gripmon.io.wire.session import Endpoint

MOST_DOMAIN_ID = 232
"""As with every other ROS 2 middleware; Zenoh itself would accept any number."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv)/([A-Z][A-Za-z0-9]*)")
_UNSET_DEPTH = 42  # rmw_zenoh's value for an unset depth, which it omits

EndpointKind = Literal["MP", "MS"]


class RosNameError(ValueError):
    """An invalid ROS 2 name; the text names it and says what would be right."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service, as far as we use it: always keep last, never a deadline."""

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False

    def __str__(self) -> str:
        """As in liveliness tokens, ``reliability:durability:history,depth:deadline:lifespan:liveliness``; what is
        ``rmw_zenoh``'s default stays empty.
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == _UNSET_DEPTH else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


DEFAULT_QOS = Qos()
"""ROS 2's default: reliable, volatile, keep last 10."""


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node and its namespace, which begins with ``/``."""

    name: str
    namespace: str = "/"

    def __post_init__(self) -> None:
        if not _TOKEN.fullmatch(self.name):
            raise RosNameError(f"node name {self.name!r}; give letters, digits and _, no digit in front")
        check_qualified("namespace", self.namespace, root=True)

    def expand(self, topic: str) -> str:
        """The full name of a topic: ``~/x`` is below the node, ``x`` below the namespace, ``/x`` stays."""
        base = self.namespace.rstrip("/")
        if topic.startswith("~/"):
            topic = f"{base}/{self.name}/{topic[2:]}"
        elif not topic.startswith("/"):
            topic = f"{base}/{topic}"
        return check_qualified("topic", topic)


def check_qualified(role: str, name: str, *, root: bool = False) -> str:
    """The name; raises :class:`RosNameError` unless it is ``/one/or/more`` tokens, or ``/`` itself if ``root``."""
    if root and name == "/":
        return name
    if not name.startswith("/") or not all(_TOKEN.fullmatch(token) for token in name[1:].split("/")):
        raise RosNameError(f"{role} {name!r}; give /tokens of letters, digits and _, no digit in front, e.g. /arm/tf")
    return name


def as_token(text: str) -> str:
    """A gripmon name as one token of a ROS name: characters that aren't allowed become ``_``."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return token if _TOKEN.fullmatch(token) else f"_{token}"


def dds_type(type_name: str) -> str:
    """``std_msgs/msg/String`` -> ``std_msgs::msg::dds_::String_``."""
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise RosNameError(f"type {type_name!r}; give package/msg/Type, e.g. sensor_msgs/msg/Image")
    return f"{match[1]}::{match[2]}::dds_::{match[3]}_"


def topic_key(domain_id: int, topic: str, type_name: str, type_hash: str) -> str:
    """The key for publishing: ``<domain>/<topic>/<type>/<hash>``."""
    return f"{check_domain(domain_id)}{check_qualified('topic', topic)}/{dds_type(type_name)}/{type_hash}"


def subscription_key(domain_id: int, topic: str, type_name: str) -> str:
    """The key expression for subscribing to that type, with any hash, since distributions differ in it.

    ``topic`` is a full name, ``/camera/image_raw``.  Raises :class:`RosNameError`.
    """
    return topic_key(domain_id, topic, type_name, "*")


def node_token(domain_id: int, zid: str, node_id: int, node: NodeName) -> str:
    """The liveliness token of a node, by which ``ros2 node list`` finds it."""
    return _token(domain_id, zid, node_id, node_id, "NN", node)


def endpoint_token(
    kind: EndpointKind,
    domain_id: int,
    zid: str,
    ids: tuple[int, int],
    node: NodeName,
    topic: str,
    type_name: str,
    type_hash: str,
    qos: Qos,
) -> str:
    """The liveliness token of a publisher (``MP``) or subscription (``MS``); ``ids`` are the node's and its own."""
    whose = _token(domain_id, zid, *ids, kind, node)
    return f"{whose}/{_mangled(check_qualified('topic', topic))}/{dds_type(type_name)}/{type_hash}/{qos}"


def check_domain(domain_id: int) -> int:
    """The domain; raises :class:`RosNameError` outside of 0 to 232."""
    if not 0 <= domain_id <= MOST_DOMAIN_ID:
        raise RosNameError(f"domain {domain_id}; give ROS_DOMAIN_ID, 0 to {MOST_DOMAIN_ID}")
    return domain_id


def _token(domain_id: int, zid: str, node_id: int, entity_id: int, kind: str, node: NodeName) -> str:
    enclave = "%"  # none: SROS 2 is not supported
    where = f"{check_domain(domain_id)}/{zid}/{node_id}/{entity_id}"
    return f"@ros2_lv/{where}/{kind}/{enclave}/{_mangled(node.namespace)}/{node.name}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


Frame = Annotated[str, Meta(pattern=r"^[^/\s]\S*$", description="a frame of tf: no blank, no / in front")]


class Ros2Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A node on ``rmw_zenoh``, without ROS and without a bridge."""

    enabled: Annotated[bool, Meta(description="true: also publish for ROS 2 nodes on rmw_zenoh")] = False
    domain_id: Annotated[
        int, Meta(ge=0, le=MOST_DOMAIN_ID, description="ROS_DOMAIN_ID of those nodes; the variable itself isn't read")
    ] = 0
    router: (
        Annotated[
            Endpoint,
            Meta(
                description="the router of ROS 2 (rmw_zenohd), joined as client while publish.mode, listen, connect "
                "and zenoh_config are at their defaults; null: publish holds as it is"
            ),
        ]
        | None
    ) = DEFAULT_ENDPOINT
    node: Annotated[str, Meta(description="name of the node: letters, digits and _")] = "gripmon"
    namespace: (
        Annotated[str, Meta(description="namespace of the node, e.g. / or /arm1; null: /<robot>/<camera_name>")] | None
    ) = None
    publish: Annotated[
        Literal["camera_from_gripper", "gripper_from_camera"],
        Meta(
            description="camera_from_gripper: cam_T_grip, the gripper as child of the camera; gripper_from_camera: its "
            "inverse, the camera as child of the gripper"
        ),
    ] = "camera_from_gripper"
    parent_frame: (
        Annotated[
            Frame,
            Meta(
                description="frame in tf that the transform hangs below: the camera's optical frame, null: "
                "<camera_name>_optical_frame; with gripper_from_camera the gripper's (origin at the TCP, x across the "
                "jaws, z out), to be given"
            ),
        ]
        | None
    ) = None
    child_frame: (
        Annotated[
            Frame,
            Meta(
                description="the new frame in tf, which no other node may publish; null: <robot>_<camera_name>_gripmon"
            ),
        ]
        | None
    ) = None
    transform: Annotated[
        Literal["raw", "smoothed"], Meta(description="raw: of each frame by itself; smoothed: averaged over time")
    ] = "raw"
    verdicts: Annotated[
        tuple[Literal["valid", "suspect"], ...],
        Meta(
            min_length=1,
            description="verdicts whose transforms are published on tf_topic and pose_topic; unknown is never "
            "published, since tf has no field for it",
        ),
    ] = ("valid",)
    tf_topic: Annotated[str, Meta(description="topic of the tf2_msgs/TFMessage")] = "/tf"
    pose_topic: (
        Annotated[
            str,
            Meta(
                description="topic of the geometry_msgs/PoseWithCovarianceStamped; ~/ is below the node; null: "
                "~/cam_T_grip, or ~/grip_T_cam with gripper_from_camera"
            ),
        ]
        | None
    ) = None


class Ros2Fault(ValueError):
    """An invalid setting: ``key`` below ``ros2``, what is ``wrong``, what would be ``right``."""

    def __init__(self, key: str, wrong: str, right: str) -> None:
        super().__init__(f"ros2.{key}: {wrong}; {right}")
        self.key, self.wrong, self.right = key, wrong, right


@dataclass(frozen=True, slots=True)
class Layout:
    """Names and frames, all of them given."""

    domain_id: int
    node: NodeName
    parent_frame: str
    child_frame: str
    tf_topic: str
    pose_topic: str
    diagnostics_topic: str = "/diagnostics"


def layout_of(settings: Ros2Settings, robot: str, camera: str) -> Layout:
    """The names and frames for this camera.  Raises :class:`Ros2Fault`."""
    inverse = settings.publish == "gripper_from_camera"
    namespace = f"/{as_token(robot)}/{as_token(camera)}" if settings.namespace is None else settings.namespace
    if settings.parent_frame is None and inverse:
        raise Ros2Fault(
            "parent_frame",
            "is not given, and publish is gripper_from_camera",
            "the gripper's frame in tf, origin at the TCP, x across the jaws, z out of the gripper",
        )
    parent = settings.parent_frame or f"{camera}_optical_frame"
    child = settings.child_frame or f"{robot}_{camera}_gripmon"
    if parent == child:
        raise Ros2Fault("child_frame", f"is {child}, the parent's name, too", "a frame of its own")
    key = "node"
    try:
        node = NodeName(settings.node)
        key = "namespace"
        node = NodeName(settings.node, namespace)
        key = "tf_topic"
        tf_topic = node.expand(settings.tf_topic)
        key = "pose_topic"
        pose_topic = node.expand(settings.pose_topic or ("~/grip_T_cam" if inverse else "~/cam_T_grip"))
    except RosNameError as error:
        wrong, _, right = str(error).partition("; give ")
        raise Ros2Fault(key, wrong, right) from None
    return Layout(settings.domain_id, node, parent, child, tf_topic, pose_topic)


def network_of(publish: PublishSettings, ros2: Ros2Settings) -> PublishSettings:
    """How to join the network: as client of the ROS 2 router, unless ``publish`` has network settings."""
    defaults = PublishSettings()
    own = any(getattr(publish, key) != getattr(defaults, key) for key in ("mode", "listen", "connect", "zenoh_config"))
    if not ros2.enabled or ros2.router is None or own:
        return publish
    return msgspec.structs.replace(publish, mode="client", connect=(ros2.router,))


def fault_of(settings: Ros2Settings, publish: PublishSettings, robot: str, camera: str) -> Ros2Fault | None:
    """What is wrong with the section ``ros2`` of a configuration; None if nothing is, or it is off."""
    if not settings.enabled:
        return None
    if not publish.enabled:
        return Ros2Fault("enabled", "is true, but publish.enabled is false", "publish.enabled: true")
    try:
        layout_of(settings, robot, camera)
    except Ros2Fault as fault:
        return fault
    return None
