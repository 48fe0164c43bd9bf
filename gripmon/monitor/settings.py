"""Settings of the whole method, a section for each step."""

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
from gripmon.model.response import Response
from gripmon.track.edges import MeasurementSettings


class MonitorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole method, a section for each step."""

    measurement: Annotated[
        Literal["edges", "corners"],
        Meta(description="what the pose update uses: all inlier edge points, or the corners as in equation (17)"),
    ] = "edges"
    update_corners: Annotated[
        Literal["all", "3P", "4P", "5P"],
        Meta(
            description="with measurement: corners, which corners are used: all usable ones, or the given "
            "number nearest the TCP"
        ),
    ] = "all"
    recalibrate_corners: Annotated[
        Literal["all", "4P", "5P"],
        Meta(description="which corners a recalibration uses: all usable ones, or the given number nearest the TCP"),
    ] = "all"
    bit_depth: Annotated[
        int,
        Meta(
            ge=8,
            le=16,
            description="significant bits of a 16-bit image, the lowest ones: 10 for Mono10, 12 for Mono12 (bit)",
        ),
    ] = 16
    jaw_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the reported jaw opening's error, the part that changes as the "
            "jaw moves; 0: the reported opening is exact (m)",
        ),
    ] = 5e-5
    jaw_offset_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the constant part of that error; no effect where jaw_sigma_m is 0 (m)",
        ),
    ] = 2e-4
    floor_m: Annotated[
        float,
        Meta(ge=0.0, le=0.01, description="systematic position error that averaging does not remove, per axis (m)"),
    ] = 2e-6
    floor_rad: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="systematic rotation error that averaging does not remove, per axis (rad)"),
    ] = 5e-5
    model_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.01,
            description="standard deviation of each finger's length in the gripper file, for the protection "
            "level; taken as 0 where edges were taught (m)",
        ),
    ] = 1e-4
    corners: MeasurementSettings = MeasurementSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    drift: DriftSettings = DriftSettings()
    policy: PolicySettings = PolicySettings()
    causes: CauseSettings = CauseSettings()
    stream: StreamSettings = StreamSettings()
    recalibration: RecalibrationSettings = RecalibrationSettings()

    def with_response(self, response: Response) -> MonitorSettings:
        """The same with another ``corners.edges.response``."""
        edges = msgspec.structs.replace(self.corners.edges, response=response)
        return msgspec.structs.replace(self, corners=msgspec.structs.replace(self.corners, edges=edges))
