"""What a person may set about the whole method, a section for each step."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.judge.causes import CauseSettings
from gripmon.judge.drift import DriftSettings
from gripmon.judge.policy import PolicySettings
from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.judge.smoothing import SmoothingSettings
from gripmon.judge.stream import StreamSettings
from gripmon.track.edges import MeasurementSettings


class LookSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The gripper's own look as a measurement."""

    enabled: Annotated[
        bool,
        Meta(
            description="whether pixels inside the fingers, learnt while the monitor runs, refine the "
            "edges' transform; the protection level still rests on the edges"
        ),
    ] = False


class MonitorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole method, a section for each step."""

    measurement: Annotated[
        Literal["edges", "corners"],
        Meta(description="what the update rests on: all agreed edge points, or the corners of equation (17)"),
    ] = "edges"
    update_corners: Annotated[
        Literal["all", "3P", "4P", "5P"],
        Meta(
            description="with measurement: corners, which ones: all that are usable, or so many of them next to the TCP"
        ),
    ] = "all"
    recalibrate_corners: Annotated[
        Literal["all", "4P", "5P"],
        Meta(
            description="which corners a recalibration takes: all that are usable, or so many of them next to the TCP"
        ),
    ] = "all"
    bit_depth: Annotated[
        int,
        Meta(
            ge=8,
            le=16,
            description="how many of the 16 bits of an image the camera fills, the lowest ones: 10 for Mono10, 12 for "
            "Mono12 (bit)",
        ),
    ] = 16
    jaw_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the part of the reported jaw opening's error that changes as the jaw "
            "moves; 0: the report is exact (m)",
        ),
    ] = 5e-5
    jaw_offset_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the part that never changes; no effect where the report is exact (m)",
        ),
    ] = 2e-4
    floor_m: Annotated[
        float,
        Meta(ge=0.0, le=0.01, description="systematic error of the position that no averaging removes, each axis (m)"),
    ] = 2e-6
    floor_rad: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="systematic error of the rotation that no averaging removes, each axis (rad)"),
    ] = 5e-5
    model_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.01,
            description="standard deviation of each finger's length in the gripper file, for the protection level; "
            "none where edges were taught (m)",
        ),
    ] = 1e-4
    corners: MeasurementSettings = MeasurementSettings()
    look: LookSettings = LookSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    drift: DriftSettings = DriftSettings()
    policy: PolicySettings = PolicySettings()
    causes: CauseSettings = CauseSettings()
    stream: StreamSettings = StreamSettings()
    recalibration: RecalibrationSettings = RecalibrationSettings()
