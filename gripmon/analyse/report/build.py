"""Recordings -> what is to be said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.analyse.report.affected import motion_ranges, verdict_ranges
from gripmon.analyse.report.content import (
    CommandEntry,
    Displacement,
    Event,
    RecordingReport,
    ReferenceEntry,
    Report,
    main_text,
)
from gripmon.analyse.report.formats import count
from gripmon.analyse.report.happenings import MOTIONS, happenings_of, lives_of, pauses_of, with_reference_changes
from gripmon.analyse.report.hindsight import look_back
from gripmon.analyse.report.limits import integrity_of, limits_of
from gripmon.analyse.report.motions import motions_of
from gripmon.analyse.report.running import dropped_of, running_of
from gripmon.analyse.report.track import Track, curves_of, displacement, make_track, straightened
from gripmon.analyse.report.words import headline, paragraph
from gripmon.model.records import AlertKind, ReferenceRecord, Verdict
from gripmon.record.read import Recording

_END_FRAMES = 15
_NEIGHBOURS = 6
_SEEN = (
    *MOTIONS, AlertKind.VIBRATION, AlertKind.GRIPPER, AlertKind.LENS, AlertKind.LOST, AlertKind.OCCLUDED,
    AlertKind.IMAGE, AlertKind.STREAM,
)  # fmt: skip
"""Kinds of events that pictures may show something of."""


@dataclass(frozen=True, slots=True)
class Told:
    """A recording and what is said of it."""

    source: Recording
    report: RecordingReport


def build(
    sources: Sequence[Recording],
    faults: Sequence[str] = (),
    affected_m: float | None = None,
    affected_rad: float | None = None,
) -> tuple[Report, tuple[Told, ...]]:
    """The report on some recordings, in order of robot and time; ``faults`` is what could not be read at all.

    ``affected_m`` and ``affected_rad``: what counts as affected; None: as much as is worth a warning.
    """
    told = [_tell(source, affected_m, affected_rad) for source in sources]
    told.sort(key=lambda t: (t.report.robot, t.report.camera, t.report.start_ns))
    reports = tuple(t.report for t in told)
    return Report(_summary(reports), __version__, reports, tuple(faults)), tuple(told)


def _tell(source: Recording, affected_m: float | None, affected_rad: float | None) -> Told:
    table = source.frames
    clock, clock_faults = straightened(table.seq, table.stamp_ns)
    limits = limits_of(main_text(source), affected_m, affected_rad)
    start = None if source.configuration is None else source.configuration.start
    track = make_track(table, source.references, None if start is None else start.reference_error)
    track = Track(**{name: getattr(track, name) for name in Track.__dataclass_fields__} | {"stamp_ns": clock.stamp_ns})
    keys = _keys(source)
    in_force_ns = {key: int(clock.stamp_ns[i]) for key, i in keys.items()}
    lives = lives_of(source.alerts, clock)
    hindsight = look_back(source, track, [s.stamp_ns for life in lives if life.is_motion for s in life.said], limits)
    motions = motions_of(track, lives, hindsight)
    motions += hindsight.unsaid(motions, limits)
    events = [*motions, *happenings_of(lives), *pauses_of(clock)]
    events = with_reference_changes(events, _ordered(source.references, in_force_ns), in_force_ns)
    affected = motion_ranges(track, list(keys), motions, limits)
    affected += verdict_ranges(track, table.VERDICTS, table.verdict, list(keys))
    meta = source.meta
    last = np.flatnonzero(track.measured)[-_END_FRAMES:]
    dropped = dropped_of(source)
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
        running=running_of(table, clock, track, source.states, dropped),
        curves=curves_of(table, track, [event.onset.stamp_ns for event in motions]),
        references=tuple(_references(source, in_force_ns)),
        commands=tuple(
            CommandEntry(clock.of(c.seq, c.stamp_ns), c.name, c.argument, c.done, c.text) for c in source.commands
        ),
        integrity=integrity_of(table, limits),
        faults=(*(fault for fault in source.faults if fault not in dropped), *clock_faults),
    )
    return Told(source, msgspec.structs.replace(report, summary=paragraph(report)))


def _keys(source: Recording) -> dict[tuple[str, int], int]:
    """Id and revision of every reference that frames name, with the index of the first such frame, in order."""
    table = source.frames
    pairs = np.stack([table.reference.astype(np.int64), table.revision], axis=1)
    distinct, first = np.unique(pairs, axis=0, return_index=True) if len(table) else (pairs, np.empty(0, int))
    order = np.argsort(first)
    return {(table.reference_ids[int(distinct[i, 0])], int(distinct[i, 1])): int(first[i]) for i in order}


def _ordered(references: Sequence[ReferenceRecord], in_force_ns: dict[tuple[str, int], int]) -> list[ReferenceRecord]:
    known = {(r.reference_id, r.revision): r for r in references}
    return [known[key] for key in in_force_ns if key in known]


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
    from gripmon.model.geometry import from_record, perturbation_between

    vector = perturbation_between(from_record(before.cam_T_grip), from_record(after.cam_T_grip))
    variances = [np.reshape(r.covariance, (6, 6)).diagonal() for r in (before, after)]
    return displacement(vector, np.sqrt(np.maximum(variances[0] + variances[1], 0.0)))


def _numbered(events: Sequence[Event], source: Recording, track: Track) -> tuple[Event, ...]:
    ordered = sorted(events, key=lambda e: (e.onset.stamp_ns, e.noticed_ns or 0))
    images = np.flatnonzero(np.isin(track.seq, np.asarray(source.image_seqs, np.int64)))
    return tuple(
        msgspec.structs.replace(event, number=i, **_pictures(event, source, track, images))
        for i, event in enumerate(ordered, 1)
    )


def _pictures(event: Event, source: Recording, track: Track, images: NDArray[np.intp]) -> dict[str, int]:
    """The last picture before it began, with the gripper seen if there is one; the first one in it; and the first
    believed one after it, if it is over.
    """
    if event.kind not in _SEEN:
        return {}
    table, stamps_ns = source.frames, track.stamp_ns[images]
    motion = event.kind in MOTIONS
    before = images[stamps_ns <= event.onset.earliest_ns] if motion else images[stamps_ns < event.onset.stamp_ns]
    begun_ns = event.onset.stamp_ns if motion else event.noticed_ns or event.onset.stamp_ns
    over_ns = max(event.onset.latest_ns, event.end_ns or 0) if motion else event.end_ns
    at = images[stamps_ns >= begun_ns]
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
    if found.get("at_seq") == found.get("after_seq"):
        found.pop("at_seq", None)
    return found


def _with_overlay(source: Recording, seqs: NDArray[np.int64]) -> int:
    """The first of some frames with a picture that shows what was measured; of an alert's own pictures not all do."""
    for seq in seqs[:_NEIGHBOURS].tolist():
        picture = source.picture(seq)
        if picture is not None and picture.predicted_edges:
            return int(seq)
    return int(seqs[0])


def _summary(reports: Sequence[RecordingReport]) -> str:
    """One paragraph for all: of several a sentence each for those whose camera moved."""
    if len(reports) == 1:
        return reports[0].summary
    robots = len({(r.robot, r.camera) for r in reports})
    moved = [r for r in reports if any(e.kind in MOTIONS for e in r.events)]
    which = f"{count(len(reports), 'recording')} of {count(robots, 'camera')}"
    head = f"{which}; the camera moved in {len(moved) or 'none'} of them."
    return " ".join([head, *(headline(r) for r in moved)])
