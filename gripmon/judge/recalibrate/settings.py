"""How many frames a recalibration takes, and what it must show to count without an operator."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta


class RecalibrationSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a new reference is measured past the limit, and who accepts it."""

    mode: Annotated[
        Literal["auto", "confirm", "off"],
        Meta(
            description="auto: a sure new reference counts at once, any other waits for an operator; "
            "confirm: every one waits for an operator; off: the reference stays"
        ),
    ] = "auto"
    frames: Annotated[
        int, Meta(ge=4, le=1000, description="frames of a camera that stands still that are averaged at least")
    ] = 20
    most_frames: Annotated[
        int,
        Meta(
            ge=4, le=1000, description="frames that are averaged at most, while fewer don't make the pose sure enough"
        ),
    ] = 60
    sure_sigma_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.01,
            description="standard deviation of the new TCP (of its distance) from which an operator must accept it (m)",
        ),
    ] = 1.7e-5
    largest_sigma_m: Annotated[
        float, Meta(gt=0.0, le=0.01, description="the same from which it is refused altogether (m)")
    ] = 2e-4
    largest_step_m: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="shift of the TCP beyond which an operator must accept the new reference (m)"),
    ] = 0.02
    largest_step_rad: Annotated[
        float,
        Meta(gt=0.0, le=3.2, description="turn beyond which an operator must accept the new reference (rad)"),
    ] = 0.175
    worst_weighted_rms: Annotated[
        float,
        Meta(
            gt=1.0,
            le=100.0,
            description="size of the corners' residuals over what their covariances allow from which they are refused",
        ),
    ] = 2.5
    worst_check_sigma_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.1,
            description="standard deviation of the TCP by the corners alone beyond which they check nothing (m)",
        ),
    ] = 1e-3
    worst_check_sigma_rad: Annotated[
        float, Meta(gt=0.0, le=3.0, description="the same of the rotation, each axis (rad)")
    ] = 0.05
