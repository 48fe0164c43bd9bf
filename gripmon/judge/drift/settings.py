"""What counts as a drift, and how many false alarms an unmoved camera may cause."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.records import Array


class DriftSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The contract of the sequential test."""

    false_alarms_per_day: Annotated[
        float, Meta(gt=0.0, le=1000.0, description="drift alarms a day that an unmoved camera may give (1/day)")
    ] = 1.0
    frames_per_s: Annotated[
        float,
        Meta(gt=0.0, le=2000.0, description="frame rate until the stream's own has been measured (1/s)"),
    ] = 60.0
    tolerated_m: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="shift of the TCP along a camera axis that never raises an alarm (m)"),
    ] = 5e-6
    tolerated_rad: Annotated[
        float, Meta(ge=0.0, le=1.0, description="turn about a camera axis that never raises an alarm (rad)")
    ] = 1e-4
    vibration_m: Annotated[
        float,
        Meta(gt=0.0, le=0.1, description="root mean square vibration of the TCP that raises an alert (m)"),
    ] = 2e-5

    @property
    def tolerated(self) -> Array:
        """Shift of the TCP and turn (6,) that never cause an alarm, m and rad."""
        return np.array([self.tolerated_m] * 3 + [self.tolerated_rad] * 3)
