"""Payloads that are wrong in every way that people and machines get them wrong; the same for the same seed."""

from __future__ import annotations

import functools
import json
import random
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np

SIZE_PX = (32, 24)
"""Width and height of the camera that they are meant for: small, so that many can be tried."""


class Rubbish(NamedTuple):
    payload: bytes
    encoding: str = "zenoh/bytes"
    attachment: bytes | None = None


HUGE = [10**400, -(10**400), 2**63, 2**64, -1, 1e308, -0.0, 10**18, 0]
NOTHING = (None, True, "", "x" * 5000, [], {}, [[[]]])


def image() -> np.ndarray:
    """Of that camera: smooth, with some noise."""
    rng = np.random.default_rng(5)
    rows = np.linspace(0.0, 200.0, SIZE_PX[1])[:, None] + np.linspace(0.0, 50.0, SIZE_PX[0])
    return (rows + rng.integers(0, 5, rows.shape)).astype(np.uint8)


@functools.cache
def files() -> tuple[bytes, ...]:
    """Good JPEG and PNG files: grey, colour, progressive, 16 bits."""
    grey = image()
    colour = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    made = [cv2.imencode(end, each)[1].tobytes() for end in (".jpg", ".png") for each in (grey, colour)]
    made.append(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes())
    made.append(cv2.imencode(".png", grey.astype(np.uint16) * 256)[1].tobytes())
    return tuple(made)


def good_note(**more: Any) -> dict[str, Any]:
    return {
        "stamp_ns": 5,
        "jaw_opening_m": 0.03,
        "width": SIZE_PX[0],
        "height": SIZE_PX[1],
        "encoding": "mono8",
        **more,
    }


def frames(seed: int, count: int) -> Iterator[Rubbish]:
    """Frames by no camera.  A few are good by chance: a flipped bit in a JPEG, a field that no one reads."""
    rng = random.Random(seed)
    kinds: list[Callable[[random.Random], Rubbish]] = [
        lambda r: Rubbish(r.randbytes(r.randrange(200)), r.choice(ENCODINGS), r.choice([None, b"", b"{}"])),
        _damaged_file,
        _damaged_file,
        _bomb,
        lambda r: Rubbish(image().tobytes(), attachment=broken_json(r, good_note())),
        lambda r: Rubbish(image().tobytes()[: r.randrange(SIZE_PX[0] * SIZE_PX[1])], attachment=_json(good_note())),
        lambda r: Rubbish(r.randbytes(r.randrange(3000)), attachment=_json(good_note(**_wrong_field(r)))),
        lambda r: Rubbish(r.choice(files()), r.choice(ENCODINGS), broken_json(r, {"stamp_ns": 5})),
    ]
    for _ in range(count):
        yield rng.choice(kinds)(rng)


ENCODINGS = (
    "zenoh/bytes",
    "image/jpeg",
    "image/png",
    "image/webp",
    "application/json",
    "",
    "image/jpeg;schema",
    "\u2603",
)


def jaws(seed: int, count: int) -> Iterator[bytes]:
    """Jaw messages that tell no opening of a gripper."""
    rng = random.Random(seed)
    good = {"stamp_ns": 5, "opening_m": 0.03}
    kinds: list[Callable[[random.Random], bytes]] = [
        lambda r: r.randbytes(r.randrange(100)),
        lambda r: broken_json(r, good, needed=("stamp_ns", "opening_m")),
        lambda r: _json({**good, "opening_m": r.choice([*HUGE[:6], 10**18, *NOTHING, 7.0, -5.0])}),
        lambda r: str(r.choice([*HUGE[:6], 10**18, 34, -3.4, "NaN", "Infinity", "1e999", "0x3", "0.03 m"])).encode(),
    ]
    for _ in range(count):
        payload = rng.choice(kinds)(rng)
        if not _is_opening(payload):
            yield payload


def _is_opening(payload: bytes) -> bool:
    """By chance it is one: a random byte "0", or a good message with a field that no one minds."""
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return False
    if isinstance(value, dict) and type(value.get("stamp_ns")) is int:
        value = value.get("opening_m")
    return type(value) in (int, float) and -1.0 <= value < 1.0


def ros(seed: int, count: int, good: bytes) -> Iterator[bytes]:
    """CDR by no node: cut, flipped, with other lengths, or nothing of the kind."""
    rng = random.Random(seed)
    for _ in range(count):
        data = bytearray(good)
        match rng.randrange(4):
            case 0:
                data = bytearray(rng.randbytes(rng.randrange(300)))
            case 1:
                del data[rng.randrange(len(data)) :]
            case 2:  # a length or a count, anywhere before the data
                at = 4 * rng.randrange(1, min(len(data), 120) // 4)
                data[at : at + 4] = struct.pack(
                    "<I", rng.choice([2**32 - 1, 2**31, 10**6, 0, 77, rng.randrange(2**32)])
                )
            case _:
                for _ in range(rng.randrange(1, 9)):
                    data[rng.randrange(min(len(data), 120))] = rng.randrange(256)
        yield bytes(data)


def broken_json(rng: random.Random, good: dict[str, Any], needed: tuple[str, ...] = ()) -> bytes:
    """A message with something wrong: cut, nested, not UTF-8, of other types, of another version, too long."""
    text = _json(good)
    match rng.randrange(8):
        case 0:
            return text[: rng.randrange(1, len(text))]
        case 1:
            depth = rng.randrange(1, 4000)
            return b'{"x":' + rng.choice([b"[", b'{"x":']) * depth + rng.choice([b"", b"]" * depth])
        case 2:
            return text[:-1] + rng.choice([b',"x":NaN}', b',"x":\xff}', b',"x":1e}', b"}garbage", b",}"])
        case 3:
            return _json({**good, rng.choice(list(good)): rng.choice([*HUGE[:5], *NOTHING[1:]])})
        case 4:
            return _json({**good, "schema": rng.choice(["gripmon.frame/2", "", 7, "\u202e", "x" * 900])})
        case 5 if needed:
            missing = rng.choice(needed)
            return _json({key: value for key, value in good.items() if key != missing})
        case 6:
            return rng.randbytes(rng.randrange(1, 60))
        case _:
            return _json([good])


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _wrong_field(rng: random.Random) -> dict[str, Any]:
    key = rng.choice(["width", "height", "encoding", "step", "stamp_ns", "jaw_opening_m"])
    names = ["bgr8", "mono16", "bayer_rggb8", "yuv422", "H264", "\x00", "mono8 ", "__class__"]
    return {key: rng.choice([*HUGE, *NOTHING, 31, 33, 65535, *names])}


def _damaged_file(rng: random.Random) -> Rubbish:
    data = bytearray(rng.choice(files()))
    for _ in range(rng.randrange(1, 6)):
        data[rng.randrange(len(data))] = rng.randrange(256)
    if rng.random() < 0.5:
        del data[rng.randrange(1, len(data)) :]
    return Rubbish(bytes(data), rng.choice(ENCODINGS), rng.choice([None, b'{"stamp_ns": 5}']))


def _bomb(rng: random.Random) -> Rubbish:
    """A file whose header says that it is enormous."""
    data = bytearray(rng.choice(files()))
    width, height = rng.choice([(65500, 65500), (30000, 20000), (33, 24), (32, 25), (1, 1)])
    if data.startswith(b"\x89PNG"):
        data[16:24] = struct.pack(">II", width, height)
        crc = zlib.crc32(bytes(data[12:29]))
        data[29:33] = struct.pack(">I", crc)
    else:
        at = next(i for i in range(2, len(data)) if data[i] == 0xFF and data[i + 1] in (0xC0, 0xC2))
        data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return Rubbish(bytes(data))
