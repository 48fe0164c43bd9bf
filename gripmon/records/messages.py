"""What goes over the wire beside the frames' own records."""

from __future__ import annotations

import msgspec

from gripmon.records.alerts import Alert
from gripmon.records.frames import State, Verdict


class StateRecord(msgspec.Struct, frozen=True):
    """The ``state`` message: 1 Hz and on every change."""

    robot: str
    camera: str
    state: State
    verdict: Verdict
    stamp_ns: int
    seq: int
    reference_id: str
    revision: int
    frames: int
    frames_refused: int
    frames_dropped: int
    frames_per_s: float
    uptime_s: float
    camera_connected: bool
    recording_dropped: int
    message: str
    version: str


class AlertRecord(Alert, frozen=True, kw_only=True):
    """The ``alert`` message: one alert with the frame and the state that it belongs to."""

    robot: str
    camera: str
    seq: int
    stamp_ns: int
    state: State
    reference_id: str
    revision: int
