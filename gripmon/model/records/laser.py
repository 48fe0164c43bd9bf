"""A second camera that a pulsed laser checks: the pulses that the robot reports, and the result of each."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.alerts import Alert
from gripmon.model.records.frames import State, Verdict
from gripmon.model.records.values import OpenEnum

Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Pair = tuple[float, float]
Vector = tuple[float, float, float]


class ArmPose(msgspec.Struct, frozen=True):
    """``base_T_ee``: from end-effector to base coordinates."""

    translation_m: Annotated[Vector, Meta(description="the end-effector's origin in the base frame: x, y, z, m")]
    rotation_xyzw: Annotated[
        tuple[float, float, float, float], Meta(description="unit quaternion x, y, z, w, end-effector to base")
    ]


class LaserPulse(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema", tag="gripmon.pulse/1"):
    """A pulse of the laser on the end-effector, reported by the robot's program."""

    stamp_ns: Annotated[
        Stamp, Meta(description="from then on the laser was on and the hand stood still, Unix ns, by the images' clock")
    ]
    until_ns: Annotated[Stamp, Meta(description="end of that time; it may be in the future")]
    base_T_ee: ArmPose


class PulseFault(OpenEnum):
    """Why a pulse was not judged, or its spot was rejected."""

    NO_FRAME = "no_frame"
    TOO_LATE = "too_late"
    OVERLAP = "overlap"
    OUT_OF_ORDER = "out_of_order"
    IMAGE = "image"
    MOVING = "moving"
    NO_SPOT = "no_spot"
    OUTLIER = "outlier"
    NOT_FORESEEN = "not_foreseen"
    NOT_FINITE = "not_finite"
    INTERNAL = "internal_error"


class SpotGap(msgspec.Struct, frozen=True):
    """Two of the three ways to compute a spot, and how far apart they put it."""

    ways: Annotated[tuple[str, str], Meta(description="which two: beam and plane, ray and plane, beam and ray")]
    gap_m: Annotated[Vector, Meta(description="from the first result to the second, base frame, m")]
    sigma_m: Annotated[float, Meta(description="standard deviation of the distance, along the gap, m")]
    square: Annotated[
        float, Meta(description="normalised square of the gap (chi-square): about freedom while nothing has moved")
    ]
    freedom: Annotated[int, Meta(description="degrees of freedom of square")]


class CameraShift(msgspec.Struct, frozen=True):
    """How ``base_T_cam`` has moved since the calibration, base axes."""

    translation_m: Annotated[Vector, Meta(description="of the camera's centre, m")]
    rotation_rad: Annotated[Vector, Meta(description="rotation vector, rad")]
    covariance: Annotated[
        tuple[float, ...],
        Meta(
            min_length=36,
            max_length=36,
            description="6 x 6, row by row: translation (m), then rotation (rad); wide along unobserved directions",
        ),
    ]
    complete: Annotated[
        bool, Meta(description="the pulses determine all six numbers; else the rest follow by correlation")
    ]
    text: Annotated[str, Meta(description="the same in words")]


class SpotRecord(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema", tag="gripmon.spot/1"):
    """The result of one laser pulse."""

    pulse: Annotated[int, Meta(description="number of the reported pulse")]
    seq: Annotated[int, Meta(description="of its last frame used, else of the newest frame; -1: none yet")]
    stamp_ns: Annotated[int, Meta(description="the pulse's, Unix ns")]
    until_ns: Annotated[int, Meta(description="the pulse's, Unix ns")]
    verdict: Annotated[Verdict, Meta(description="may the calibration of the camera be used?")]
    state: State
    used: Annotated[bool, Meta(description="the spot was accepted")]
    fault: Annotated[PulseFault | None, Meta(description="why it was not accepted; null if it was")]
    reason: Annotated[str | None, Meta(description="the same in one line for a person")]
    base_T_ee: ArmPose
    frames: Annotated[int, Meta(description="number of frames with the laser on that were averaged")]
    background: Annotated[bool, Meta(description="a frame from before the pulse was subtracted")]
    candidates: Annotated[int, Meta(description="number of bright spots found")]
    uv_px: Annotated[
        Pair | None, Meta(description="the spot: column and row, px; the first pixel's centre is 0; null if none")
    ]
    foreseen_px: Annotated[
        Pair | None, Meta(description="predicted by the calibration, px; null if that is not in view")
    ]
    off_px: Annotated[Pair | None, Meta(description="innovation: measured less predicted, px; null if either is")]
    off_covariance_px2: Annotated[
        tuple[float, float, float, float] | None,
        Meta(description="of off_px, 2 x 2, row by row, by calibration, spot and arm, px²; null with off_px"),
    ]
    square: Annotated[
        float | None,
        Meta(description="normalised innovation squared (chi-square): about 2 while nothing has moved; null with it"),
    ]
    gaps: Annotated[tuple[SpotGap, ...], Meta(description="how far the three ways to the spot disagree")]
    probability_moved: Annotated[float, Meta(description="that camera, plane or laser pointer has moved, 0 to 1")]
    shift: Annotated[CameraShift | None, Meta(description="motion of the camera; null if none is likely")]
    reference_id: Annotated[str, Meta(description="the laser calibration that is monitored")]
    revision: Annotated[int, Meta(description="of that; 0")]
    alerts: Annotated[tuple[Alert, ...], Meta(description="raised, updated or cleared by this pulse")]
    latency_ns: Annotated[int, Meta(description="processing time once its frames are complete, ns")] = 0
    monitor_id: Annotated[
        str, Meta(description="of this start of the monitor; empty in a replay, and from a monitor before ids")
    ] = ""
