"""Messages on the wire other than the frames' own records."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.alerts import Alert, AlertKind, Severity
from gripmon.model.records.frames import State, Verdict
from gripmon.model.records.values import ValidBy


class StandingAlert(msgspec.Struct, frozen=True):
    """What a table shows of an alert that is raised and not cleared yet."""

    alert_id: Annotated[str, Meta(description="the same from raised to cleared")]
    kind: AlertKind
    severity: Severity
    text: Annotated[str, Meta(description="what was said of it last")]
    since_ns: Annotated[int | None, Meta(description="when it was raised, Unix ns")]
    acknowledged: Annotated[bool, Meta(description="a person has taken note of it")]


class StateRecord(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.state/1"):
    """What the monitor is doing: once a second and on every change."""

    robot: Annotated[str, Meta(description="second part of the monitor's keys")]
    camera: Annotated[str, Meta(description="third part of the monitor's keys")]
    state: State
    verdict: Annotated[Verdict, Meta(description="verdict of the last transform; unknown without frames")]
    stamp_ns: Annotated[int, Meta(description="time of this message, Unix ns")]
    seq: Annotated[int, Meta(description="the last frame's; -1 before the first")]
    reference_id: Annotated[str, Meta(description="the reference in force")]
    revision: Annotated[int, Meta(description="revision of the reference in force; grows with every change of it")]
    frames: Annotated[int, Meta(description="frames processed since the start")]
    frames_refused: Annotated[int, Meta(description="of these, frames that could not be measured at all")]
    frames_dropped: Annotated[int, Meta(description="frames that came while another one was processed")]
    frames_per_s: Annotated[float, Meta(description="rate of the last frames, 1/s; 0 while none come")]
    uptime_s: Annotated[float, Meta(description="time since the monitor's start, s")]
    camera_connected: Annotated[bool, Meta(description="whether the source is open")]
    recording_dropped: Annotated[int, Meta(description="frames that the recording had no time for")]
    message: Annotated[str, Meta(description="what is wrong, in words; empty when all is well")]
    version: Annotated[str, Meta(description="of gripmon")]
    tcp_shift_m: Annotated[
        tuple[float, float, float] | None,
        Meta(description="displacement of the TCP along the camera's x, y, z against the reference, m; null: unknown"),
    ] = None
    sigma_m: Annotated[
        float | None,
        Meta(description="largest standard deviation of the TCP's position along a camera axis, m; null: unknown"),
    ] = None
    protection_m: Annotated[
        float | None,
        Meta(description="bound on the TCP's position error, of the last transform, m; null: unknown"),
    ] = None
    alert_limit_m: Annotated[
        float | None,
        Meta(description="position error of the TCP that the task tolerates, as configured, m; null: unknown"),
    ] = None
    open_alerts: Annotated[
        tuple[StandingAlert, ...], Meta(description="alerts raised and not cleared yet, oldest first")
    ] = ()
    transforms_unsent: Annotated[int, Meta(description="transforms that came before there was a Zenoh session")] = 0
    malformed: Annotated[
        int, Meta(description="messages received that were none: jaw openings, frames, commands")
    ] = 0
    recording_images_dropped: Annotated[
        int, Meta(description="images that should be in the recording and aren't, of frames that are")
    ] = 0
    monitor_id: Annotated[str, Meta(description="of this start of the monitor; empty from one before ids")] = ""
    proposal_id: Annotated[
        str, Meta(description="the new reference that waits for an operator to accept or reject it; empty if none does")
    ] = ""
    valid_by: Annotated[
        ValidBy | None,
        Meta(description="which error protection_m bounds, as in transform; null for earlier monitors"),
    ] = None


class AlertRecord(Alert, frozen=True, kw_only=True, tag_field="schema", tag="gripmon.alert/1"):
    """One alert with the frame and the state that it belongs to."""

    robot: Annotated[str, Meta(description="second part of the monitor's keys")]
    camera: Annotated[str, Meta(description="third part of the monitor's keys")]
    seq: Annotated[int, Meta(description="of the frame that it belongs to, or the last one before it; -1: none yet")]
    stamp_ns: Annotated[int, Meta(description="of that frame, or when it was said, Unix ns")]
    state: State
    reference_id: Annotated[str, Meta(description="the reference in force")]
    revision: Annotated[int, Meta(description="of the reference in force")]
    monitor_id: Annotated[str, Meta(description="of this start of the monitor; empty from one before ids")] = ""


class ClockReading(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.clock/1"):
    """A reading of the monitor's monotonic clock: attached to a transform as it is sent, or in reply to a query."""

    clock: Annotated[str, Meta(max_length=64, description="which clock; another one after every start of the monitor")]
    now_ns: Annotated[
        int, Meta(ge=0, le=2**63 - 1, description="ns since no moment in particular; no one sets it, it never jumps")
    ]


class JawReading(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.jaw/1"):
    """The jaw opening, which the robot publishes."""

    stamp_ns: Annotated[int, Meta(description="when it was measured, Unix ns; 0 if that isn't known")]
    opening_m: Annotated[float, Meta(description="distance of the jaws as the gripper file counts it, m")]


Side = Annotated[int, Meta(ge=1, le=65535)]


class FrameNote(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema", tag="gripmon.frame/1"):
    """What a driver attaches to a frame.  Raw pixels need ``width``, ``height`` and ``encoding``, files don't."""

    stamp_ns: (
        Annotated[
            int, Meta(ge=0, le=2**63 - 1, description="when the image was captured, Unix ns; absent: Zenoh's time")
        ]
        | None
    ) = None
    # Slightly negative values are allowed: encoders report them for closed jaws, and the image is still good.
    jaw_opening_m: (
        Annotated[float, Meta(ge=-1e-3, le=1.0, description="opening of the jaws at that time, m; absent: not known")]
        | None
    ) = None
    width: Annotated[Side, Meta(description="pixels in a row")] | None = None
    height: Annotated[Side, Meta(description="rows")] | None = None
    encoding: (
        Annotated[str, Meta(max_length=40, description="pixel format, named as in ROS: mono8, mono16, bgr8, rgb8, …")]
        | None
    ) = None
    step: (
        Annotated[int, Meta(ge=1, le=2**24, description="bytes from row to row; absent: no gap between rows")] | None
    ) = None
