"""The part of the gripper's learned look that survives a restart."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.values import Covariance, Transform


class LookVersion(msgspec.Struct, frozen=True):
    """Which learned look it is, and where it comes from."""

    number: Annotated[int, Meta(ge=1, description="1 for the first; grows when the look counts as a new one")]
    origin: Annotated[str, Meta(description="start, or what made it a new one")]
    reference_id: Annotated[str, Meta(description="the reference in force when it began")]
    revision: Annotated[int, Meta(description="of that reference")]
    first_stamp_ns: Annotated[int, Meta(description="of the first frame that it was learned from, Unix ns")]
    last_stamp_ns: Annotated[int, Meta(description="of the newest one, Unix ns")]


class LookNote(msgspec.Struct, frozen=True):
    """The look that an alert is about: a picture of it, without the image."""

    version: LookVersion
    views: Annotated[int, Meta(description="frames with another background that it was learned from")]
    block_px: Annotated[int, Meta(description="side of a block of pixels, px")]
    places_px: Annotated[tuple[tuple[int, int], ...], Meta(description="middle of each block in the frame's image")]
    different: Annotated[tuple[int, ...], Meta(description="which of them, from 0, look different than at first")]


class LookPixels(msgspec.Struct, frozen=True):
    """Blocks of pixels inside the fingers, as learned; bytes are little-endian and base64 in JSON."""

    cam_T_grip: Annotated[Transform, Meta(description="where the gripper was when the blocks were chosen")]
    jaw_opening_m: Annotated[float | None, Meta(description="and its opening then, m; null without a jaw")]
    views: Annotated[int, Meta(ge=1, description="frames with another background that they were learned from")]
    blocks: Annotated[bytes, Meta(description="uint16 (p, 3): column and row of the first pixel, number of the finger")]
    mean: Annotated[bytes, Meta(description="float32 (p, 64): mean of each pixel, steps of 8 bits")]
    variance: Annotated[bytes, Meta(description="float32 (p, 64): of each pixel about its mean")]
    first: Annotated[bytes, Meta(description="float32 (p, 64): mean when the version began; NaN: not known yet")]
    count: Annotated[bytes, Meta(description="float32 (p,): frames behind each block, of those kept")]
    unlike: Annotated[bytes, Meta(description="uint16 (p,): frames in a row in which it looked different")]


class LookBias(msgspec.Struct, frozen=True):
    """The look's bias against the edges, and its uncertainty."""

    backgrounds: Annotated[int, Meta(ge=1, description="that it was averaged over")]
    bias: Annotated[tuple[float, float, float, float, float, float], Meta(description="m and rad, camera axes")]
    covariance: Covariance
    cam_T_grip: Annotated[Transform, Meta(description="where the gripper was meanwhile")]
    jaw_opening_m: Annotated[float, Meta(description="and its opening, m; 0 without a jaw")]
    correlation: Annotated[
        float, Meta(le=1.0, description="how alike the edges err before one background and the next")
    ]


class FinerLookRecord(msgspec.Struct, frozen=True):
    """The look as a measurement."""

    edges: Annotated[str, Meta(description="digest of the taught edges that its bias was learned against; empty: none")]
    version: LookVersion
    pixels: LookPixels
    bias: LookBias | None
    different_since_ns: Annotated[
        tuple[int | None, ...],
        Meta(description="for each finger since when it looks different, Unix ns; last: since when all contradicts"),
    ]


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
    finer: Annotated[
        FinerLookRecord | msgspec.UnsetType,
        Meta(description="left out unless monitor.look.enabled, or before there is one"),
    ] = msgspec.UNSET
    strips: Annotated[
        StripsRecord | msgspec.UnsetType, Meta(description="left out before a frame was learned, or without strips")
    ] = msgspec.UNSET
