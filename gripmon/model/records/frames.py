"""A camera frame, and what the monitor decided about it."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.alerts import Alert
from gripmon.model.records.references import ReferenceRecord
from gripmon.model.records.values import (
    Absolute,
    Array,
    Covariance,
    Drift,
    Image,
    OpenEnum,
    Protection,
    SinceReference,
    Smoothed,
    Transform,
    ValidBy,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Verdict(enum.StrEnum):
    """Whether a controller may use the transform."""

    VALID = "valid"
    SUSPECT = "suspect"
    UNKNOWN = "unknown"


class State(OpenEnum):
    """What the monitor is doing."""

    ACQUIRING = "acquiring"
    TRACKING = "tracking"
    DRIFTING = "drifting"
    RECALIBRATING = "recalibrating"
    OCCLUDED = "occluded"
    LOST = "lost"
    STALE = "stale"


class Origin(OpenEnum):
    """How the transform of a frame was obtained (``source`` on the wire)."""

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
    FROZEN = "frozen"


class CornerFault(OpenEnum):
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


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera frame as a source delivers it.

    ``image`` is H x W or H x W x 3 (BGR), uint8, uint16 or float32 in 0..1, or None if the source could not make one
    (truncated file, failed read); ``fault`` then gives the reason in a few words, ``refusal`` as an enum.
    ``jaw_opening_m`` is what the robot reported for this frame, None if nothing was reported.  ``name`` is the file or
    stream that the frame came from.  ``arrived_ns``: when the capture was over or the frame reached this machine, by
    the monotonic clock (ns); None: now.
    """

    seq: int
    stamp_ns: int
    image: Image | None
    jaw_opening_m: float | None = None
    name: str = ""
    fault: str | None = None
    refusal: Refusal = Refusal.NOT_AN_IMAGE
    arrived_ns: int | None = field(default=None, compare=False)


class CornerRecord(msgspec.Struct, frozen=True):
    """A corner of a fingertip in one frame."""

    id: Annotated[str, Meta(description="its name in the gripper file")]
    uv_px: Annotated[
        tuple[float, float] | None,
        Meta(description="column and row where it was measured, px; the first pixel's centre is 0; null if it was not"),
    ]
    sigma_px: Annotated[float | None, Meta(description="standard deviation along its larger axis, px; null likewise")]
    used: Annotated[bool, Meta(description="the transform rests on it, too")]
    reason: Annotated[CornerFault | None, Meta(description="why it was not measured or used; null if it was")] = None


class Beside(msgspec.Struct, frozen=True, gc=False):
    """What one frame had to do with the work that goes on beside the frames of a live camera."""

    searches: Annotated[bool, Meta(description="a search for the gripper began with this frame's image")] = False
    searched_seq: Annotated[
        int | None,
        Meta(description="number of the frame whose image the search used that counts from this one on; null: none"),
    ] = None
    analysed: Annotated[int, Meta(description="steps of the cause analysis that count from this one on")] = 0


class FrameRecord(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.transform/2"):
    """What the monitor decided about one frame: also one line of ``replay``."""

    seq: Annotated[int, Meta(description="number of the frame; one that is missing was dropped")]
    stamp_ns: Annotated[int, Meta(description="time of the capture, Unix ns")]
    verdict: Verdict
    state: State
    source: Origin
    cam_T_grip: Annotated[
        Transform | None, Meta(description="what valid_by names; null where there is nothing to stand by")
    ]
    covariance: Annotated[Covariance | None, Meta(description="of cam_T_grip, null with it; a held one grows")]
    smoothed: Annotated[Smoothed | None, Meta(description="averaged over time; null where nothing is averaged")]
    drift: Annotated[Drift | None, Meta(description="of cam_T_grip against the reference; null with it")]
    reference_id: Annotated[str, Meta(description="the reference that drift is measured against")]
    revision: Annotated[int, Meta(description="of the reference; it never names two different ones")]
    rms_px: Annotated[
        float | None,
        Meta(
            description="root mean square distance of measured corners from where the transform puts them, px; null: "
            "none was measured"
        ),
    ]
    jaw_opening_m: Annotated[
        float | None, Meta(description="as the image shows it, the reported one considered, m; null if not measured")
    ]
    corners: Annotated[tuple[CornerRecord, ...], Meta(description="all of the gripper file, in its order")]
    alerts: Annotated[tuple[Alert, ...], Meta(description="what this frame raised, updated or cleared")]
    latency_ns: Annotated[int, Meta(description="from when the frame came to the monitor's machine to judged, ns")] = 0
    reason: Annotated[str | None, Meta(description="why the verdict isn't valid; null when it is")] = None
    name: Annotated[str, Meta(description="file or stream that the frame came from")] = ""
    protection: Annotated[
        Protection | None,
        Meta(description="bounds on the error of cam_T_grip, null with it; a held one's grow, or end"),
    ] = None
    monitor_id: Annotated[
        str, Meta(description="of this start of the monitor; empty in a replay, and from a monitor before ids")
    ] = ""
    valid_by: Annotated[
        ValidBy,
        Meta(
            description="which error protection bounds and the verdict is about: reference, of the motion since the "
            "reference, which cam_T_grip is the reference after; absolute, of the transform as measured"
        ),
    ] = ValidBy.ABSOLUTE
    since_reference: Annotated[
        SinceReference | None, Meta(description="null with cam_T_grip, and until a frame proves where the gripper is")
    ] = None
    absolute: Annotated[Absolute | None, Meta(description="null with cam_T_grip")] = None
    beside: Annotated[
        Beside | None, Meta(description="null where frames wait for that work: in a replay of images, for one")
    ] = None

    @property
    def measured(self) -> bool:
        """Whether it has a transform measured in this frame, not a held one."""
        return self.source is not Origin.HELD and self.cam_T_grip is not None

    @property
    def measured_T(self) -> Transform | None:
        """The transform as measured, with which the gripper's model lies on the image; None where there is none."""
        if self.absolute is None:
            return self.cam_T_grip
        return Transform(self.absolute.translation_m, self.absolute.rotation_xyzw)


class FrameRecord1(FrameRecord, frozen=True, tag_field="schema", tag="gripmon.transform/1"):
    """A record of schema 1, whose transform and bounds are absolute."""

    def upgraded(self) -> FrameRecord:
        """As of this version; it has no bound since the reference."""
        at, bound, absolute = self.cam_T_grip, self.protection, None
        if at is not None and bound is not None:
            absolute = Absolute(bound.position_m, bound.rotation_rad, at.translation_m, at.rotation_xyzw)
        fields = {name: getattr(self, name) for name in self.__struct_fields__}
        return FrameRecord(**fields | {"absolute": absolute})


@dataclass(frozen=True, slots=True)
class MeasurementTrace:
    """The pixels behind the newest record, for display: all positions in the distorted image, px.

    ``edge_uv_px`` (n, 2) are the measured edge points, ``edge_used`` (n,) whether they are inliers of the fit,
    ``edge_index`` (n,) the gripper edge of each, ``edge_residual_px`` (n,) their distance across the edge from the
    fitted one; ``predicted_edges_uv_px`` one polyline (k, 2) per visible edge; ``predicted_corners_uv_px`` (c, 2) in
    the order of the gripper model, NaN where a corner is not visible.
    """

    edge_uv_px: Array
    edge_used: NDArray[np.bool_]
    edge_index: NDArray[np.intp]
    edge_residual_px: Array
    predicted_edges_uv_px: tuple[Array, ...]
    predicted_corners_uv_px: Array


def withheld(record: FrameRecord, reason: str) -> FrameRecord:
    """The record without anything that someone could move by."""
    return msgspec.structs.replace(
        record,
        verdict=Verdict.UNKNOWN,
        cam_T_grip=None,
        covariance=None,
        smoothed=None,
        drift=None,
        protection=None,
        since_reference=None,
        absolute=None,
        reason=reason,
    )


def unmeasured_record(
    frame: Frame,
    reference: ReferenceRecord,
    reason: str | None,
    *,
    verdict: Verdict = Verdict.UNKNOWN,
    state: State = State.LOST,
    corners: tuple[CornerRecord, ...] = (),
    alerts: tuple[Alert, ...] = (),
    valid_by: ValidBy = ValidBy.ABSOLUTE,
) -> FrameRecord:
    """The record of a frame that gave no measurement: without a transform and, by default, with verdict ``unknown``."""
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
        valid_by=valid_by,
    )
