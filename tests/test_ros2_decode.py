"""Messages written by another CDR library, read by ours; and what is refused of those that are wrong."""

from __future__ import annotations

import contextlib
import math
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import ros2_idl as idl

from gripmon.io.ros2.names import RosNameError, subscription_key
from gripmon.io.ros2.node import (
    MOST_JOINT_STATE_BYTES,
    JointOpening,
    MessageError,
    decode_compressed_image,
    decode_image,
    decode_joint_state,
)

HEADER = idl.Header(idl.Time(1_700_000_000, 123_456_789), "wrist_optical_frame")
STAMP_NS = 1_700_000_000_123_456_789


def image_payload(
    data: bytes, encoding: str, width: int, height: int, step: int, *, big: bool = False, header: idl.Header = HEADER
) -> bytes:
    return idl.Image(header, height, width, encoding, int(big), step, list(data)).serialize()


def colours(height: int = 6, width: int = 5) -> NDArray[np.uint8]:
    """H x W x 3, BGR, no two values of a pixel alike."""
    return np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "rgba8"])
def test_colour_images(encoding: str, padding: int):
    bgr = colours()
    sent = bgr if encoding.startswith("bgr") else bgr[..., ::-1]
    if "a8" in encoding:
        sent = np.dstack([sent, np.full(sent.shape[:2], 255, np.uint8)])
    rows = sent.reshape(len(bgr), -1)
    rows = np.hstack([rows, np.full((len(bgr), padding), 99, np.uint8)])
    stamp_ns, image = decode_image(image_payload(rows.tobytes(), encoding, 5, 6, rows.shape[1]))
    assert stamp_ns == STAMP_NS
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, bgr)


@pytest.mark.parametrize("big", [False, True])
def test_grey_images(big: bool):
    grey = np.array([[1, 2, 300], [40_000, 5, 65_535]], np.uint16)
    # 8 bytes for a row of 6: two of padding.
    rows = np.hstack([grey, [[7], [7]]]).astype(">u2" if big else "<u2")
    _, image = decode_image(image_payload(rows.tobytes(), "mono16", 3, 2, 8, big=big))
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, grey)
    _, image = decode_image(image_payload(bytes(range(8)), "mono8", 3, 2, 4, big=big))
    np.testing.assert_array_equal(image, [[0, 1, 2], [4, 5, 6]])


@pytest.mark.parametrize("big", [False, True])
def test_what_drivers_of_industrial_and_usb_cameras_send(big: bool):
    order = ">" if big else "<"
    parts = np.array([[0.0, 0.5], [1.0, 0.25]], np.float32)
    _, image = decode_image(image_payload(parts.astype(f"{order}f4").tobytes(), "32FC1", 2, 2, 8, big=big))
    np.testing.assert_array_equal(image, parts)
    assert image.dtype == np.float32
    for encoding, channel in (("yuv422", 1), ("yuv422_yuy2", 0)):
        both = np.array([[0, 47, 94, 141], [188, 235, 240, 255]], np.uint8)[..., None] * np.ones(2, np.uint8)
        both[..., 1 - channel] = 128
        _, image = decode_image(image_payload(both.tobytes(), encoding, 4, 2, 8, big=big))
        np.testing.assert_array_equal(image, [[0, 51, 102, 153], [204, 255, 255, 255]])
    rgb16 = np.arange(18, dtype=np.uint16).reshape(2, 3, 3) * 3000
    _, image = decode_image(image_payload(rgb16.astype(f"{order}u2").tobytes(), "rgb16", 3, 2, 18, big=big))
    np.testing.assert_array_equal(image, rgb16[:, :, ::-1])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_images(pattern: str):
    """A surface of one colour, filtered as the encoding's name says, comes back in that colour."""
    colour = {"b": 30, "g": 90, "r": 200}
    tile = np.array([[colour[c] for c in pattern[:2]], [colour[c] for c in pattern[2:]]], np.uint8)
    mosaic = np.tile(tile, (4, 5))
    _, image = decode_image(image_payload(mosaic.tobytes(), f"bayer_{pattern}8", 10, 8, 10))
    assert image.shape == (8, 10, 3)
    np.testing.assert_array_equal(image, np.broadcast_to([30, 90, 200], image.shape))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"encoding": "64FC1"}, "encoding"),
        ({"encoding": "x" * 5000}, "encoding"),
        ({"width": 0, "step": 0, "data": b""}, "height, width"),
        ({"step": 14}, "step"),
        ({"width": 2**32 - 1}, "step"),
        ({"encoding": "mono16", "width": 7}, "step"),
        ({"data": bytes(89)}, "data"),
        ({"data": bytes(91)}, "data"),
        ({"height": 2**32 - 1, "step": 2**32 - 1}, "data"),
        ({"header": idl.Header(idl.Time(-1, 0), "")}, "header.stamp"),
        ({"header": idl.Header(idl.Time(5, 1_000_000_000), "")}, "header.stamp"),
    ],
)
def test_images_that_contradict_themselves(changes: dict[str, object], field: str):
    fields = {"data": bytes(90), "encoding": "bgr8", "width": 5, "height": 6, "step": 15} | changes
    with pytest.raises(MessageError) as caught:
        decode_image(image_payload(**fields))
    assert caught.value.type_name == "sensor_msgs/msg/Image" and caught.value.field == field
    assert len(str(caught.value)) < 400 and "\n" not in str(caught.value)


def test_a_length_beyond_the_payload():
    """Four thousand million pixels are promised; nothing is reserved for them."""
    payload = bytearray(image_payload(bytes(90), "bgr8", 5, 6, 15))
    length_at = len(payload) - 90 - 4
    assert struct.unpack_from("<I", payload, length_at) == (90,)
    struct.pack_into("<I", payload, length_at, 2**32 - 1)
    with pytest.raises(MessageError, match="4294967295"):
        decode_image(bytes(payload))


def test_payloads_beyond_all_measure():
    with pytest.raises(MessageError, match=r"^sensor_msgs/msg/JointState: 262145 bytes; at most 262144 are taken$"):
        decode_joint_state(bytes(MOST_JOINT_STATE_BYTES + 1))


@pytest.mark.parametrize(("name", "said"), [("jpeg", "jpeg"), ("png", "bgr8; png compressed bgr8"), ("jpeg", "")])
def test_compressed_images(name: str, said: str):
    picture = np.full((16, 16, 3), (30, 90, 200), np.uint8)
    file = cv2.imencode(f".{name}", picture)[1].tobytes()
    payload = idl.CompressedImage(HEADER, said, list(file)).serialize()
    assert decode_compressed_image(payload) == (STAMP_NS, name, file)


@pytest.mark.parametrize(
    ("said", "data", "field"),
    [("jpeg", b"", "data"), ("jpeg", b"BM12345", "data"), ("16UC1; compressedDepth png", bytes(20), "format")],
)
def test_compressed_images_of_another_kind(said: str, data: bytes, field: str):
    with pytest.raises(MessageError) as caught:
        decode_compressed_image(idl.CompressedImage(HEADER, said, list(data)).serialize())
    assert caught.value.field == field


def joint_state(names: list[str], positions: list[float]) -> bytes:
    return idl.JointState(HEADER, names, positions, [0.5] * len(names), []).serialize()


def test_joint_states():
    stamp_ns, positions = decode_joint_state(joint_state(["elbow", "left", "right"], [1.25, 0.01, 0.02]))
    assert stamp_ns == STAMP_NS
    assert positions == {"elbow": 1.25, "left": 0.01, "right": 0.02}
    assert decode_joint_state(joint_state(["elbow"], [])) == (STAMP_NS, {})
    with pytest.raises(MessageError, match="2 positions of 1 joints"):
        decode_joint_state(joint_state(["elbow"], [1.0, 2.0]))
    with pytest.raises(MessageError, match="same name"):
        decode_joint_state(joint_state(["elbow", "elbow"], [1.0, 2.0]))


def test_opening_from_joints():
    both = JointOpening(joints=("left", "right"))
    assert both.opening_m({"elbow": 1.0, "left": 0.01, "right": 0.02}) == pytest.approx(0.03)
    turning = JointOpening(joints=("knuckle",), scale=-0.1, offset_m=0.085)
    assert turning.opening_m({"knuckle": 0.4}) == pytest.approx(0.045)
    assert both.opening_m({"elbow": 1.0}) is None
    with pytest.raises(MessageError, match="left without right"):
        both.opening_m({"left": 0.01})
    with pytest.raises(MessageError, match="not finite"):
        both.opening_m({"left": 0.01, "right": math.nan})


@settings(max_examples=300)
@given(data=st.data())
def test_whatever_comes_is_decoded_or_refused_in_words(data: st.DataObject):
    decode, good = data.draw(
        st.sampled_from(
            [
                (decode_image, image_payload(bytes(90), "bgr8", 5, 6, 15)),
                (decode_compressed_image, idl.CompressedImage(HEADER, "jpeg", [0xFF, 0xD8, 0xFF, 0]).serialize()),
                (decode_joint_state, joint_state(["left", "right"], [0.01, 0.02])),
            ]
        )
    )
    payload = bytearray(good[: data.draw(st.integers(0, len(good)))])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, 80), st.integers(0, 255)), max_size=6)):
        if at < len(payload):
            payload[at] = value
    payload += data.draw(st.binary(max_size=20))
    with contextlib.suppress(MessageError):
        decode(bytes(payload))


def test_subscriptions_take_any_hash():
    assert subscription_key(3, "/camera/image_raw", "sensor_msgs/msg/Image") == (
        "3/camera/image_raw/sensor_msgs::msg::dds_::Image_/*"
    )
    for domain, topic, name in [
        (233, "/a", "a/msg/A"),
        (0, "a", "a/msg/A"),
        (0, "/a//b", "a/msg/A"),
        (0, "/a/*", "a/msg/A"),
        (0, "/a", "Image"),
    ]:
        with pytest.raises(RosNameError, match="give"):
            subscription_key(domain, topic, name)
