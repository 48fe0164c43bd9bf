"""The report in one paragraph of plain words."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from gripmon.analyse.affected import excess
from gripmon.analyse.content import AffectedRange, Displacement, Event, Limits, RecordingReport, size
from gripmon.analyse.events import MOTIONS
from gripmon.analyse.track import SECOND_NS
from gripmon.analyse.words import (
    clock_time,
    count,
    date,
    degrees,
    duration,
    listed,
    millimetres,
    often,
    percent,
    period,
    span,
)
from gripmon.model.coverage import too_few
from gripmon.model.records import AlertKind, Cause, CauseWeight
from gripmon.record.recordings import UNKNOWN

CAUSES: dict[str, str] = {
    Cause.CAMERA_MOUNT: "the camera's mount moved",
    Cause.FINGER_BENT: "a finger was bent",
    Cause.JAW_OPENING: "the jaw's opening was wrong",
    Cause.LENS: "focal length or focus changed",
    Cause.VIEW_BLOCKED: "the view was blocked",
    Cause.IMAGE_BAD: "images were bad",
    Cause.CAMERA_REPLACED: "the camera was replaced",
    Cause.CAMERA_FROZEN: "the camera was frozen",
    Cause.CLOCK: "clock or frame rate were wrong",
    Cause.PLANE_MOVED: "the plane under the laser moved",
    Cause.LASER_MOVED: "the laser pointer moved on the arm",
    Cause.NO_CAMERA: "there was no camera",
    Cause.TOO_SLOW: "the monitor was too slow for the camera",
    Cause.UNKNOWN: "cause unknown",
}
_MAX_SHOWN = 3
_ACCEPTERS = ("monitor", "operator")


def cause_words(event: Event) -> str:
    """``the camera's mount moved (99.8 %)``."""
    if event.cause == Cause.FINGER_BENT and event.part:
        text = f"the {event.part} finger was bent"
    else:
        text = _cause(event.cause, event.part)
    if event.cause == Cause.UNKNOWN or event.cause_probability is None:
        return text
    return f"{text} ({percent(event.cause_probability)})"


def weighed(cause: CauseWeight) -> str:
    """``a finger was bent (left): 3 %``."""
    return f"{_cause(cause.cause, cause.part)}: {percent(cause.probability)}"


def _cause(name: str, part: str | None) -> str:
    text = CAUSES.get(name, str(name).replace("_", " "))
    return f"{text} ({part})" if part else text


def paragraph(report: RecordingReport) -> str:
    """When the camera moved, how far, why, whether it still is displaced, what is affected, what was lost."""
    if not report.running.frames:
        return f"{report.robot} / {report.camera}: no frame could be read, so nothing is known about its camera."
    motions = [event for event in report.events if event.kind in MOTIONS]
    maybe = not motions and _explained_by_backgrounds(report)
    parts = [missing(report), _motions(report, motions), _at_end(report, motions, maybe), _affected(report, maybe)]
    parts += [_lost(report), "" if maybe else _what_to_do(report)]
    return " ".join(part for part in parts if part)


def _explained_by_backgrounds(report: RecordingReport) -> bool:
    """Whether no displacement is larger than another background would make one look, nor turned past a limit."""
    largest = [a.largest for a in report.affected if a.what == "old_calibration" and a.largest is not None]
    off = [*largest, *([] if report.at_end is None else [report.at_end])]
    return report.missable_m is not None and all(
        each.size_m <= report.missable_m and excess(0.0, each.rotation_rad or 0.0, report.limits) < 1.0 for each in off
    )


def missing(report: RecordingReport) -> str:
    """What the reader must know before anything else: that frames are missing, or weren't measured; empty if none."""
    running = report.running
    dropped = min(running.monitor_dropped or 0, running.frames_dropped)
    parts = [
        too_few(
            running.frames - running.frames_refused,
            dropped=dropped,
            missing=running.frames_dropped - dropped,
            unmeasured=running.frames_refused,
        )
    ]
    if running.frames_dropped:
        share = percent(running.frames_dropped / (running.frames + running.frames_dropped))
        known = ((running.monitor_dropped, "the monitor"), (running.recording_dropped, "the recorder"))
        reasons = [f"{who} was too busy for {number}" for number, who in known if number]
        why = f" ({listed(reasons)})" if reasons else ""
        are = "is" if running.frames_dropped == 1 else "are"
        parts.append(f"{count(running.frames_dropped, 'frame')} ({share}) {are} missing{why}")
    return " ".join(f"{part[0].upper()}{part[1:]}." for part in parts if part)


def headline(report: RecordingReport) -> str:
    """The motions in a sentence, for one recording among several."""
    motions = [event for event in report.events if event.kind in MOTIONS]
    largest = max(motions, key=lambda e: e.moved.size_m if e.moved else 0.0)
    when = f"{date(largest.onset.stamp_ns)} {clock_time(largest.onset.stamp_ns)}"
    most = "" if len(motions) == 1 else ", farthest"
    text = f"{report.robot} / {report.camera} moved {often(len(motions))}{most} at {when}"
    text += f" by {size(largest.moved)}" if largest.moved else ""
    end = "" if report.at_end is None else f"; at the end its TCP is {millimetres(report.at_end.size_m)} off"
    return f"{text}: {cause_words(largest)}{end}."


def _motions(report: RecordingReport, motions: Sequence[Event]) -> str:
    who = f"he camera of {report.robot} / {report.camera}"
    when = period(report.start_ns, report.end_ns)
    if not motions:
        if report.last_measured_ns is None:
            return f"Whether t{who} moved isn't known: in no frame ({when}) could it be measured."
        if any(a.what == "old_calibration" for a in report.affected):
            return f"No motion of t{who} was reported ({when}), yet it was not always where its calibration has it."
        last_ns = report.last_measured_ns
        if last_ns <= report.start_ns:
            return f"Whether t{who} moved isn't known: it was measured once, at {clock_time(last_ns)}."
        until = "" if report.end_ns - last_ns <= SECOND_NS else f" until it was last measured, at {clock_time(last_ns)}"
        return f"T{who} did not move ({when}){until}: no motion was reported in {span(report.start_ns, last_ns)}."
    shown = sorted(motions, key=lambda e: -(e.moved.size_m if e.moved else 0.0))[:_MAX_SHOWN]
    shown.sort(key=lambda e: e.onset.stamp_ns)
    largest = " The largest:" if len(shown) < len(motions) else ""
    sentences = " ".join(_motion(event, i == 0) for i, event in enumerate(shown))
    return f"T{who} moved {often(len(motions))} ({when}).{largest} {sentences}"


def _motion(event: Event, first: bool) -> str:
    onset, step, when = event.onset, "it moved at once", f"at {clock_time(event.onset.stamp_ns)}"
    if onset.latest_ns - onset.earliest_ns > SECOND_NS // 2:
        step, when = "it moved", f"between {clock_time(onset.earliest_ns)} and {clock_time(onset.latest_ns)}"
    how = {AlertKind.STEP: step, AlertKind.CREEP: "it began to creep"}.get(AlertKind(event.kind), "it began to drift")
    start = f"{when.capitalize() if first else f'Then, {when}'} {how}"
    by = f", the TCP by {size(event.moved)}" if event.moved else ""
    within = f", most of it within {duration(event.moved_in_s)}" if event.moved_in_s else ""
    return f"{start}{by}{within}: {cause_words(event)}."


def _at_end(report: RecordingReport, motions: Sequence[Event], maybe: bool) -> str:
    off = report.at_end
    if off is None or (not motions and not any(a.what == "old_calibration" for a in report.affected)):
        return ""
    last = "" if report.last_measured_ns is None else clock_time(report.last_measured_ns)
    measured = f"when last measured, at {last}"
    if not _off(off, report.limits):
        return f"It has moved back: {measured}, the TCP was {millimetres(off.size_m, off.sigma_m)} from where it began."
    far = f"{millimetres(off.size_m, off.sigma_m)} and {degrees(off.rotation_rad, off.rotation_sigma_rad)}"
    verb = "may be" if maybe else "is still" if motions else "is"
    text = f"It {verb} displaced: {measured}, the TCP was {far} from where the calibration at the beginning has it"
    if maybe:
        assert report.missable_m is not None
        return f"{text}; by up to {millimetres(report.missable_m)} another background would look the same."
    now = report.at_end_against_reference
    if len(report.references) < 2 or now is None:
        return f"{text}, and there is no new reference."
    reference = report.references[-1]
    held = not _off(now, report.limits)
    accepted = f"accepted by the {reference.accepted_by}, " if reference.accepted_by in _ACCEPTERS else ""
    by = f"reference {reference.reference_id} ({accepted}in force from {clock_time(reference.in_force_ns)})"
    return f"{text}; the monitor goes by {by}, which {'holds' if held else 'does not hold either'}."


def _affected(report: RecordingReport, maybe: bool) -> str:
    old = [a for a in report.affected if a.what == "old_calibration"]
    if not old:
        return ""
    be = "may be" if maybe else "is"
    text = f"Work that relied on the initial calibration {be} affected {_times(old)}"
    stale = [a for a in report.affected if a.what == "stale_reference"]
    if stale:
        text += f"; work that relied on the reference then in force, {_times(stale)}"
    return text + "."


def _what_to_do(report: RecordingReport) -> str:
    """The commands that help where the calibration of the beginning didn't hold, or doesn't; else empty."""
    if not any(a.what == "old_calibration" for a in report.affected):
        return ""
    robot = "ROBOT" if report.robot == UNKNOWN else shlex.quote(report.robot)
    camera = "CAMERA" if report.camera == UNKNOWN else shlex.quote(report.camera)
    files = [Path(file) for file in report.files] or [Path("RECORDING")]
    recorded = shlex.quote(str(files[0] if len(files) == 1 else files[0].parent))
    back = f"put the camera back (gripmon watch --mount --robot {robot} --camera {camera}; docs/howto/put_back.md)"
    renew = f"measure a new reference where it is (gripmon send recalibrate --robot {robot} --camera {camera})"
    correct = f"correct what was recorded (gripmon correct {recorded} --out corrected.jsonl)"
    if not _off(report.at_end, report.limits):
        return f"What to do: {correct}."
    held = not _off(report.at_end_against_reference, report.limits)
    return f"What to do: {back}, or {'use the new reference' if held else renew}; {correct}."


def _off(displacement: Displacement | None, limits: Limits) -> bool:
    return displacement is not None and excess(displacement.size_m, displacement.rotation_rad or 0.0, limits) >= 1.0


def _times(ranges: Sequence[AffectedRange]) -> str:
    worst = sorted(ranges, key=lambda a: a.start_ns - a.end_ns)[:_MAX_SHOWN]
    worst.sort(key=lambda a: a.start_ns)
    texts = []
    for each in worst:
        end = "the end of the recording" if each.ended_by == "end_of_recording" else clock_time(each.end_ns)
        off = f", by up to {millimetres(each.largest.size_m)}" if each.largest else ""
        texts.append(f"from {clock_time(each.start_ns)} to {end} ({span(each.start_ns, each.end_ns)}{off})")
    more = f" and in {count(len(ranges) - len(worst), 'shorter time')}" if len(ranges) > len(worst) else ""
    return f"{listed(texts)}{more}"


def lasting_s(report: RecordingReport, what: str) -> float:
    """How long, in all."""
    return sum(1e-9 * (a.end_ns - a.start_ns) for a in report.affected if a.what == what)


def _lost(report: RecordingReport) -> str:
    running = report.running
    unknown_s, suspect_s = lasting_s(report, "unknown"), lasting_s(report, "suspect")
    parts = [f"for {duration(unknown_s)} there was no transform"] if unknown_s else []
    parts += [f"for {duration(suspect_s)} it was only suspect"] if suspect_s else []
    if running.gaps:
        parts.append(f"{count(running.gaps, 'pause')} without frames, the longest {duration(running.longest_gap_s)}")
    if parts:
        return f"Lost: {listed(parts)}."
    whole = [share.name for share in running.verdicts] == ["valid"] and not running.frames_dropped
    return "Nothing was lost: every frame has a valid transform." if whole else ""
