"""The records that travel between rooms, and what of them goes over the wire.

Everything here is a value: frozen, without behaviour beyond packing.  The structs are encoded by ``msgspec``; the field
names of :class:`FrameRecord` are the contract of one JSON line a frame (``gripmon replay``) and of the ``transform``
key.

Conventions: ``a_T_b`` maps coordinates in frame b to frame a; quaternions are ``x, y, z, w``; SI units; ``*_ns`` are
Unix nanoseconds for capture time.  A covariance is 6x6, row by row: first the error of the TCP's position in camera
axes (m²), then the rotation error vector in camera axes (rad²), that is ``t_true = t + rho`` and ``R_true =
exp(omega) R``.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Image = NDArray[np.integer[Any] | np.floating[Any]]


class Verdict(enum.StrEnum):
    """May a controller use the transform?"""

    VALID = "valid"
    SUSPECT = "suspect"
    UNKNOWN = "unknown"


class State(enum.StrEnum):
    """What the monitor is doing."""

    ACQUIRING = "acquiring"
    TRACKING = "tracking"
    DRIFTING = "drifting"
    RECALIBRATING = "recalibrating"
    OCCLUDED = "occluded"
    LOST = "lost"
    STALE = "stale"


class Origin(enum.StrEnum):
    """How the transform of a frame came about (``source`` on the wire)."""

    UPDATE = "update"
    RECALIBRATION = "recalibration"
    HELD = "held"


class Refusal(enum.StrEnum):
    """Why a frame can't be measured at all."""

    NOT_AN_IMAGE = "not_an_image"
    WRONG_SIZE = "wrong_size"
    WRONG_TYPE = "wrong_type"
    NOT_FINITE = "not_finite"
    BLACK = "black"
    WHITE = "white"
    FLAT = "flat"
    JAW_OPENING = "jaw_opening"


class CornerFault(enum.StrEnum):
    """Why a corner was not measured, or not used."""

    OUTSIDE = "outside"
    SELF_HIDDEN = "self_hidden"
    FEW_POINTS = "few_points"
    HIDDEN = "hidden"
    PARALLEL = "parallel"
    UNCERTAIN = "uncertain"
    LEFT_OUT = "left_out"
    FRAME_REFUSED = "frame_refused"
    NO_FIT = "no_fit"


class Cause(enum.StrEnum):
    """What an alert believes to have happened."""

    CAMERA_MOUNT = "camera_mount_moved"
    FINGER_BENT = "finger_bent"
    JAW_OPENING = "jaw_opening_wrong"
    VIEW_BLOCKED = "view_blocked"
    IMAGE_BAD = "image_bad"
    NO_CAMERA = "no_camera"
    UNKNOWN = "unknown"


class AlertKind(enum.StrEnum):
    """What an alert is about."""

    DRIFT = "drift"
    JUMP = "jump"
    RECALIBRATED = "recalibrated"
    LOST = "lost"
    OCCLUDED = "occluded"
    IMAGE = "image"
    SOURCE = "source"
    RECOVERED = "recovered"


class Severity(enum.StrEnum):
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera frame as a source hands it over.

    ``image`` is H x W or H x W x 3 (BGR), uint8, uint16 or float32 in 0..1, or None where the source could not make one
    (truncated file, failed read); ``fault`` then says why in a few words.  ``jaw_opening_m`` is what the robot
    reported for this frame, None if nobody did.  ``name`` is the file or stream that the frame came from.
    """

    seq: int
    stamp_ns: int
    image: Image | None
    jaw_opening_m: float | None = None
    name: str = ""
    fault: str | None = None


class Transform(msgspec.Struct, frozen=True):
    translation_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]


class Smoothed(msgspec.Struct, frozen=True):
    translation_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    covariance: tuple[float, ...]


class Drift(msgspec.Struct, frozen=True):
    """Motion against the reference: ``d`` and ``delta`` of equation (14) and the TCP's displacement in the camera
    frame.
    """

    translation_m: float
    rotation_rad: float
    tcp_shift_m: tuple[float, float, float]


class CornerRecord(msgspec.Struct, frozen=True):
    """A corner in one frame: where it was measured (None if it was not), its standard deviation in px (the larger
    axis).
    """

    id: str
    uv_px: tuple[float, float] | None
    sigma_px: float | None
    used: bool
    reason: CornerFault | None = None


class Alert(msgspec.Struct, frozen=True):
    kind: AlertKind
    cause: Cause
    severity: Severity
    text: str


class FrameRecord(msgspec.Struct, frozen=True):
    """What the monitor decided about one frame; the ``transform`` message and one line of ``replay``."""

    seq: int
    stamp_ns: int
    verdict: Verdict
    state: State
    source: Origin
    cam_T_grip: Transform | None
    covariance: tuple[float, ...] | None
    smoothed: Smoothed | None
    drift: Drift | None
    reference_id: str
    revision: int
    rms_px: float | None
    jaw_opening_m: float | None
    corners: tuple[CornerRecord, ...]
    alerts: tuple[Alert, ...]
    latency_ns: int = 0
    reason: str | None = None
    name: str = ""


class ReferenceRecord(msgspec.Struct, frozen=True):
    """The calibration that drift is measured against; the ``reference`` message."""

    reference_id: str
    revision: int
    stamp_ns: int
    origin: str
    cam_T_grip: Transform
    covariance: tuple[float, ...]


def unmeasured_record(
    frame: Frame,
    reference: ReferenceRecord,
    reason: str | None,
    *,
    verdict: Verdict = Verdict.UNKNOWN,
    state: State = State.LOST,
    corners: tuple[CornerRecord, ...] = (),
    alerts: tuple[Alert, ...] = (),
) -> FrameRecord:
    """The record of a frame that gave no measurement, without a transform: by default there is nothing to stand by."""
    return FrameRecord(
        seq=frame.seq,
        stamp_ns=frame.stamp_ns,
        verdict=verdict,
        state=state,
        source=Origin.HELD,
        cam_T_grip=None,
        covariance=None,
        smoothed=None,
        drift=None,
        reference_id=reference.reference_id,
        revision=reference.revision,
        rms_px=None,
        jaw_opening_m=None,
        corners=corners,
        alerts=alerts,
        reason=reason,
        name=frame.name,
    )


class StateRecord(msgspec.Struct, frozen=True):
    """The ``state`` message: 1 Hz and on every change."""

    robot: str
    camera: str
    state: State
    verdict: Verdict
    stamp_ns: int
    seq: int
    reference_id: str
    revision: int
    frames: int
    frames_refused: int
    frames_dropped: int
    frames_per_s: float
    uptime_s: float
    camera_connected: bool
    recording_dropped: int
    message: str
    version: str


class AlertRecord(msgspec.Struct, frozen=True):
    """The ``alert`` message: one alert with the frame and the state that it belongs to."""

    robot: str
    camera: str
    seq: int
    stamp_ns: int
    state: State
    reference_id: str
    revision: int
    kind: AlertKind
    cause: Cause
    severity: Severity
    text: str


@dataclass(frozen=True, slots=True)
class MeasurementTrace:
    """Pixels behind the newest record, for people who look: all positions in the distorted image, px.

    ``edge_uv_px`` (n, 2) are the measured edge points, ``edge_used`` (n,) whether the fit believed them,
    ``edge_index`` (n,) the gripper edge each belongs to; ``predicted_edges_uv_px`` one polyline (k, 2) a visible
    edge; ``predicted_corners_uv_px`` (c, 2) in the order of the gripper model, NaN where a corner is not visible.
    """

    edge_uv_px: Array
    edge_used: NDArray[np.bool_]
    edge_index: NDArray[np.intp]
    predicted_edges_uv_px: tuple[Array, ...]
    predicted_corners_uv_px: Array


_encoder = msgspec.json.Encoder()


def to_json(record: msgspec.Struct) -> bytes:
    """One line of UTF-8 JSON without a line feed; NaN can't occur in records and would become null."""
    return _encoder.encode(record)
