"""A report as data, as ``gripmon report --json`` writes it and the page shows it, and the formatting of its numbers and
times for people: millimetres, degrees, UTC.

SI units, radians, Unix nanoseconds.  Within a major version of the schema fields may be added, not renamed.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records import CauseWeight

Vector = tuple[float, float, float]


def _is(description: str) -> Meta:
    return Meta(description=description)


class Displacement(msgspec.Struct, frozen=True):
    """The size of a motion."""

    tcp_shift_m: Annotated[Vector, _is("of the TCP along the camera's x, y, z, m")]
    size_m: Annotated[float, _is("length of tcp_shift_m")]
    sigma_m: Annotated[
        float | None, _is("standard deviation of size_m by frames' noise, without light and bevels; null: not known")
    ]
    rotation_rad: Annotated[float | None, _is("turn, rad; null: not known")]
    rotation_sigma_rad: Annotated[float | None, _is("standard deviation of rotation_rad, likewise")] = None


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
    valid: Annotated[float, _is("share of all frames, missing ones too, whose transform was valid, 0 to 1")]
    within: Annotated[float, _is("share of all frames, likewise, with both bounds within the alert limits, 0 to 1")]
    median_m: Annotated[float, _is("median of the bounds on the TCP's position error")]
    p99_m: Annotated[float, _is("99 % of them are at most that")]
    median_rad: Annotated[float, _is("median of the bounds on the rotation error")]
    p99_rad: float
    risk: Annotated[float, _is("probability per frame that the error exceeds a bound")]


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

    frames: int
    frames_dropped: Annotated[int, _is("numbers missing between the first frame and the last")]
    dropped: Annotated[
        tuple[str, ...], _is("where frames are missing that were not recorded; damage is among the faults")
    ]
    frames_refused: Annotated[int, _is("that couldn't be measured")]
    monitor_dropped: Annotated[int | None, _is("of these those that it had no time for; null: not recorded")]
    recording_dropped: Annotated[int | None, _is("that the recorder had no time for; null: not recorded")]
    frames_per_s: Annotated[float | None, _is("median rate; null with less than two frames")]
    gaps: Annotated[int, _is("pauses of more than a second")]
    longest_gap_s: float
    latency_median_s: float | None
    latency_p99_s: float | None
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
    integrity: Annotated[
        Integrity | None, _is("null: the version that recorded it stated no bounds, or nothing was measured")
    ] = None


class Report(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.report/1"):
    """The whole report: what moved, when, how far, why, and what is affected."""

    summary: str
    version: Annotated[str, _is("of gripmon, which made the report")]
    recordings: tuple[RecordingReport, ...]
    faults: Annotated[tuple[str, ...], _is("files that could not be used at all, a line each")]


COVERAGE = 2.0
"""Standard deviations of a frame's noise that count as significant and make the curves' bands."""


_FIRST_YEAR_NS = 365 * 86_400 * 1_000_000_000


def clock_time(stamp_ns: int, digits: int = 1) -> str:
    """``12:34:56.7``, UTC, truncated, so that no time is shown after the event."""
    whole, part = divmod(stamp_ns, 1_000_000_000)
    return f"{_at(whole):%H:%M:%S}" + (f".{part:09d}"[: digits + 1] if digits else "")


def date(stamp_ns: int) -> str:
    """``2026-11-21``, UTC."""
    return f"{_at(stamp_ns // 1_000_000_000):%Y-%m-%d}"


def period(start_ns: int, end_ns: int) -> str:
    """``2026-11-21, 12:34:56 to 12:34:58 UTC``; images without time stamps count from 0, which is not a date."""
    times = f"{clock_time(start_ns, 0)} to {clock_time(end_ns, 0)}"
    if 0 <= start_ns < _FIRST_YEAR_NS:
        return f"{times} by a clock that began with the images, or with 1970"
    return f"{date(start_ns)}, {times} UTC"


def iso(stamp_ns: int) -> str:
    """``2026-11-21T12:34:56.789Z``."""
    return f"{date(stamp_ns)}T{clock_time(stamp_ns, 3)}Z"


def _at(seconds: int) -> datetime:
    """Years outside the calendar are clipped to it."""
    return datetime.fromtimestamp(min(max(seconds, -62_135_596_800), 253_402_300_799), UTC)


def duration(seconds: float) -> str:
    """A duration in the two units that fit."""
    if seconds < 0.0995:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    minutes = round(seconds / 60.0)
    if minutes < 1440:
        return f"{minutes // 60} h {minutes % 60} min"
    hours = round(seconds / 3600.0)
    return f"{hours // 24} d {hours % 24} h"


def span(start_ns: int, end_ns: int) -> str:
    """How long from one time to another."""
    return duration(1e-9 * (end_ns - start_ns))


def millimetres(metres: float, sigma_m: float | None = None) -> str:
    """``4.21 mm``: two standard deviations of the frames' noise determine the digits.  They aren't shown as ±: light
    and bevels, which they leave out, may shift a measurement by more.
    """
    if not math.isfinite(metres):
        return "unknown"
    return f"{_measured(1e3 * metres, None if sigma_m is None else 1e3 * sigma_m)} mm"


def degrees(radians: float | None, sigma_rad: float | None = None) -> str:
    """``1.63°``, digits as :func:`millimetres`."""
    if radians is None or not math.isfinite(radians):
        return "unknown"
    sigma = None if sigma_rad is None else math.degrees(sigma_rad)
    return f"{_measured(math.degrees(radians), sigma)}°"


def size(moved: Displacement | None) -> str:
    """Shift and turn of a displacement."""
    if moved is None:
        return "–"
    text = millimetres(moved.size_m, moved.sigma_m)
    if moved.rotation_rad is None:
        return text
    return f"{text}, {degrees(moved.rotation_rad, moved.rotation_sigma_rad)}"


def signed_mm(values_m: tuple[float, float, float]) -> str:
    """``+1.178 +0.389 +0.040``."""
    return " ".join(f"{1e3 * value:+.3f}".replace("-", "−") for value in values_m)


def percent(share: float) -> str:
    """Per cent; a fraction between 0 and 1 is never shown as 0 or 100 %."""
    text = f"{100.0 * share:.1f}"
    if text == "100.0" and share < 1.0:
        return "> 99.9 %"
    if text == "0.0" and share > 0.0:
        return "< 0.1 %"
    return f"{text.removesuffix('.0')} %"


def count(number: int, one: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {one if number == 1 else one + 's'}"


def _measured(value: float, sigma: float | None) -> str:
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    digits = -math.floor(math.log10(COVERAGE * sigma))  # the spread's first digit is the last one shown
    return f"{value:.{min(max(digits, 0), 4)}f}"
