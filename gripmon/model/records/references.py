"""The calibration that drift is measured against, where it came from, and the state that survives a restart."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.alerts import Cause, OpenAlert
from gripmon.model.records.values import Covariance, Since, Transform


class ReferenceInputs(msgspec.Struct, frozen=True):
    """What a reference was made from."""

    first_seq: Annotated[int, Meta(description="the first frame that was averaged")]
    last_seq: Annotated[int, Meta(description="the last one")]
    frames: Annotated[int, Meta(description="how many of them were used")]
    corners: Annotated[tuple[str, ...], Meta(description="names of the corners that it rests on")]
    weighted_rms: Annotated[float, Meta(description="of the residuals over their deviations: 1 if covariances hold")]
    step_m: Annotated[float, Meta(description="by how much it moved the reference before it, m")]
    step_rad: Annotated[float, Meta(description="by how much it turned it, rad")]


class ReferenceRecord(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.reference/1"):
    """The calibration that drift is measured against."""

    reference_id: Annotated[str, Meta(description="its name, which no other reference has")]
    revision: Annotated[int, Meta(description="grows by one with every change and is never used twice")]
    stamp_ns: Annotated[
        int,
        Meta(description="of the newest frame behind it or of the command, Unix ns; 0: configured"),
    ]
    origin: Annotated[str, Meta(description="configuration, recalibration, undo or reset")]
    cam_T_grip: Transform
    covariance: Covariance
    parent: Annotated[str | None, Meta(description="the reference in force before; null for the first")] = None
    restores: Annotated[
        str | None, Meta(description="the earlier one whose transform an undo or reset brought back; else null")
    ] = None
    cause: Annotated[Cause, Meta(description="what made it necessary")] = Cause.UNKNOWN
    accepted_by: Annotated[str, Meta(description="who let it in: configuration, monitor or operator")] = "configuration"
    inputs: Annotated[
        ReferenceInputs | None, Meta(description="what it was measured from; null if it was not measured here")
    ] = None
    with_gripper: Annotated[
        bool,
        Meta(
            description="whether the gripper file was made of the same images, so that its wrong size or tilt is this "
            "pose's, too: one error, not two"
        ),
    ] = False


class StripsRecord(msgspec.Struct, frozen=True):
    """What the fingers show along themselves; bytes are little-endian and base64 in JSON."""

    cam_T_grip: Annotated[Transform, Meta(description="where the gripper was when the strips were chosen")]
    jaw_opening_m: Annotated[float | None, Meta(description="and its opening then, m; null without a jaw")]
    frames: Annotated[int, Meta(ge=1, description="that they were learned from")]
    mean: Annotated[
        bytes, Meta(description="float32 (n, 64): grey levels from the finger's end on, slow changes left out")
    ]
    usual: Annotated[bytes, Meta(description="float32 (193,): correlation with them at each px along, from -96 to 96")]


class AtReferenceRecord(msgspec.Struct, frozen=True):
    """What was measured at a reference; bytes are little-endian float64, base64 in JSON."""

    reference_id: Annotated[str, Meta(description="the reference")]
    measured_as: Annotated[str, Meta(description="digest of the taught edges and settings that it was measured with")]
    cam_T_grip: Annotated[Transform, Meta(description="the average over its frames")]
    shift: Annotated[bytes, Meta(description="(g, 6): the same under each lasting hypothesis, from there, m and rad")]
    covariance: Annotated[bytes, Meta(description="(g, 6, 6) of these, m², m rad, rad²")]
    of_model: Annotated[
        bytes, Meta(description="(g, f, 6): how far off where a finger is longer, or an edge lies beside its place")
    ]
    jaw_opening_m: Annotated[float, Meta(description="opening in its frames; 0 without a jaw")]
    frames: Annotated[int, Meta(description="how many of them were averaged")]
    since: Since
    since_ns: Annotated[
        int,
        Meta(
            description="stamp of the newest of its own frames, or of the middle one of the first proved ones, Unix "
            "ns; of images to teach from when they were taught from"
        ),
    ]
    misread: Annotated[
        float, Meta(description="probability that what looked like the fingers' ends in all of them was something else")
    ]
    proven: Annotated[bool, Meta(description="whether one of them proved the pose by the fingers' ends")]
    knocked: Annotated[bool, Meta(description="whether the mount was knocked later on")]
    of_images: Annotated[
        bool, Meta(description="whether these were images to teach from, each at another place of the mount's play")
    ] = False
    away: Annotated[
        tuple[float, ...],
        Meta(description="(6,): from there to where the first frames that proved it had it, m and rad; of images"),
    ] = ()


class MonitorState(msgspec.Struct, frozen=True):
    """The state that survives a restart."""

    references: Annotated[
        tuple[ReferenceRecord, ...], Meta(description="the configured one and the newest 999, the last one in force")
    ]
    proposal: Annotated[
        ReferenceRecord | None, Meta(description="a new reference that waits for an operator; null if there is none")
    ] = None
    alerts: Annotated[tuple[OpenAlert, ...], Meta(description="those that are open")] = ()
    alerts_raised: Annotated[int, Meta(description="how many there were: it numbers the next one")] = 0
    cam_T_grip: Annotated[
        Transform | None, Meta(description="the last transform that was measured; null if none was")
    ] = None
    reference_error: Annotated[
        tuple[float, ...] | None,
        Meta(
            description="6 numbers, m and rad: what of a shift against the configured reference was there from the "
            "start; null if that isn't known"
        ),
    ] = None
    unexplained: Annotated[
        tuple[float, ...] | msgspec.UnsetType,
        Meta(
            description="6 numbers, m and rad: by how much the first proven transform differed from where the gripper "
            "was expected; every bound includes it until an operator accepts a new reference; absent if it didn't"
        ),
    ] = msgspec.UNSET
    explained_from: Annotated[
        int | msgspec.UnsetType,
        Meta(description="revision of the reference that an operator accepted then; absent while there is none"),
    ] = msgspec.UNSET
    strips: Annotated[
        StripsRecord | msgspec.UnsetType,
        Meta(description="what the fingers show along themselves; absent before it was learned, and in replies"),
    ] = msgspec.UNSET
    at_reference: Annotated[
        tuple[AtReferenceRecord, ...] | msgspec.UnsetType,
        Meta(description="what was measured at the references, from which motion counts; absent before that is known"),
    ] = msgspec.UNSET
