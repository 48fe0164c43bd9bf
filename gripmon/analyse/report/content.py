"""What a report is made from, and what it says, as data: ``gripmon report --json`` writes it, and the page shows no
more.

SI units, radians, Unix nanoseconds.  Within a major version of the schema fields may be added, not renamed.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records import CauseWeight
from gripmon.record.read import Recording

Vector = tuple[float, float, float]


class Displacement(msgspec.Struct, frozen=True):
    """By how much something moved."""

    tcp_shift_m: Annotated[Vector, Meta(description="of the TCP along the camera's x, y, z, m")]
    size_m: Annotated[float, Meta(description="length of tcp_shift_m")]
    sigma_m: Annotated[float | None, Meta(description="standard deviation of size_m; null: not known")]
    rotation_rad: Annotated[float | None, Meta(description="turn, rad; null: not known")]
    rotation_sigma_rad: Annotated[float | None, Meta(description="standard deviation of rotation_rad")] = None


class Onset(msgspec.Struct, frozen=True):
    """When something began."""

    stamp_ns: Annotated[int, Meta(description="most probably")]
    earliest_ns: Annotated[int, Meta(description="it had not begun before")]
    latest_ns: Annotated[int, Meta(description="it had begun by then")]
    found_by: Annotated[
        str, Meta(description="hindsight (change points), frames (in them), alert (when it was raised)")
    ]


class Moment(msgspec.Struct, frozen=True):
    """One step in the life of an event."""

    stamp_ns: int
    text: str


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened."""

    number: Annotated[int, Meta(description="1, 2, … within its recording, in order of time")] = 0
    kind: Annotated[str, Meta(description="an alert's kind (step, creep, drift, lost, …), gap, command, or reference")]
    title: Annotated[str, Meta(description="a few words")]
    severity: Annotated[str, Meta(description="info, warning or error: the worst that was said")]
    onset: Onset
    noticed_ns: Annotated[int | None, Meta(description="when it was first said; null: it never was an alert")] = None
    end_ns: Annotated[int | None, Meta(description="when it was over; null: it was not when the recording ended")] = (
        None
    )
    end_text: Annotated[str, Meta(description="how it ended; empty where there is nothing to say")] = ""
    cause: Annotated[str, Meta(description="the most probable cause by name; unknown if none is probable enough")] = (
        "unknown"
    )
    cause_probability: Annotated[float | None, Meta(description="of that cause, 0 to 1; null: it was not weighed")] = (
        None
    )
    part: Annotated[str | None, Meta(description="the finger that the cause is about")] = None
    causes: Annotated[tuple[CauseWeight, ...], Meta(description="all that were weighed")] = ()
    moved: Annotated[
        Displacement | None, Meta(description="by how much the event itself moved the TCP; null: it is no motion")
    ] = None
    moved_in_s: Annotated[float | None, Meta(description="time for 95 % of that; 0: at once")] = None
    rate_m_per_min: Annotated[float | None, Meta(description="of a creep, as said last")] = None
    alert_id: Annotated[str, Meta(description="of the alert; empty: of none")] = ""
    before_seq: Annotated[int | None, Meta(description="frame of the picture before; null: none is recorded")] = None
    at_seq: Annotated[
        int | None, Meta(description="of a motion the first picture that shows it, of all else the first one in it")
    ] = None
    after_seq: Annotated[
        int | None, Meta(description="frame of the picture after: the first that was believed, if any was")
    ] = None
    story: Annotated[tuple[Moment, ...], Meta(description="what was said of it, in order")] = ()


class AffectedRange(msgspec.Struct, frozen=True, kw_only=True):
    """A time in which something should not be relied on."""

    what: Annotated[
        str,
        Meta(
            description="old_calibration: the calibration in force when the recording begins doesn't hold; "
            "stale_reference: the one in force at the time doesn't; suspect: transforms were given as suspect; "
            "unknown: no transform was given"
        ),
    ]
    start_ns: Annotated[int, Meta(description="for a motion its change point")]
    limit_ns: Annotated[int | None, Meta(description="when a motion went past the limit; null: it is none")] = None
    end_ns: int
    ended_by: Annotated[str, Meta(description="recalibration, return, measured_again, or end_of_recording")]
    reference_id: str
    revision: int
    frames: Annotated[int, Meta(description="recorded in this time")]
    largest: Annotated[Displacement | None, Meta(description="farthest off; null: not about a motion")] = None
    meaning: Annotated[str, Meta(description="for those who ask what to do, one sentence")] = ""


class Limits(msgspec.Struct, frozen=True):
    """What is too much."""

    affected_m: Annotated[float, Meta(description="a calibration that is off by more at the TCP doesn't hold")]
    affected_rad: Annotated[float, Meta(description="nor one that is turned by more")]
    warn_m: Annotated[float, Meta(description="monitor.policy.warn_m")]
    warn_rad: float
    limit_m: Annotated[float, Meta(description="monitor.policy.limit_m: past it the reference is measured anew")]
    limit_rad: float
    origin: Annotated[str, Meta(description="where they come from, in words")]
    alert_limit_m: Annotated[
        float | None, Meta(description="monitor.policy.alert_limit_m: bounds on a position's error are held against it")
    ] = None
    alert_limit_rad: float | None = None


class Integrity(msgspec.Struct, frozen=True, kw_only=True):
    """How large errors may have been, frame by frame, and how often that was within the alert limits."""

    frames: Annotated[int, Meta(description="that have bounds: those with a transform")]
    valid: Annotated[float, Meta(description="share of all frames whose transform was valid, 0 to 1")]
    within: Annotated[float, Meta(description="share of all frames with both bounds within the alert limits, 0 to 1")]
    median_m: Annotated[float, Meta(description="median of the bounds on the TCP's position error")]
    p99_m: Annotated[float, Meta(description="99 % of them are at most that")]
    median_rad: Annotated[float, Meta(description="median of the bounds on the rotation error")]
    p99_rad: float
    risk: Annotated[float, Meta(description="probability a frame that the error exceeds a bound")]


class Noise(msgspec.Struct, frozen=True):
    """Of transforms while nothing moves: standard deviation from frame to frame, robust, camera axes x, y, z."""

    position_m: Vector
    rotation_rad: Vector
    claimed_position_m: Annotated[Vector, Meta(description="median of what the covariances say; more than noise")]
    claimed_rotation_rad: Vector
    frames: Annotated[int, Meta(description="pairs of successive frames")]


class Share(msgspec.Struct, frozen=True):
    """Of a verdict or state."""

    name: str
    frames: int
    share: Annotated[float, Meta(description="of all frames, 0 to 1")]


class Stretch(msgspec.Struct, frozen=True):
    """As long as a state lasts."""

    name: str
    start_ns: int
    end_ns: int


class Slice(msgspec.Struct, frozen=True):
    """How it ran in one part of the time."""

    start_ns: int
    end_ns: int
    frames: int
    valid: Annotated[float, Meta(description="share of its frames, 0 to 1")]
    suspect: float
    unknown: float
    latency_median_s: float | None
    latency_p99_s: float | None


class Curve(msgspec.Struct, frozen=True):
    """Something over time: in pieces of time the middle and the bounds of what was measured, ± two standard deviations
    included.  Null where nothing was measured.
    """

    name: Annotated[
        str,
        Meta(
            description="tcp_from_beginning_m, tcp_from_reference_m, x_m, y_m, z_m, rotation_rad; where the recording "
            "has them protection_m, protection_rad"
        ),
    ]
    stamp_ns: Annotated[tuple[int, ...], Meta(description="middle of each piece")]
    middle: Annotated[tuple[float | None, ...], Meta(description="median; x, y, z, rotation: against the reference")]
    low: tuple[float | None, ...]
    high: tuple[float | None, ...]


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """How the monitor ran."""

    frames: int
    frames_dropped: Annotated[int, Meta(description="numbers missing between the first frame and the last")]
    dropped: Annotated[
        tuple[str, ...], Meta(description="where frames are missing that nobody recorded; damage is among the faults")
    ]
    frames_refused: Annotated[int, Meta(description="that couldn't be measured")]
    monitor_dropped: Annotated[
        int | None, Meta(description="of these those that it had no time for; null: not recorded")
    ]
    recording_dropped: Annotated[int | None, Meta(description="that the recorder had no time for; null: not recorded")]
    frames_per_s: Annotated[float | None, Meta(description="median rate; null with less than two frames")]
    gaps: Annotated[int, Meta(description="pauses of more than a second")]
    longest_gap_s: float
    latency_median_s: float | None
    latency_p99_s: float | None
    noise: Annotated[Noise | None, Meta(description="null: too few frames without motion")]
    verdicts: tuple[Share, ...]
    states: tuple[Share, ...]
    state_history: tuple[Stretch, ...]
    verdict_history: tuple[Stretch, ...]
    slices: Annotated[tuple[Slice, ...], Meta(description="equal parts of the time, those without frames left out")]


class ReferenceEntry(msgspec.Struct, frozen=True):
    """A reference that was in force."""

    reference_id: str
    revision: int
    in_force_ns: Annotated[int, Meta(description="from the first frame that names it")]
    origin: str
    accepted_by: str
    cause: str
    step: Annotated[Displacement | None, Meta(description="against the one before; null: it is the first")]


class CommandEntry(msgspec.Struct, frozen=True):
    """A command that was carried out."""

    stamp_ns: int
    name: str
    argument: str
    done: bool
    text: str


class RecordingReport(msgspec.Struct, frozen=True, kw_only=True):
    """One run of one monitor."""

    robot: str
    camera: str
    gripper: str
    recording_id: str
    version: Annotated[str, Meta(description="of gripmon, which recorded it")]
    files: tuple[str, ...]
    start_ns: int
    end_ns: int
    summary: Annotated[str, Meta(description="one paragraph")]
    limits: Limits
    at_end: Annotated[
        Displacement | None, Meta(description="against the calibration at the beginning; null: never measured")
    ]
    at_end_against_reference: Annotated[Displacement | None, Meta(description="against the one in force at the end")]
    last_measured_ns: int | None
    events: tuple[Event, ...]
    affected: tuple[AffectedRange, ...]
    running: Running
    curves: tuple[Curve, ...]
    references: tuple[ReferenceEntry, ...]
    commands: tuple[CommandEntry, ...]
    faults: Annotated[tuple[str, ...], Meta(description="what of it could not be used, a line each")]
    integrity: Annotated[
        Integrity | None,
        Meta(description="null: the version that recorded it stated no bounds, or nothing was measured"),
    ] = None


class Report(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.report/1"):
    """After a failed shift: what moved, when, how far, why, and what is affected."""

    summary: str
    version: Annotated[str, Meta(description="of gripmon, which made the report")]
    recordings: tuple[RecordingReport, ...]
    faults: Annotated[tuple[str, ...], Meta(description="files that could not be used at all, a line each")]


def main_text(source: Recording) -> str | None:
    """The text of the recorded configuration's main file; None if there is none."""
    configuration = source.configuration
    file = None if configuration is None else configuration.files.get(configuration.main)
    if file is None:
        return None
    try:
        return file.data.decode("utf-8", "replace")
    except ValueError:
        return None
