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
            description="auto: a new reference that is certain enough takes effect at once, any other waits "
            "for an operator; confirm: every new reference waits for an operator; off: the "
            "reference never changes"
        ),
    ] = "auto"
    frames: Annotated[
        int, Meta(ge=4, le=1000, description="least number of frames that are averaged, while the camera stands still")
    ] = 20
    most_frames: Annotated[
        int,
        Meta(
            ge=4,
            le=1000,
            description="largest number of frames that are averaged, while fewer leave the pose too uncertain",
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
        float, Meta(gt=0.0, le=0.01, description="the same, from which the new reference is refused (m)")
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
            description="weighted RMS of the corners' residuals, over their standard deviations, from which "
            "the new reference is refused",
        ),
    ] = 2.5
    worst_check_sigma_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.1,
            description="standard deviation of the TCP from the corners alone above which they are not used "
            "as a check (m)",
        ),
    ] = 1e-3
    worst_check_sigma_rad: Annotated[
        float, Meta(gt=0.0, le=3.0, description="the same for the rotation, per axis (rad)")
    ] = 0.05
