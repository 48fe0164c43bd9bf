"""Recordings -> reports; how the monitor ran: rates, latency, noise, fractions of verdicts and states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.analyse.affected import integrity_of, limits_of, motion_ranges, runs_of_equal, verdict_ranges
from gripmon.analyse.content import (
    CommandEntry,
    Displacement,
    Event,
    Noise,
    RecordingReport,
    ReferenceEntry,
    Report,
    Running,
    Share,
    Slice,
    Stretch,
    count,
)
from gripmon.analyse.events import MOTIONS, alert_events, histories_of, pauses_of, reference_changes
from gripmon.analyse.motions import change_points_of, motions_of, robust_sigma
from gripmon.analyse.summary import headline, paragraph
from gripmon.analyse.track import SECOND_NS, Clock, Track, curves_of, displacement, make_track, straightened
from gripmon.model.geometry import from_record, perturbation_between, to_vector
from gripmon.model.records import AlertKind, ReferenceRecord, StateRecord, Verdict
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable

_END_FRAMES = 15
_OVERLAY_FRAMES = 6
_SEEN = (
    *MOTIONS, AlertKind.VIBRATION, AlertKind.GRIPPER, AlertKind.LENS, AlertKind.LOST, AlertKind.OCCLUDED,
    AlertKind.IMAGE, AlertKind.STREAM,
)  # fmt: skip
"""Kinds of events for which pictures may be instructive."""


@dataclass(frozen=True, slots=True)
class AnalysedRecording:
    """A recording and its report."""

    source: Recording
    report: RecordingReport


def build(
    sources: Sequence[Recording],
    faults: Sequence[str] = (),
    affected_m: float | None = None,
    affected_rad: float | None = None,
) -> tuple[Report, tuple[AnalysedRecording, ...]]:
    """The report on recordings, in order of robot and time; ``faults``: what could not be read at all.

    ``affected_m`` and ``affected_rad``: from where on work counts as affected; None: the limits for a warning.
    """
    analysed = [_analysed(source, affected_m, affected_rad) for source in sources]
    analysed.sort(key=lambda a: (a.report.robot, a.report.camera, a.report.start_ns))
    reports = tuple(a.report for a in analysed)
    return Report(_summary(reports), __version__, reports, tuple(faults)), tuple(analysed)


def _analysed(source: Recording, affected_m: float | None, affected_rad: float | None) -> AnalysedRecording:
    table, meta = source.frames, source.meta
    clock, clock_faults = straightened(table.seq, table.stamp_ns)
    limits = limits_of(source, affected_m, affected_rad)
    start = None if source.configuration is None else source.configuration.start
    track = make_track(table, source.references, None if start is None else start.reference_error)
    track = replace(track, stamp_ns=clock.stamp_ns)
    keys = _keys(source)
    in_force_ns = {key: int(clock.stamp_ns[i]) for key, i in keys.items()}
    histories = histories_of(source.alerts, clock)
    alerted_ns = [one.stamp_ns for history in histories if history.is_motion for one in history.alerts]
    points = change_points_of(source, track, alerted_ns, limits)
    motions = motions_of(track, histories, points, limits)
    events = [*motions, *alert_events(histories), *pauses_of(clock)]
    events += reference_changes(events, source.references, in_force_ns)
    affected = motion_ranges(track, list(keys), motions, limits)
    affected += verdict_ranges(track, table.VERDICTS, table.verdict, list(keys))
    last = np.flatnonzero(track.measured)[-_END_FRAMES:]
    dropped = _dropped(source)
    report = RecordingReport(
        robot=source.robot,
        camera=source.camera,
        gripper="" if meta is None else meta.gripper,
        recording_id=source.recording_id,
        version="" if meta is None else meta.version,
        files=tuple(str(path) for path in source.files),
        start_ns=int(clock.stamp_ns[0]) if len(track) else 0,
        end_ns=int(clock.stamp_ns[-1]) if len(track) else 0,
        summary="",
        limits=limits,
        at_end=track.displacement(track.against_first, last),
        at_end_against_reference=track.displacement(track.against_reference, last),
        last_measured_ns=int(clock.stamp_ns[last[-1]]) if last.size else None,
        events=_numbered(events, source, track),
        affected=tuple(sorted(affected, key=lambda a: (a.start_ns, a.what))),
        running=_running(table, clock, track, source.states, dropped),
        curves=curves_of(table, track, [event.onset.stamp_ns for event in motions]),
        references=tuple(_references(source, in_force_ns)),
        commands=tuple(
            CommandEntry(clock.of(c.seq, c.stamp_ns), c.name, c.argument, c.done, c.text) for c in source.commands
        ),
        integrity=integrity_of(table, limits),
        faults=(*(fault for fault in source.faults if fault not in dropped), *clock_faults),
    )
    return AnalysedRecording(source, msgspec.structs.replace(report, summary=paragraph(report)))


def _keys(source: Recording) -> dict[tuple[str, int], int]:
    """Id and revision of every reference that frames name, with the index of its first frame, in order."""
    table = source.frames
    pairs = np.stack([table.reference.astype(np.int64), table.revision], axis=1)
    distinct, first = np.unique(pairs, axis=0, return_index=True) if len(table) else (pairs, np.empty(0, int))
    order = np.argsort(first)
    return {(table.reference_ids[int(distinct[i, 0])], int(distinct[i, 1])): int(first[i]) for i in order}


def _references(source: Recording, in_force_ns: dict[tuple[str, int], int]) -> list[ReferenceEntry]:
    known = {(r.reference_id, r.revision): r for r in source.references}
    out: list[ReferenceEntry] = []
    before: ReferenceRecord | None = None
    for key, stamp_ns in in_force_ns.items():
        record = known.get(key)
        if record is None:
            out.append(ReferenceEntry(*key, stamp_ns, "not recorded", "not recorded", "unknown", None))
            continue
        step = None if before is None else _step(before, record)
        out.append(ReferenceEntry(*key, stamp_ns, record.origin, record.accepted_by, record.cause, step))
        before = record
    return out


def _step(before: ReferenceRecord, after: ReferenceRecord) -> Displacement:
    vector = perturbation_between(from_record(before.cam_T_grip), from_record(after.cam_T_grip))
    variances = [np.reshape(r.covariance, (6, 6)).diagonal() for r in (before, after)]
    return displacement(vector, np.sqrt(np.maximum(variances[0] + variances[1], 0.0)))


def _numbered(events: Sequence[Event], source: Recording, track: Track) -> tuple[Event, ...]:
    ordered = sorted(events, key=lambda e: (e.onset.stamp_ns, e.noticed_ns or 0))
    images = np.flatnonzero(np.isin(track.seq, np.asarray(source.image_seqs, np.int64)))
    return tuple(
        msgspec.structs.replace(event, number=i, **_picture_seqs(event, source, track, images))
        for i, event in enumerate(ordered, 1)
    )


def _picture_seqs(event: Event, source: Recording, track: Track, images: NDArray[np.intp]) -> dict[str, int]:
    """The last picture before it began, preferably with the gripper measured; the first one that shows it, of a slow
    motion with half of the way; and the first valid one after it, if it is over.  All of them differ.
    """
    if event.kind not in _SEEN:
        return {}
    table, stamps_ns = source.frames, track.stamp_ns[images]
    motion = event.kind in MOTIONS
    before = images[stamps_ns <= event.onset.earliest_ns] if motion else images[stamps_ns < event.onset.stamp_ns]
    begun_ns = _half_way_ns(event, track) if motion else event.noticed_ns or event.onset.stamp_ns
    over_ns = max(event.onset.latest_ns, event.end_ns or 0) if motion else event.end_ns
    at = images[(stamps_ns >= begun_ns) & (stamps_ns > event.onset.earliest_ns)]
    after = images[stamps_ns >= (np.iinfo(np.int64).max if over_ns is None else over_ns)]
    valid = table.verdict[after] == table.VERDICTS.index(Verdict.VALID)
    found: dict[str, int] = {}
    for name, choices in (
        ("before_seq", (before[track.measured[before]][::-1], before[::-1])),
        ("at_seq", (at,)),
        ("after_seq", (after[valid], after[track.measured[after]], after if motion else after[:0])),
    ):
        chosen = next((choice for choice in choices if choice.size), None)
        if chosen is not None:
            found[name] = _with_overlay(source, track.seq[chosen])
    for name in ("after_seq", "before_seq"):
        if found.get("at_seq") == found.get(name):
            found.pop("at_seq", None)
    return found


def _half_way_ns(event: Event, track: Track) -> int:
    """When half of a motion's way was behind it: at once, for a step."""
    onset_ns = event.onset.stamp_ns
    if event.kind == AlertKind.STEP or event.moved is None or event.end_ns is None:
        return onset_ns
    during = np.flatnonzero(track.measured & (track.stamp_ns >= onset_ns) & (track.stamp_ns <= event.end_ns))
    way = np.array(event.moved.tcp_shift_m)
    if not during.size or not way.any():
        return onset_ns
    along = (track.against_first[during, :3] - track.against_first[during[0], :3]) @ way
    beyond = np.flatnonzero(along >= 0.5 * float(way @ way))
    return int(track.stamp_ns[during[beyond[0]]]) if beyond.size else onset_ns


def _with_overlay(source: Recording, seqs: NDArray[np.int64]) -> int:
    """The first of some frames whose picture has an overlay, which not all pictures of an alert have."""
    drawn = np.isin(seqs[:_OVERLAY_FRAMES], source.overlay_seqs)
    return int(seqs[np.argmax(drawn)])


def _summary(reports: Sequence[RecordingReport]) -> str:
    """One paragraph; for several recordings one sentence for each whose camera moved."""
    if len(reports) == 1:
        return reports[0].summary
    robots = len({(r.robot, r.camera) for r in reports})
    moved = [r for r in reports if any(e.kind in MOTIONS for e in r.events)]
    which = f"{count(len(reports), 'recording')} of {count(robots, 'camera')}"
    head = f"{which}; the camera moved in {len(moved) or 'none'} of them."
    return " ".join([head, *(headline(r) for r in moved)])


_FEWEST_FRAMES = 30  # of an estimate of noise, or of a slice
_SLICES = 120
_MOST_STRETCHES = 2000  # of a history
_NEIGHBOURS_NS = SECOND_NS // 2


def _dropped(source: Recording) -> tuple[str, ...]:
    """The faults about frames that the monitor or its recorder dropped for lack of time, if the files are undamaged."""
    seq = source.frames.seq
    missing = int(seq[-1] - seq[0]) + 1 - len(seq) if len(seq) else 0
    by_choice = sum(
        max((getattr(state, name) for state in source.states), default=0)
        for name in ("frames_dropped", "recording_dropped")
    )
    whole = set(source.faults) <= set(source.gaps)
    return tuple(source.gaps) if whole or missing <= by_choice else ()


def _running(
    table: FrameTable, clock: Clock, track: Track, states: Sequence[StateRecord], dropped: tuple[str, ...]
) -> Running:
    """How the monitor ran; ``states`` contain how many frames were dropped, ``dropped`` where."""
    steps_s = 1e-9 * np.diff(clock.stamp_ns)
    latency_s = 1e-9 * table.latency_ns[table.latency_ns > 0]
    pauses_s = steps_s[steps_s > 1.0]
    return Running(
        frames=len(table),
        frames_dropped=int(table.seq[-1] - table.seq[0]) + 1 - len(table) if len(table) else 0,
        dropped=dropped,
        frames_refused=int(table.refused.sum()),
        monitor_dropped=max((s.frames_dropped for s in states), default=None),
        recording_dropped=max((s.recording_dropped for s in states), default=None),
        frames_per_s=float(1.0 / np.median(steps_s)) if steps_s.size and np.median(steps_s) > 0.0 else None,
        gaps=len(pauses_s),
        longest_gap_s=float(pauses_s.max(initial=0.0)),
        latency_median_s=float(np.median(latency_s)) if latency_s.size else None,
        latency_p99_s=float(np.percentile(latency_s, 99.0)) if latency_s.size else None,
        noise=_noise(table, track),
        verdicts=_shares(table.VERDICTS, table.verdict),
        states=_shares(table.STATES, table.state),
        state_history=_history(table.STATES, table.state, clock),
        verdict_history=_history(table.VERDICTS, table.verdict, clock),
        slices=_slices(table, clock),
    )


def _noise(table: FrameTable, track: Track) -> Noise | None:
    """Noise between successive frames; a motion affects few of the differences, which the median ignores."""
    pairs = np.flatnonzero(track.measured[1:] & track.measured[:-1] & (np.diff(track.stamp_ns) < _NEIGHBOURS_NS))
    valid = table.verdict == table.VERDICTS.index("valid")
    pairs = pairs[valid[pairs] & valid[pairs + 1]]
    if len(pairs) < _FEWEST_FRAMES:
        return None
    sigma = robust_sigma(track.against_first[pairs + 1] - track.against_first[pairs]) / np.sqrt(2.0)
    claimed = np.median(track.sigma[pairs], axis=0)
    return Noise(to_vector(sigma[:3]), to_vector(sigma[3:]), to_vector(claimed[:3]), to_vector(claimed[3:]), len(pairs))


def _shares(names: Sequence[str], codes: NDArray[np.int8]) -> tuple[Share, ...]:
    counts = np.bincount(codes, minlength=len(names)).tolist() if len(codes) else [0] * len(names)
    total = max(len(codes), 1)
    return tuple(Share(name, n, n / total) for name, n in zip(names, counts, strict=True) if n)


def _slices(table: FrameTable, clock: Clock) -> tuple[Slice, ...]:
    if len(table) < 2 or clock.stamp_ns[-1] == clock.stamp_ns[0]:
        return ()
    number = max(min(_SLICES, len(table) // _FEWEST_FRAMES), 1)
    length_ns = int(clock.stamp_ns[-1] - clock.stamp_ns[0]) + 1
    # Relative to the first, since a float can't represent Unix nanoseconds exactly.
    edges = clock.stamp_ns[0] + np.linspace(0, length_ns, number + 1).astype(np.int64)
    edges[-1] = clock.stamp_ns[-1] + 1
    cuts = np.searchsorted(clock.stamp_ns, edges)
    codes = [table.VERDICTS.index(name) for name in ("valid", "suspect", "unknown")]
    out = []
    for i in range(number):
        part = slice(int(cuts[i]), int(cuts[i + 1]))
        if part.stop == part.start:
            continue
        verdicts = table.verdict[part]
        latency_s = 1e-9 * table.latency_ns[part][table.latency_ns[part] > 0]
        median, p99 = np.percentile(latency_s, (50.0, 99.0)).tolist() if latency_s.size else (None, None)
        valid, suspect, unknown = (float((verdicts == code).mean()) for code in codes)
        out.append(
            Slice(int(edges[i]), int(edges[i + 1]), part.stop - part.start, valid, suspect, unknown, median, p99)
        )
    return tuple(out)


def _history(names: Sequence[str], codes: NDArray[np.int8], clock: Clock) -> tuple[Stretch, ...]:
    """Successive stretches of equal names; a stretch ends where the next begins, or at a pause of frames."""
    if not len(codes):
        return ()
    pause = np.cumsum(np.concatenate([[0], np.diff(clock.stamp_ns) > SECOND_NS]))
    parts = runs_of_equal(codes.astype(np.int64) + 100 * pause)
    out = []
    for part in parts:
        follows = part.stop < len(codes) and pause[part.stop] == pause[part.start]
        end_ns = int(clock.stamp_ns[part.stop if follows else part.stop - 1])
        out.append(Stretch(names[int(codes[part.start])], int(clock.stamp_ns[part.start]), end_ns))
    if len(out) <= _MOST_STRETCHES:
        return tuple(out)
    # Only the longest are reported; the data themselves are in the recording.
    shortest = sorted((s.end_ns - s.start_ns for s in out), reverse=True)[_MOST_STRETCHES - 1]
    return tuple(s for s in out if s.end_ns - s.start_ns >= shortest)
