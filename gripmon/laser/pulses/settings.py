"""What a person may set about a pulsed laser."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class PulseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which frames show a pulse."""

    margin_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=10.0,
            description="of a pulse's frames those so near to its ends are left out: exposure, transfer, laser (s)",
        ),
    ] = 0.05
    history_s: Annotated[
        float,
        Meta(gt=0.0, le=600.0, description="frames are kept for so long, for pulses that are told afterwards (s)"),
    ] = 3.0
    history_bytes: Annotated[int, Meta(ge=1_000_000, description="memory for them; the oldest give way (bytes)")] = (
        500_000_000
    )
    most_frames: Annotated[
        int, Meta(ge=1, le=1000, description="so many frames of a pulse, the last ones, are averaged at most (frames)")
    ] = 8
    wait_s: Annotated[
        float,
        Meta(gt=0.0, le=3600.0, description="so long after its end, from its arrival, frames of a pulse may come (s)"),
    ] = 10.0
