"""The values of a forecast, as frozen structures for JSON."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records import Array, Protection
from gripmon.teach.visibility import Border, Freedom, Gap

Vector = tuple[float, float, float]


class PoseValues(msgspec.Struct, frozen=True):
    """Six numbers about a pose: the TCP's position in camera axes (m) and the rotation about them (rad)."""

    tcp_m: Vector
    rotation_rad: Vector

    @classmethod
    def of(cls, values: Array) -> PoseValues:
        """From an array (6,)."""
        return msgspec.convert({"tcp_m": values[:3].tolist(), "rotation_rad": values[3:].tolist()}, cls)


class CameraValues(msgspec.Struct, frozen=True):
    """The lens and its field of view (rad)."""

    model: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    field_of_view_rad: tuple[float, float]


class GripperValues(msgspec.Struct, frozen=True):
    """The gripper file and its counts; ``jaw_m``: the jaw's travel, None without a jaw; ``apart_rate``: by how much two
    fingers move apart for each metre of opening, None for other numbers of fingers.
    """

    file: str
    name: str
    corners: int
    edges: int
    faces: int
    notes: tuple[str, ...]
    jaw_m: tuple[float, float] | None
    apart_rate: float | None = None


class ReferenceValues(msgspec.Struct, frozen=True):
    """The reference calibration, and values that reveal a mistake in it."""

    id: str
    translation_m: Vector
    rotation_xyzw: tuple[float, float, float, float]
    distance_m: float
    turn_rad: float
    metres_per_px: float
    tilt_rad: Annotated[float, Meta(description="of the optical axis against the fingers")]
    camera_ahead_m: Annotated[float, Meta(description="of the TCP, along the gripper's z axis")]
    sound_as_wxyz: Annotated[bool, Meta(description="read as w, x, y, z it would be behind the fingertips, in view")]


class FarthestEdge(msgspec.Struct, frozen=True):
    """The taught edge with the largest offset from the sharp model."""

    edge: str
    offset_m: float
    offset_px: float


class TaughtValues(msgspec.Struct, frozen=True):
    """The taught model."""

    file: str
    time: str
    images: int
    edges: tuple[str, ...]
    largest: FarthestEdge


class JawValues(msgspec.Struct, frozen=True):
    """The source of the jaw opening, and the opening of all predictions (m)."""

    source: str
    opening_m: float | None
    nominal: bool


class CornerView(msgspec.Struct, frozen=True):
    """A corner predicted by the calibration."""

    id: str
    uv_px: tuple[float, float] | None
    distance_m: float
    visible: bool
    reason: str | None


class EdgeView(msgspec.Struct, frozen=True):
    """Whether an edge is visible."""

    id: str
    visible: bool


class UnknownJaw(msgspec.Struct, frozen=True):
    """Standard deviations if the jaw opening were unknown (m, rad)."""

    tcp_m: Vector
    rotation_rad: Vector
    jaw_m: float


class JawAccuracy(msgspec.Struct, frozen=True):
    """The uncertainty of the reported opening, and how well the image alone determines it."""

    reported_sigma_m: float
    unknown: UnknownJaw
    pose_per_jaw_m: PoseValues
    like: str
    correlation: float
    growth: Annotated[float, Meta(description="how many times less certain the pose is without the opening")]


class DriftForecast(msgspec.Struct, frozen=True):
    """The smallest step that the drift test detects, and its delay in frames for other steps."""

    false_alarms_per_day: float
    frames_per_s: float
    correlation_frames: float
    smallest: PoseValues
    delay_frames: Annotated[
        dict[str, tuple[int | None, int | None, int | None]],
        Meta(description="by the size of the TCP's step (m): along x, y, z; null: never"),
    ]


class RecalibrationForecast(msgspec.Struct, frozen=True):
    """Whether the visible corners determine a pose by themselves, and the uncertainty of one frame (m)."""

    corners: int
    coplanar: bool
    possible: bool
    reason: str | None
    sigma_m: float | None
    sure_sigma_m: float
    mode: str


class Accuracy(msgspec.Struct, frozen=True):
    """The expected accuracy of one frame; None if too few edges are visible."""

    measurement: str
    edges: int
    edges_needed: int
    corners: Annotated[int, Meta(description="those in view with two edges that are long enough and not parallel")]
    edge_point_sigma_px: float
    recalibration: RecalibrationForecast
    expected: Annotated[PoseValues | None, Meta(description="standard deviations")]
    weakest: Annotated[PoseValues | None, Meta(description="the least certain direction, one standard deviation long")]
    jaw: JawAccuracy | None
    drift: DriftForecast | None


class OpeningCertainty(msgspec.Struct, frozen=True):
    """The TCP's uncertainty over the openings, and the bounds that are compared with the alert limits."""

    opening_m: tuple[float, ...]
    worst_sigma_m: tuple[float | None, ...]
    protection_m: tuple[float | None, ...]
    protection_rad: tuple[float | None, ...]
    alert_limit_m: float
    alert_limit_rad: float


class JawTravelForecast(msgspec.Struct, frozen=True):
    """The part of the jaw's travel in which enough is visible; corners and edges: least and most."""

    share: float
    gaps: tuple[Gap, ...]
    corners: tuple[int, int]
    edges: tuple[int, int]
    from_m: float
    to_m: float
    certainty: OpeningCertainty


class InView(msgspec.Struct, frozen=True):
    """What is visible, its distance from the image border, and how far camera and jaws may move."""

    corners: int
    edges: int
    corners_needed: int
    edges_needed: int
    enough: bool
    reason: str | None
    behind_another_finger: tuple[str, ...]
    border: Border | None
    camera_may_move: Freedom | None
    limit_m: float
    jaw_travel: JawTravelForecast | None


class Forecast(msgspec.Struct, frozen=True):
    """The forecast of a configuration's view: metres, radians, px; positions in the camera frame.

    ``protection``: the protection level of one frame, which ``valid_by`` names: that of the motion ``since_reference``,
    before the reference's frames are averaged, or the ``absolute`` one; ``protection_if_bevelled``: the same if the
    gripper has bevels that are neither stated nor taught, null if that is excluded; ``needed``: the alert limits that
    this view could meet, or teaching, if no transform of it can be valid; ``doubt``: why what is valid by its absolute
    error may be farther off, null if nothing says so.
    """

    config: str
    robot: str
    camera_name: str
    camera: CameraValues
    gripper: GripperValues
    reference: ReferenceValues
    taught: TaughtValues | None
    jaw: JawValues
    corners: tuple[CornerView, ...]
    edges: tuple[EdgeView, ...]
    accuracy: Accuracy
    valid_by: str
    protection: Protection | None
    since_reference: Protection | None
    absolute: Protection | None
    protection_if_bevelled: Protection | None
    alert_limit_m: float
    alert_limit_rad: float
    reachable: bool
    needed: str | None
    promise: str
    in_view: InView
    doubt: str | None
