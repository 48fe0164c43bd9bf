"""A ROS 2 node on a Zenoh session: its tokens in the graph, its publishers, and the messages that it receives.

Message types, their hashes and CDR are ``rosbags``', imported when first needed.  Source: ``docs/design.md`` of
``rmw_zenoh`` (sections "Graph Cache" and "Publishers") and its ``rmw_publisher_data.cpp``, ``liveliness_utils.cpp``
(how a token becomes a gid) and ``attachment_helpers.cpp``.

Any fault in a message's bytes (CDR) is a :class:`MessageError`.  The payload's size is limited first; ``rosbags`` then
checks each length in the message against the rest of the payload before reading on; then size, step and encoding are
checked against the pixels received.  ``stamp_ns`` is the message's own, Unix nanoseconds; 0 if the sender left it
empty.
"""

from __future__ import annotations

import functools
import itertools
import logging
import math
import struct
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from gripmon.io.ros2.names import DEFAULT_QOS, EndpointKind, NodeName, Qos, endpoint_token, node_token, topic_key
from gripmon.io.wire import Link
from gripmon.model.images import JPEG, PNG
from gripmon.model.pixels import ENCODINGS, unpacked
from gripmon.model.records import Image
from gripmon.model.records.values import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zenoh
    from rosbags.typesys.store import Typestore

_log = logging.getLogger(__name__)

TF = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
JOINT_STATE = "sensor_msgs/msg/JointState"


class Ros2Missing(ImportError):
    """The optional dependencies are missing; the text is ``what is wrong; what would be right``."""


@functools.cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy; those we use are the same, hash by hash, from Iron to Lyrical.

    Raises :class:`Ros2Missing`.
    """
    try:
        import xxhash  # noqa: F401  both come with the same extra: reported at the start, not at the first node
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise Ros2Missing(f"needs the package {error.name}; pip install -e '.[ros2]' in gripmon's checkout") from error
    return get_typestore(Stores.ROS2_JAZZY)


@functools.cache
def type_hash(type_name: str) -> str:
    """``RIHS01_…`` of a type, as REP-2016 has it."""
    return typestore().hash_rihs01(type_name)


def prepare(*type_names: str) -> None:
    """Generate the code for these types now: tens of milliseconds that no frame should wait for."""
    for type_name in type_names:
        typestore().get_msgdef(type_name)
        type_hash(type_name)


_ids = itertools.count()
"""Nodes, publishers and subscriptions of a session share one sequence of numbers; ours are unique in the process."""

_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


def gid_of(token: str) -> bytes:
    """The id by which others know an endpoint: XXH3 of its token, 128 bits, the low half first, little endian."""
    import xxhash

    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


def attachment(sequence_number: int, stamp_ns: int, gid: bytes) -> bytes:
    """The attachment that ``rmw_zenoh`` expects with every message (33 bytes); it drops messages without."""
    return _ATTACHMENT.pack(sequence_number, stamp_ns, _GID_BYTES, gid)


class Node:
    """A node that ``ros2 node list`` shows while the session is open, with what it publishes and subscribes to."""

    def __init__(self, session: zenoh.Session, domain_id: int, name: NodeName) -> None:
        self.domain_id = domain_id
        self.name = name
        self._session = session
        self._zid = str(session.info.zid())
        self._id = next(_ids)
        token = node_token(domain_id, self._zid, self._id, name)
        self._tokens = [session.liveliness().declare_token(token)]

    def publisher(
        self, topic: str, type_name: str, qos: Qos = DEFAULT_QOS, *, priority: zenoh.Priority | None = None
    ) -> TopicPublisher:
        """Publish on a topic (its full name).  On a congested link messages are dropped, as by ``rmw_zenoh`` with every
        history but keep all.  ``priority`` is Zenoh's ``DATA`` by default.
        """
        import zenoh

        token = self.declare("MP", topic, type_name, qos)
        publisher = self._session.declare_publisher(
            topic_key(self.domain_id, topic, type_name, type_hash(type_name)),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA if priority is None else priority,
        )
        return TopicPublisher(publisher, type_name, gid_of(token))

    def declare(self, kind: EndpointKind, topic: str, type_name: str, qos: Qos = DEFAULT_QOS) -> str:
        """Show a publisher (``MP``) or subscription (``MS``) in the graph; returns its token.

        A subscriber works without, but ``ros2 topic info`` doesn't show it, and nodes that publish only to subscribers
        don't publish.
        """
        ids = (self._id, next(_ids))
        token = endpoint_token(
            kind, self.domain_id, self._zid, ids, self.name, topic, type_name, type_hash(type_name), qos
        )
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token

    def close(self) -> None:
        """Leave the graph, in reverse order of declaration.  Calling it twice does nothing more."""
        while self._tokens:
            self._tokens.pop().undeclare()


class TopicPublisher:
    """Messages of one type on one topic."""

    def __init__(self, publisher: zenoh.Publisher, type_name: str, gid: bytes) -> None:
        self._publisher = publisher
        self._type_name = type_name
        self._gid = gid
        self._sequence_number = 0
        self._serialize = typestore().serialize_cdr

    def put(self, message: object) -> None:
        """Send a message of ``rosbags``' type.  Raises the exceptions of ``rosbags`` or Zenoh."""
        payload = bytes(self._serialize(message, self._type_name, little_endian=True))
        self._sequence_number += 1
        beside = attachment(self._sequence_number, time.time_ns(), self._gid)
        self._publisher.put(payload, attachment=beside)


_SENSOR_DATA = Qos(depth=5, reliable=False)


class HeardTopic(NamedTuple):
    """A subscription: a topic by its full name, and its message type."""

    domain_id: int
    topic: str
    type_name: str


class Listeners:
    """Shows a node with subscriptions in the graph of each domain; the subscribers themselves are declared elsewhere.

    They would work without it, but publishers of images publish nothing without visible subscriptions
    (``image_transport``).
    """

    def __init__(self, link: Link, name: NodeName, topics: Sequence[HeardTopic]) -> None:
        """Raises :class:`gripmon.io.ros2.names.RosNameError` for a topic that ROS doesn't allow."""
        self._name = name
        self._topics = [each._replace(topic=name.expand(each.topic)) for each in topics]
        self._nodes: dict[int, Node] = {}
        link.attach(self._adopt, self._leave)

    def _adopt(self, session: zenoh.Session) -> None:
        try:
            for domain_id, topic, type_name in self._topics:
                if domain_id not in self._nodes:
                    self._nodes[domain_id] = Node(session, domain_id, self._name)
                self._nodes[domain_id].declare("MS", topic, type_name, _SENSOR_DATA)
        except Exception as error:  # noqa: BLE001  the subscribers work nevertheless
            _log.warning("ROS 2 tools won't list the subscription to %s: %s", topic, error)
            self._leave()

    def _leave(self) -> None:
        while self._nodes:
            self._nodes.popitem()[1].close()


MOST_IMAGE_BYTES = 1 << 28
"""256 MiB: 89 million pixels in three colours."""
MOST_JOINT_STATE_BYTES = 1 << 18
"""Some thousand joints."""


class MessageError(ValueError):
    """A message that can't be used: ``type_name`` and ``field`` say where, ``what`` is wrong there."""

    def __init__(self, type_name: str, field: str, what: str) -> None:
        super().__init__(f"{type_name}: {field}: {what}" if field else f"{type_name}: {what}")
        self.type_name = type_name
        self.field = field
        self.what = what


def decode_image(payload: bytes) -> tuple[int, Image]:
    """``sensor_msgs/msg/Image`` -> stamp and image: H x W (one channel, and the brightness of ``yuv422``) or H x W x 3,
    BGR (colours, Bayer patterns).

    The encodings are :data:`gripmon.model.pixels.ENCODINGS`; in the machine's byte order; it may be a read-only view of
    the payload.
    """
    message = _decoded(IMAGE, payload, MOST_IMAGE_BYTES)
    pixels = ENCODINGS.get(message.encoding)
    if pixels is None:
        raise MessageError(IMAGE, "encoding", f"{message.encoding[:40]!r}; give one of {', '.join(ENCODINGS)}")
    item_bytes = pixels.item_bytes
    height, width, step = message.height, message.width, message.step
    row_bytes = width * pixels.channels * item_bytes
    if height == 0 or width == 0:
        raise MessageError(IMAGE, "height, width", f"{width} x {height} px; give an image with pixels")
    if step < row_bytes:
        raise MessageError(IMAGE, "step", f"{step} bytes for rows of {width} px {message.encoding}: {row_bytes} bytes")
    if step % item_bytes:
        raise MessageError(IMAGE, "step", f"{step} bytes is not a multiple of a pixel's {item_bytes}")
    if message.data.size != height * step:
        raise MessageError(
            IMAGE, "data", f"{message.data.size} bytes; height {height} times step {step} are {height * step}"
        )
    order = ">" if message.is_bigendian else "<"
    rows = message.data.view(f"{order}{pixels.dtype}").reshape(height, step // item_bytes)
    return _stamp_ns(IMAGE, message.header.stamp), unpacked(rows, width, pixels)


def decode_compressed_image(payload: bytes) -> tuple[int, str, bytes]:
    """``sensor_msgs/msg/CompressedImage`` -> stamp, ``jpeg`` or ``png``, and the file's bytes, not decoded yet."""
    message = _decoded(COMPRESSED_IMAGE, payload, MOST_IMAGE_BYTES)
    data = message.data.tobytes()
    if "compressedDepth" in message.format:
        raise MessageError(COMPRESSED_IMAGE, "format", f"{message.format[:40]!r} is a depth image; give jpeg or png")
    for name, beginning in (("jpeg", JPEG), ("png", PNG)):
        if data.startswith(beginning):
            return _stamp_ns(COMPRESSED_IMAGE, message.header.stamp), name, data
    what = f"begins with {data[:8].hex() or 'nothing'}, format {message.format[:40]!r}; give jpeg or png"
    raise MessageError(COMPRESSED_IMAGE, "data", what)


def decode_joint_state(payload: bytes) -> tuple[int, dict[str, float]]:
    """``sensor_msgs/msg/JointState`` -> stamp and each joint's position (m or rad; maybe NaN), empty where the message
    has none.
    """
    message = _decoded(JOINT_STATE, payload, MOST_JOINT_STATE_BYTES)
    names, positions = message.name, message.position
    if len(positions) not in (0, len(names)):
        raise MessageError(JOINT_STATE, "position", f"{len(positions)} positions of {len(names)} joints")
    if len(set(names)) != len(names):
        raise MessageError(JOINT_STATE, "name", "two joints have the same name")
    # A message with only velocities or efforts is allowed.
    pairs = zip(names, positions.tolist(), strict=True) if len(positions) else ()
    return _stamp_ns(JOINT_STATE, message.header.stamp), dict(pairs)


LONGEST_STEP_S = 0.1
"""Between reports farther apart than this the jaw is assumed to have moved only for this time before the later one: a
robot may report only while the jaws move.
"""


def opening_between(first: tuple[int, float], last: tuple[int, float], wanted_ns: int) -> float:
    """The opening (m) at a time between two reports, stamps (ns) with openings (m): linear, but see
    :data:`LONGEST_STEP_S`.
    """
    (first_ns, first_m), (last_ns, last_m) = first, last
    share = min((last_ns - wanted_ns) / min(last_ns - first_ns, 1e9 * LONGEST_STEP_S), 1.0)
    return last_m + share * (first_m - last_m)


class JointOpening(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the jaws are open, from the positions of joints: ``offset_m + scale · (sum of the joints)``."""

    joints: Annotated[
        tuple[str, ...],
        Meta(min_length=1, max_length=8, description="joint names in JointState; the positions of several are summed"),
    ]
    scale: Annotated[float, Meta(description="metres of opening per unit of the summed positions (m/m, or m/rad)")] = (
        1.0
    )
    offset_m: Annotated[float, Meta(description="opening where the summed positions are zero (m)")] = 0.0

    def opening_m(self, positions: Mapping[str, float]) -> float | None:
        """The opening (m); None for a message about other joints only.

        Raises :class:`MessageError` for one that has some of the joints only, or a position that is not finite.
        """
        there = [name for name in self.joints if name in positions]
        if not there:
            return None
        if len(there) < len(self.joints):
            missing = ", ".join(name for name in self.joints if name not in positions)
            raise MessageError(JOINT_STATE, "name", f"{', '.join(there)} without {missing}")
        opening_m = self.offset_m + self.scale * sum(positions[name] for name in self.joints)
        if not math.isfinite(opening_m):
            raise MessageError(JOINT_STATE, "position", f"of {', '.join(self.joints)} is not finite")
        return opening_m


def _decoded(type_name: str, payload: bytes, most_bytes: int) -> Any:
    from rosbags.serde import SerdeError

    if len(payload) > most_bytes:
        raise MessageError(type_name, "", f"{len(payload)} bytes; at most {most_bytes} are taken")
    try:
        # A memoryview, so that slices aren't copies.
        return typestore().deserialize_cdr(memoryview(payload), type_name)
    except SerdeError as error:
        raise MessageError(type_name, "", str(error).removeprefix(f"Could not deserialize {type_name!r}: ")) from None


def _stamp_ns(type_name: str, stamp: Any) -> int:
    if stamp.sec < 0 or stamp.nanosec >= NS_PER_S:
        raise MessageError(type_name, "header.stamp", f"{stamp.sec} s and {stamp.nanosec} ns isn't a time")
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
