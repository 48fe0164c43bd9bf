"""Limits of verdicts and alerts: what a person may set, and when a creep will reach them."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records import Array, ValidBy


class PolicySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How bad what was noticed is, and what is done then."""

    warn_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=1.0,
            description="shift of the TCP at which a drift becomes a warning; below it is information (m)",
        ),
    ] = 1e-4
    warn_rad: Annotated[
        float,
        Meta(gt=0.0, le=3.0, description="turn at which a drift becomes a warning; below it is information (rad)"),
    ] = 3e-3
    limit_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=1.0,
            description="shift of the TCP at which a drift becomes an error, and motion d of equation (14) "
            "beyond which the reference is measured again (m)",
        ),
    ] = 2.5e-3
    limit_rad: Annotated[
        float,
        Meta(
            gt=0.0,
            le=3.0,
            description="turn at which a drift becomes an error, and rotation delta of equation (14) beyond "
            "which the reference is measured again (rad)",
        ),
    ] = 0.02
    update_alert_s: Annotated[
        float, Meta(ge=0.0, le=3600.0, description="shortest time between two updates of an open alert (s)")
    ] = 2.0
    clear_alert_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=3600.0,
            description="time for which the cause of an alert must be absent before the alert is cleared (s)",
        ),
    ] = 1.0
    settle_frames: Annotated[
        int,
        Meta(
            ge=1, le=10000, description="frames that the gripper must stand still in the image before a recalibration"
        ),
    ] = 20
    confirm_frames: Annotated[
        int, Meta(ge=1, le=1000, description="frames that must agree after a jump before the transform counts as valid")
    ] = 2
    hold_s: Annotated[
        float,
        Meta(ge=0.0, le=3600.0, description="how long the last transform is held when nothing can be measured (s)"),
    ] = 1.0
    hold_m_per_sqrt_s: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="growth of a held transform's position sigma (m per square root of a second)"),
    ] = 2e-4
    hold_rad_per_sqrt_s: Annotated[
        float,
        Meta(
            gt=0.0, le=3.0, description="growth of a held transform's rotation sigma (rad per square root of a second)"
        ),
    ] = 2e-3
    image_alert_after_s: Annotated[
        float, Meta(ge=0.0, le=3600.0, description="time of refused frames after which there is an alert (s)")
    ] = 1.0
    valid_by: Annotated[
        ValidBy,
        Meta(
            description="which error has to be within the alert limits: absolute, of the transform as measured, in "
            "which the gripper file's errors are; reference, of the motion since the reference, which cam_T_grip is "
            "the reference after then"
        ),
    ] = ValidBy.ABSOLUTE
    alert_limit_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.1,
            description="position error of the TCP that the task tolerates: a transform is valid while its "
            "protection level is at most this (m)",
        ),
    ] = 1e-3
    alert_limit_rad: Annotated[
        float, Meta(gt=0.0, le=3.0, description="rotation error that the task tolerates, likewise (rad)")
    ] = 0.035
    integrity_risk: Annotated[
        float,
        Meta(
            ge=1e-9,
            le=0.1,
            description="probability a frame that the error exceeds the protection level (no unit)",
        ),
    ] = 1e-5
    mount_jumps_per_month: Annotated[
        float,
        Meta(
            ge=1e-3,
            le=1e5,
            description="how often the camera's mount is knocked or slips (1/month)",
        ),
    ] = 1.0


def time_left_s(shift: Array, velocity: Array, limit_m: float, limit_rad: float) -> float | None:
    """Until the TCP's shift or the turn reaches its limit at this velocity (6,), both (6,); None if neither ever does.

    Zero if it is past a limit already.
    """
    left = [
        _time_to_radius(shift[part], velocity[part], limit)
        for part, limit in ((slice(0, 3), limit_m), (slice(3, 6), limit_rad))
    ]
    finite = [t for t in left if t is not None]
    return min(finite) if finite else None


def _time_to_radius(position: Array, velocity: Array, radius: float) -> float | None:
    """Smallest t >= 0 with ``|position + velocity t| = radius``, from inside; 0 from outside."""
    a, b, c = float(velocity @ velocity), float(position @ velocity), float(position @ position) - radius**2
    if c >= 0.0:
        return 0.0
    return None if a == 0.0 else (-b + math.sqrt(b * b - a * c)) / a
