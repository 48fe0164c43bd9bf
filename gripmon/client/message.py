"""The ``transform`` message as a controller needs it, checked before anybody moves by it."""

from __future__ import annotations

import math

import msgspec

from gripmon.records import Smoothed, Transform, Verdict

SCHEMA, MAJOR = "gripmon.transform", 1
LARGEST_BYTES = 1 << 18
"""Longer payloads are not decoded; a message with a hundred corners is a tenth of it."""

_UNIT_TOLERANCE = 1e-3


class Unreadable(Exception):
    """The payload is no transform message that this client knows; the text says what is wrong."""


class TransformMessage(msgspec.Struct, frozen=True):
    """The fields of :class:`gripmon.records.FrameRecord` that a controller needs.

    The others are skipped, and words that may be added to later stay strings, so that a newer monitor can be read.
    """

    seq: int
    stamp_ns: int
    verdict: Verdict
    state: str
    source: str
    cam_T_grip: Transform | None
    covariance: tuple[float, ...] | None
    smoothed: Smoothed | None
    reference_id: str
    revision: int
    latency_ns: int = 0
    reason: str | None = None


class _Tag(msgspec.Struct, frozen=True):
    schema: str = ""


_decode = msgspec.json.Decoder(TransformMessage).decode
_decode_tag = msgspec.json.Decoder(_Tag).decode


def transform_message(payload: bytes) -> TransformMessage:
    """Raises :class:`Unreadable`."""
    if len(payload) > LARGEST_BYTES:
        raise Unreadable(f"{len(payload)} bytes, at most {LARGEST_BYTES} are read")
    try:
        tag = _decode_tag(payload).schema
        _check_schema(tag)
        message = _decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Unreadable(str(error)) from None
    _check_numbers(message)
    return message


def _check_schema(tag: str) -> None:
    name, _, version = tag.partition("/")
    if not tag:
        return  # a monitor that says none
    major = version.partition(".")[0]
    if name != SCHEMA or not major.isdecimal():
        raise Unreadable(f"schema {tag!r}, not {SCHEMA}/{MAJOR}")
    if int(major) != MAJOR:
        older = "client" if int(major) > MAJOR else "monitor"
        raise Unreadable(f"the monitor speaks {SCHEMA}/{major}, this client {SCHEMA}/{MAJOR}; update the {older}")


def _check_numbers(message: TransformMessage) -> None:
    """Whatever the sender is: no controller moves by numbers that are no pose."""
    for pose in (message.cam_T_grip, message.smoothed):
        if pose is not None and not _is_pose(pose):
            raise Unreadable("a transform that is no pose")
    for covariance in (message.covariance, message.smoothed.covariance if message.smoothed else None):
        if covariance is not None and not _is_covariance(covariance):
            raise Unreadable("a covariance that is not 36 finite numbers with variances on its diagonal")
    if message.verdict is not Verdict.UNKNOWN and (message.cam_T_grip is None or message.covariance is None):
        raise Unreadable(f"verdict {message.verdict} without a transform and its covariance")
    for name in ("seq", "stamp_ns", "revision", "latency_ns"):
        if not 0 <= getattr(message, name) < 1 << 63:
            raise Unreadable(f"{name} is not within 0 and 2⁶³ - 1")


def _is_pose(pose: Transform | Smoothed) -> bool:
    return all(map(math.isfinite, pose.translation_m)) and (
        abs(math.hypot(*pose.rotation_xyzw) - 1.0) < _UNIT_TOLERANCE  # false for NaN, too
    )


def _is_covariance(covariance: tuple[float, ...]) -> bool:
    return len(covariance) == 36 and all(map(math.isfinite, covariance)) and min(covariance[::7]) >= 0.0
