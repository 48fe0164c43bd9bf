"""A report as data, as ``gripmon report --json`` writes it and the page shows it.

SI units, radians, Unix nanoseconds.  Within a major version of the schema fields may be added, not renamed.  A field
that people see in a table says here how it is called, what it means and how its value is worded (:func:`facts`).
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from gripmon.analyse.words import degrees, duration, millimetres, percent, rate
from gripmon.model.records import CauseWeight
from gripmon.record.table import COLUMNS

Vector = tuple[float, float, float]


def _is(description: str, name: str | None = None, words: Callable[[Any], str] = str) -> Meta:
    """``name``: how people call the field, which then is a fact; ``words``: of its value."""
    return Meta(title=name, description=description, extra=None if name is None else {"words": words})


class Fact(NamedTuple):
    """A field for people: its name, its value in words with the unit, and what it is."""

    name: str
    text: str
    help: str


def facts(of: msgspec.Struct) -> list[Fact]:
    """The fields of a struct that have a name and a value, in order."""
    out = []
    for field, hint in typing.get_type_hints(type(of), include_extras=True).items():
        value = getattr(of, field)
        about = next((each for each in getattr(hint, "__metadata__", ()) if each.title is not None), None)
        if about is not None and value is not None:
            out.append(Fact(about.title, about.extra["words"](value), about.description))
    return out


class Displacement(msgspec.Struct, frozen=True):
    """The size of a motion."""

    tcp_shift_m: Annotated[Vector, _is("of the TCP along the camera's x, y, z, m")]
    size_m: Annotated[float, _is("length of tcp_shift_m")]
    sigma_m: Annotated[
        float | None, _is("standard deviation of size_m by frames' noise, without light and bevels; null: not known")
    ]
    rotation_rad: Annotated[float | None, _is("turn, rad; null: not known")]
    rotation_sigma_rad: Annotated[float | None, _is("standard deviation of rotation_rad, likewise")] = None


def size(moved: Displacement | None) -> str:
    """Shift and turn of a displacement."""
    if moved is None:
        return "–"
    shift = millimetres(moved.size_m, moved.sigma_m)
    turn = "" if moved.rotation_rad is None else f", {degrees(moved.rotation_rad, moved.rotation_sigma_rad)}"
    return shift + turn


class Onset(msgspec.Struct, frozen=True):
    """When something began."""

    stamp_ns: Annotated[int, _is("most probably")]
    earliest_ns: Annotated[int, _is("it had not begun before")]
    latest_ns: Annotated[int, _is("it had begun by then")]
    found_by: Annotated[str, _is("hindsight (change points), frames (in them), alert (when it was raised)")]


class Moment(msgspec.Struct, frozen=True):
    """One step in the life of an event."""

    stamp_ns: int
    text: str


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened."""

    number: Annotated[int, _is("1, 2, … within its recording, in order of time")] = 0
    kind: Annotated[str, _is("an alert's kind (step, creep, drift, lost, …), gap, command, or reference")]
    title: Annotated[str, _is("a few words")]
    severity: Annotated[str, _is("info, warning or error: the gravest of its alerts")]
    onset: Onset
    noticed_ns: Annotated[int | None, _is("of its first alert; null: it never was one")] = None
    end_ns: Annotated[int | None, _is("when it was over; null: it was not when the recording ended")] = None
    end_text: Annotated[str, _is("how it ended; may be empty")] = ""
    cause: Annotated[str, _is("the most probable cause by name; unknown if none is probable enough")] = "unknown"
    cause_probability: Annotated[float | None, _is("of that cause, 0 to 1; null: it was not weighed")] = None
    part: Annotated[str | None, _is("the finger that the cause is about")] = None
    causes: Annotated[tuple[CauseWeight, ...], _is("all that were weighed")] = ()
    moved: Annotated[Displacement | None, _is("by how much the event itself moved the TCP; null: not a motion")] = None
    moved_in_s: Annotated[float | None, _is("time for 95 % of that; 0: at once")] = None
    rate_m_per_min: Annotated[float | None, _is("of a creep, by its last alert")] = None
    alert_id: Annotated[str, _is("of the alert; empty: of none")] = ""
    before_seq: Annotated[int | None, _is("frame of the picture before; null: none is recorded")] = None
    at_seq: Annotated[
        int | None, _is("of a motion the first picture that shows it, of all else the first one in it")
    ] = None
    after_seq: Annotated[int | None, _is("frame of the picture after: the first valid one, if there is one")] = None
    story: Annotated[tuple[Moment, ...], _is("its alerts, in order")] = ()


class AffectedRange(msgspec.Struct, frozen=True, kw_only=True):
    """A time in which something should not be relied on."""

    what: Annotated[
        str,
        _is(
            "old_calibration: the calibration in force when the recording begins doesn't hold; "
            "stale_reference: the one in force at the time doesn't; suspect: transforms were given as suspect; "
            "unknown: no transform was given"
        ),
    ]
    start_ns: Annotated[int, _is("for a motion its change point")]
    limit_ns: Annotated[int | None, _is("when a motion exceeded the limit; null: it isn't a motion")] = None
    end_ns: int
    ended_by: Annotated[str, _is("recalibration, return, measured_again, or end_of_recording")]
    reference_id: str
    revision: int
    frames: Annotated[int, _is("recorded in this time")]
    largest: Annotated[Displacement | None, _is("farthest off; null: not about a motion")] = None
    meaning: Annotated[str, _is("for those who ask what to do, one sentence")] = ""


class Limits(msgspec.Struct, frozen=True):
    """What counts as too much."""

    affected_m: Annotated[float, _is("a calibration that is off by more at the TCP doesn't hold")]
    affected_rad: Annotated[float, _is("nor one that is turned by more")]
    warn_m: Annotated[float, _is("monitor.policy.warn_m")]
    warn_rad: float
    limit_m: Annotated[float, _is("monitor.policy.limit_m: past it the reference is measured again")]
    limit_rad: float
    origin: Annotated[str, _is("where they come from, in words")]
    alert_limit_m: Annotated[
        float | None, _is("monitor.policy.alert_limit_m: a position's error bound is compared with it")
    ] = None
    alert_limit_rad: float | None = None
    valid_by: Annotated[
        str, _is("monitor.policy.valid_by: which error that is, absolute or reference, of the motion since it")
    ] = "absolute"


class Integrity(msgspec.Struct, frozen=True, kw_only=True):
    """How large errors may have been, frame by frame, and how often that was within the alert limits."""

    frames: Annotated[int, _is("that have bounds: those with a transform")]
    valid: Annotated[
        float,
        _is(
            "share of all frames, missing ones too, whose transform was valid, 0 to 1", "Valid, of all frames", percent
        ),
    ]
    within: Annotated[
        float,
        _is(
            "share of all frames, likewise, with both bounds within the alert limits, 0 to 1",
            "Bounds within the alert limits",
            percent,
        ),
    ]
    median_m: Annotated[
        float, _is("median of the bounds on the TCP's position error", "Protection level, median", millimetres)
    ]
    p99_m: Annotated[float, _is("99 % of them are at most that", "Protection level, 99 %", millimetres)]
    median_rad: Annotated[float, _is("median of the bounds on the rotation error", "Of the rotation, median", degrees)]
    p99_rad: Annotated[float, _is("99 % of them are at most that", "Of the rotation, 99 %", degrees)]
    risk: Annotated[float, _is(COLUMNS["integrity_risk"].help)]


class Noise(msgspec.Struct, frozen=True):
    """Of transforms while nothing moves: standard deviation from frame to frame, robust, camera axes x, y, z."""

    position_m: Vector
    rotation_rad: Vector
    claimed_position_m: Annotated[Vector, _is("median by the covariances; more than noise")]
    claimed_rotation_rad: Vector
    frames: Annotated[int, _is("pairs of successive frames")]


class Share(msgspec.Struct, frozen=True):
    """Of a verdict or state."""

    name: str
    frames: int
    share: Annotated[float, _is("of all frames, 0 to 1")]


class Stretch(msgspec.Struct, frozen=True):
    """A period of one state or verdict."""

    name: str
    start_ns: int
    end_ns: int


class Slice(msgspec.Struct, frozen=True):
    """How it ran in one part of the time."""

    start_ns: int
    end_ns: int
    frames: int
    valid: Annotated[float, _is("share of its frames, 0 to 1")]
    suspect: float
    unknown: float
    latency_median_s: float | None
    latency_p99_s: float | None


class Curve(msgspec.Struct, frozen=True):
    """A quantity over time: per piece of time the median and the bounds of the measurements, including ± two standard
    deviations.  Null where nothing was measured.
    """

    name: Annotated[
        str,
        _is(
            "tcp_from_beginning_m, tcp_from_reference_m, x_m, y_m, z_m, rotation_rad; where the recording "
            "has them protection_m, protection_rad, since_reference_m, since_reference_rad, absolute_m, absolute_rad"
        ),
    ]
    stamp_ns: Annotated[tuple[int, ...], _is("middle of each piece")]
    middle: Annotated[tuple[float | None, ...], _is("median; x, y, z, rotation: against the reference")]
    low: tuple[float | None, ...]
    high: tuple[float | None, ...]


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """How the monitor ran."""

    frames: Annotated[int, _is("frames in the recording", "Recorded")]
    frames_dropped: Annotated[int, _is("numbers missing between the first frame and the last", "Missing")]
    dropped: Annotated[
        tuple[str, ...], _is("where frames are missing that were not recorded; damage is among the faults")
    ]
    frames_refused: Annotated[int, _is("that couldn't be measured", "Not measured")]
    monitor_dropped: Annotated[
        int | None,
        _is("of the missing those that it had no time for; null: not recorded", "Skipped because the monitor was busy"),
    ]
    recording_dropped: Annotated[
        int | None,
        _is("that the recorder had no time for; null: not recorded", "Skipped because the recorder was busy"),
    ]
    frames_per_s: Annotated[float | None, _is("median rate; null with less than two frames", "Rate", rate)]
    gaps: Annotated[int, _is("pauses of more than a second", "Pauses")]
    longest_gap_s: float
    latency_median_s: Annotated[float | None, _is(COLUMNS["latency_ns"].help, "Latency, median", duration)]
    latency_p99_s: Annotated[float | None, _is("99 % of the frames took at most that", "Latency, 99 %", duration)]
    noise: Annotated[Noise | None, _is("null: too few frames without motion")]
    verdicts: tuple[Share, ...]
    states: tuple[Share, ...]
    state_history: tuple[Stretch, ...]
    verdict_history: tuple[Stretch, ...]
    slices: Annotated[tuple[Slice, ...], _is("equal parts of the time, those without frames left out")]


class ReferenceEntry(msgspec.Struct, frozen=True):
    """A reference that was in force."""

    reference_id: str
    revision: int
    in_force_ns: Annotated[int, _is("from the first frame that names it")]
    origin: str
    accepted_by: str
    cause: str
    step: Annotated[Displacement | None, _is("against the one before; null: it is the first")]


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
    version: Annotated[str, _is("of gripmon, which recorded it")]
    files: tuple[str, ...]
    start_ns: int
    end_ns: int
    summary: Annotated[str, _is("one paragraph")]
    limits: Limits
    at_end: Annotated[Displacement | None, _is("against the calibration at the beginning; null: never measured")]
    at_end_against_reference: Annotated[Displacement | None, _is("against the one in force at the end")]
    last_measured_ns: int | None
    events: tuple[Event, ...]
    affected: tuple[AffectedRange, ...]
    running: Running
    curves: tuple[Curve, ...]
    references: tuple[ReferenceEntry, ...]
    commands: tuple[CommandEntry, ...]
    faults: Annotated[tuple[str, ...], _is("what of it could not be used, a line each")]
    missable_m: Annotated[
        float | None,
        _is(
            "a step of the TCP without an alert may be missing among the events up to that size: two backgrounds may "
            "differ by it, or it is no more than what counts as affected; null: not known",
            "Steps may be missing up to",
            millimetres,
        ),
    ] = None
    integrity: Annotated[
        Integrity | None, _is("null: the version that recorded it stated no bounds, or nothing was measured")
    ] = None


class Report(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.report/1"):
    """The whole report: what moved, when, how far, why, and what is affected."""

    summary: str
    version: Annotated[str, _is("of gripmon, which made the report")]
    recordings: tuple[RecordingReport, ...]
    faults: Annotated[tuple[str, ...], _is("files that could not be used at all, a line each")]
