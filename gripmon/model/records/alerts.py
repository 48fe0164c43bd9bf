"""Alerts: their subject, possible causes, and life cycle from raised to cleared."""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.values import OpenEnum


class Severity(enum.StrEnum):
    """How severe an alert is, from the least to the most."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"

    @property
    def rank(self) -> int:
        """0 for the least."""
        return tuple(Severity).index(self)


class Cause(OpenEnum):
    """What has probably happened."""

    CAMERA_MOUNT = "camera_mount_moved"
    FINGER_BENT = "finger_bent"
    JAW_OPENING = "jaw_opening_wrong"
    LENS = "focal_length_or_focus_changed"
    VIEW_BLOCKED = "view_blocked"
    IMAGE_BAD = "image_bad"
    CAMERA_REPLACED = "camera_replaced"
    CAMERA_FROZEN = "camera_frozen"
    CLOCK = "clock_or_frame_rate"
    PLANE_MOVED = "plane_moved"
    LASER_MOVED = "laser_pointer_moved"
    NO_CAMERA = "no_camera"
    TOO_SLOW = "monitor_too_slow"
    UNKNOWN = "unknown"


class AlertKind(OpenEnum):
    """The subject of an alert."""

    STEP = "step"
    CREEP = "creep"
    DRIFT = "drift"
    VIBRATION = "vibration"
    GRIPPER = "gripper"
    LENS = "lens"
    RECALIBRATED = "recalibrated"
    PROPOSED = "recalibration_proposed"
    REFUSED = "recalibration_refused"
    RESTORED = "reference_restored"
    RESTARTED = "restarted"
    LOST = "lost"
    OCCLUDED = "occluded"
    IMAGE = "image"
    STREAM = "stream"
    SOURCE = "source"
    RECORDING = "recording"
    OUTPUT = "output"
    SEVERAL = "several_monitors"


class AlertEvent(enum.StrEnum):
    """The step in an alert's life cycle; ``noted`` is a single event that neither lasts nor is cleared."""

    RAISED = "raised"
    UPDATED = "updated"
    CLEARED = "cleared"
    NOTED = "noted"


class CauseWeight(msgspec.Struct, frozen=True):
    """The probability of a cause."""

    cause: Cause
    probability: Annotated[float, Meta(description="0 to 1; those of one alert add up to 1")]
    part: Annotated[str | None, Meta(description="the finger's name in the gripper file; null for other causes")] = None


class Alert(msgspec.Struct, frozen=True):
    """One event in the life of an alert."""

    kind: AlertKind
    cause: Annotated[Cause, Meta(description="the most probable cause; unknown while none is probable enough")]
    severity: Severity
    text: Annotated[str, Meta(description="one line for a person")]
    event: AlertEvent = AlertEvent.NOTED
    alert_id: Annotated[str, Meta(description="the same from raised to cleared; empty for what is only noted")] = ""
    part: Annotated[str | None, Meta(description="the finger that cause is about; null for other causes")] = None
    causes: Annotated[tuple[CauseWeight, ...], Meta(description="all that were weighed, the most probable first")] = ()
    tcp_shift_m: Annotated[
        tuple[float, float, float] | None,
        Meta(
            description="of the TCP against the reference, less the reference's error as the first frames showed it, "
            "along the camera's x, y, z, m; of a laser calibration: by how much a spot is elsewhere; null: not about a "
            "motion"
        ),
    ] = None
    rotation_rad: Annotated[float | None, Meta(description="turn against the reference, rad; null likewise")] = None
    rate_m_per_min: Annotated[
        float | None, Meta(description="speed of the TCP in a creep, m/min; null for all else")
    ] = None
    time_left_s: Annotated[
        float | None, Meta(description="until a creep reaches the limit, s; null for all else, or away from it")
    ] = None
    since_ns: Annotated[
        int | None,
        Meta(description="when it was raised, Unix ns; null for what is only noted"),
    ] = None
    acknowledged: Annotated[bool, Meta(description="an operator has taken note of it")] = False


class OpenAlert(msgspec.Struct, frozen=True):
    """An alert that was raised and not cleared yet."""

    topic: Annotated[str, Meta(description="what it is about; of one topic there is one at a time")]
    alert: Annotated[Alert, Meta(description="what was said of it last")]
