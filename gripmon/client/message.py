"""A ``transform`` message, checked before anybody moves by it."""

from __future__ import annotations

import math

from gripmon.model.records import FrameRecord, MessageRefused, Protection, Smoothed, Transform, Verdict, from_json

_UNIT_TOLERANCE = 1e-3
_LARGEST_NUMBER = 2**63 - 1


def transform_message(payload: bytes) -> FrameRecord:
    """Raises :class:`~gripmon.model.records.MessageRefused` for what is not a message or a pose, whoever sent it."""
    record = from_json(payload, FrameRecord)
    for pose in (record.cam_T_grip, record.smoothed):
        if pose is not None and not _is_pose(pose):
            raise MessageRefused("a transform that is no pose")
    for covariance in (record.covariance, record.smoothed.covariance if record.smoothed else None):
        if covariance is not None and not _is_covariance(covariance):
            raise MessageRefused("a covariance with numbers that are not finite, or a variance below 0")
    if record.protection is not None and not _is_protection(record.protection):
        raise MessageRefused("a protection level that is not finite or below 0, or a risk that is not within 0 and 1")
    if record.verdict is not Verdict.UNKNOWN and (record.cam_T_grip is None or record.covariance is None):
        raise MessageRefused(f"verdict {record.verdict} without a transform and its covariance")
    for name in ("seq", "stamp_ns", "revision", "latency_ns"):
        if not 0 <= getattr(record, name) <= _LARGEST_NUMBER:
            raise MessageRefused(f"{name} is not within 0 and 2⁶³ - 1")
    return record


def _is_pose(pose: Transform | Smoothed) -> bool:
    return all(map(math.isfinite, pose.translation_m)) and (
        abs(math.hypot(*pose.rotation_xyzw) - 1.0) < _UNIT_TOLERANCE  # false for NaN, too
    )


def _is_covariance(covariance: tuple[float, ...]) -> bool:
    return all(map(math.isfinite, covariance)) and min(covariance[::7]) >= 0.0


def _is_protection(protection: Protection) -> bool:
    bounds = (protection.position_m, protection.rotation_rad)
    return all(math.isfinite(bound) and bound >= 0.0 for bound in bounds) and 0.0 < protection.risk <= 1.0
