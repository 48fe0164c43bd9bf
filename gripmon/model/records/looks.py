"""The part of the gripper's learned look that survives a restart."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.values import Transform


class StripsRecord(msgspec.Struct, frozen=True):
    """What the fingers show along themselves; bytes are little-endian and base64 in JSON."""

    cam_T_grip: Annotated[Transform, Meta(description="where the gripper was when the strips were chosen")]
    jaw_opening_m: Annotated[float | None, Meta(description="and its opening then, m; null without a jaw")]
    frames: Annotated[int, Meta(ge=1, description="that they were learned from")]
    mean: Annotated[
        bytes, Meta(description="float32 (n, 64): grey levels from the finger's end on, slow changes left out")
    ]
    usual: Annotated[bytes, Meta(description="float32 (193,): correlation with them at each px along, from -96 to 96")]


class LookRecord(msgspec.Struct, frozen=True):
    """Learned texture of the fingers; bytes are little-endian and base64 in JSON."""

    camera: Annotated[str, Meta(description="digest of the camera model that it was learned with")]
    gripper: Annotated[str, Meta(description="digest of the gripper file")]
    reference_id: Annotated[str, Meta(description="the reference that was in force")]
    cam_T_grip: Annotated[Transform, Meta(description="where the gripper was when its pixels were chosen")]
    jaw_opening_m: Annotated[float | None, Meta(description="and its opening then, m; null without a jaw")]
    views: Annotated[int, Meta(description="frames with a new background that it was learned from")]
    mean: Annotated[bytes, Meta(description="float16 (n, 16): mean texture of each patch")]
    weight: Annotated[bytes, Meta(description="float32 (n,): frames behind each mean, old ones forgotten")]
    hit: Annotated[bytes, Meta(description="float16 (n,): share of frames in which a patch agreed where it was")]
    chance: Annotated[bytes, Meta(description="float16 (s, n): and where it wasn't, for each tried slide")]
    tried: Annotated[bytes, Meta(description="float32 (s,): frames behind each slide, old ones forgotten")]
    strips: Annotated[
        StripsRecord | msgspec.UnsetType, Meta(description="left out before a frame was learned, or without strips")
    ] = msgspec.UNSET
