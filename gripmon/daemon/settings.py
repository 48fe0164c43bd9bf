"""What a person may set about the loop itself."""

from __future__ import annotations

from typing import Annotated

import msgspec


class DaemonSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the loop says that something is wrong, and when it gives up."""

    state_period_s: Annotated[float, msgspec.Meta(gt=0.0, description="pause between unchanged state messages (s)")] = (
        1.0
    )
    stale_after_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="no frame for this long: state stale, to half a second (s)")
    ] = 0.5
    no_camera_alert_after_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="no frame for this long: an alert (s)")
    ] = 3.0
    dropped_alert_share: Annotated[
        float,
        msgspec.Meta(gt=0.0, le=1.0, description="more of the frames of 10 s dropped, for want of time: an alert"),
    ] = 0.2
    give_up_after_errors: Annotated[
        int, msgspec.Meta(ge=1, description="internal errors in so many frames in a row: stop, exit code 3")
    ] = 50
    estimates_budget_bytes: Annotated[
        int,
        msgspec.Meta(
            ge=0,
            description="estimates.jsonl (spots.jsonl) of run --out with all that were set aside beside it: a tenth of "
            "this is a file, and beyond it the oldest are deleted; 0: one file without end (bytes)",
        ),
    ] = 10_000_000_000
    stop_within_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="from a signal to the end, the recording completed (s)")
    ] = 1.8
