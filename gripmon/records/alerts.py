"""Alerts: what they are about, what may have caused it, and their life from raised to cleared."""

from __future__ import annotations

import enum

import msgspec


class Severity(enum.StrEnum):
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Cause(enum.StrEnum):
    """What an alert believes to have happened."""

    CAMERA_MOUNT = "camera_mount_moved"
    FINGER_BENT = "finger_bent"
    JAW_OPENING = "jaw_opening_wrong"
    LENS = "focal_length_or_focus_changed"
    VIEW_BLOCKED = "view_blocked"
    IMAGE_BAD = "image_bad"
    CAMERA_REPLACED = "camera_replaced"
    CAMERA_FROZEN = "camera_frozen"
    CLOCK = "clock_or_frame_rate"
    NO_CAMERA = "no_camera"
    UNKNOWN = "unknown"


class AlertKind(enum.StrEnum):
    """What an alert is about."""

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


class AlertEvent(enum.StrEnum):
    """Where an alert is in its life; ``noted`` is an event that neither lasts nor is cleared."""

    RAISED = "raised"
    UPDATED = "updated"
    CLEARED = "cleared"
    NOTED = "noted"


class CauseWeight(msgspec.Struct, frozen=True):
    """How probable a cause is; ``part`` is the finger's name in the gripper file where the cause is a finger's."""

    cause: Cause
    probability: float
    part: str | None = None


class Alert(msgspec.Struct, frozen=True):
    """One event in the life of an alert.

    ``alert_id`` is the same from ``raised`` to ``cleared``; empty for what is only noted.  ``causes`` are all that were
    weighed, the most probable first: the first is ``cause`` unless none of them is probable enough.  A creep has a
    ``rate_m_per_min`` of the TCP and, towards a limit, ``time_left_s`` until it is reached.
    """

    kind: AlertKind
    cause: Cause
    severity: Severity
    text: str
    event: AlertEvent = AlertEvent.NOTED
    alert_id: str = ""
    part: str | None = None
    causes: tuple[CauseWeight, ...] = ()
    tcp_shift_m: tuple[float, float, float] | None = None
    rotation_rad: float | None = None
    rate_m_per_min: float | None = None
    time_left_s: float | None = None
    since_ns: int | None = None
    acknowledged: bool = False


class OpenAlert(msgspec.Struct, frozen=True):
    """An alert that was raised and not cleared yet, as it is kept over a restart: ``topic`` is what it is about, of
    which there is one at a time, ``alert`` what was said of it last.
    """

    topic: str
    alert: Alert
