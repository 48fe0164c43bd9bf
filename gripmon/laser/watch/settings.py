"""What counts as moved, and how often an unmoved set-up may be said to have moved."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.records import Array


class SpotWatchSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The test's contract, what is known of the arm and of wrong spots, and what a motion is worth."""

    false_alarms_per_1000_pulses: Annotated[
        float, Meta(gt=0.0, le=10.0, description="motions that an unmoved set-up may be said to have made (1/1000)")
    ] = 0.1
    arm_noise_m: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="standard deviation of the arm's reported positions, each axis (m)"),
    ] = 1e-4
    arm_noise_rad: Annotated[
        float,
        Meta(ge=0.0, le=0.5, description="standard deviation of the arm's reported rotations, each axis (rad)"),
    ] = 2e-4
    wrong_spots: Annotated[
        float, Meta(gt=0.0, le=0.5, description="part of the pulses whose spot may be a reflection or none at all")
    ] = 0.2
    probable: Annotated[
        float, Meta(gt=0.5, lt=1.0, description="probability from which a cause is named, else it is unknown")
    ] = 0.9
    warn_m: Annotated[
        float, Meta(gt=0.0, le=1.0, description="shift of the spots from which a motion is a warning (m)")
    ] = 1e-3
    limit_m: Annotated[
        float, Meta(gt=0.0, le=1.0, description="shift of the spots from which a motion is an error (m)")
    ] = 5e-3
    lost_pulses: (
        Annotated[
            int,
            Meta(ge=2, le=1000, description="pulses in a row without the spot after which it is lost"),
        ]
        | None
    ) = None
    """Absent: as many as wrong spots make rarer than false alarms may be."""
    confirm_pulses: Annotated[
        int, Meta(ge=1, le=1000, description="good pulses after a start, or after lost ones, until it counts as valid")
    ] = 2
    update_alert_s: Annotated[
        float, Meta(ge=0.0, le=3600.0, description="an open alert that changes is updated so often at most (s)")
    ] = 2.0

    @property
    def pulses_until_lost(self) -> int:
        """Pulses in a row."""
        if self.lost_pulses is not None:
            return self.lost_pulses
        return max(math.ceil(math.log(1e-3 * self.false_alarms_per_1000_pulses) / math.log(self.wrong_spots)), 2)

    @property
    def arm_covariance(self) -> Array:
        """(6, 6) of a pose that the arm reports, position then rotation."""
        return np.diag(np.square([self.arm_noise_m] * 3 + [self.arm_noise_rad] * 3))
