"""ROS 2 messages that come in -> stamps, images and jaw openings.

Everything here takes the bytes of one message as ``rmw_zenoh`` sends it (CDR) and raises :class:`MessageError` for
whatever is wrong with them.  The payload's size is limited first; ``rosbags`` then checks each length that the message
names against what is left of the payload before it reads on; only then are sizes, step and encoding held against
the pixels that came.

``stamp_ns`` is the message's own, Unix nanoseconds; 0 where the sender left it empty.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from gripmon.io.ros2.types import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, typestore
from gripmon.model.pixels import ENCODINGS, unpacked
from gripmon.model.records import Image

if TYPE_CHECKING:
    from collections.abc import Mapping

MOST_IMAGE_BYTES = 1 << 28
"""256 MiB: 89 million pixels in three colours."""
MOST_JOINT_STATE_BYTES = 1 << 18
"""Some thousand joints."""
_NS = 1_000_000_000
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"


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
        raise MessageError(IMAGE, "step", f"{step} bytes is no multiple of a pixel's {item_bytes}")
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
    for name, beginning in (("jpeg", _JPEG), ("png", _PNG)):
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
    # Velocities and efforts alone are allowed, too.
    pairs = zip(names, positions.tolist(), strict=True) if len(positions) else ()
    return _stamp_ns(JOINT_STATE, message.header.stamp), dict(pairs)


class JointOpening(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the jaws are open, from the positions of joints: ``offset_m + scale · (sum of the joints)``."""

    joints: Annotated[
        tuple[str, ...],
        Meta(min_length=1, max_length=8, description="names in JointState; of several the positions are added"),
    ]
    scale: Annotated[
        float, Meta(description="metres of opening for a unit of the summed positions (m/m, or m/rad)")
    ] = 1.0
    offset_m: Annotated[float, Meta(description="opening where the summed positions are zero (m)")] = 0.0

    def opening_m(self, positions: Mapping[str, float]) -> float | None:
        """The opening (m); None for a message about other joints only.

        Raises :class:`MessageError` for one that has some of the joints only, or a position that is no finite number.
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
    if stamp.sec < 0 or stamp.nanosec >= _NS:
        raise MessageError(type_name, "header.stamp", f"{stamp.sec} s and {stamp.nanosec} ns is no time")
    return int(stamp.sec) * _NS + int(stamp.nanosec)
