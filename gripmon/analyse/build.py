"""Recordings -> reports."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.analyse.affected import integrity_of, limits_of, motion_ranges, verdict_ranges
from gripmon.analyse.content import CommandEntry, Displacement, Event, RecordingReport, ReferenceEntry, Report
from gripmon.analyse.corrected import correct_table
from gripmon.analyse.correction import ChangePoint
from gripmon.analyse.events import MOTIONS, alert_event, histories_of, pauses_of, reference_changes
from gripmon.analyse.motions import motions_of
from gripmon.analyse.pictures import picture_seqs
from gripmon.analyse.running import dropped_of, running_of
from gripmon.analyse.summary import headline, missing, paragraph
from gripmon.analyse.track import SECOND_NS, Track, curves_of, displacement, make_track
from gripmon.analyse.words import count
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import ReferenceRecord
from gripmon.record.recordings import Recording

_END_FRAMES = 15


@dataclasses.dataclass(frozen=True, slots=True)
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
    analysed = [AnalysedRecording(source, _analysed(source, affected_m, affected_rad)) for source in sources]
    analysed.sort(key=lambda a: (a.report.robot, a.report.camera, a.report.start_ns))
    reports = tuple(a.report for a in analysed)
    return Report(_summary(reports), __version__, reports, tuple(faults)), tuple(analysed)


def _analysed(source: Recording, affected_m: float | None, affected_rad: float | None) -> RecordingReport:
    table, meta = source.frames, source.meta
    limits = limits_of(source, affected_m, affected_rad)
    start = None if source.configuration is None else source.configuration.start
    track = make_track(table, source.references, None if start is None else start.reference_error)
    histories = histories_of(source.alerts, track)
    points: tuple[ChangePoint, ...] = ()
    missable_m: float | None = None
    with contextlib.suppress(ValueError):  # too few frames were measured, or have a valid covariance
        found = correct_table(dataclasses.replace(table, stamp_ns=track.stamp_ns))
        points, missable_m = found.change_points, found.missable_m
    motions = motions_of(track, histories, points, limits)
    events = [*motions, *(alert_event(each) for each in histories if not each.is_motion), *pauses_of(track)]
    events += reference_changes(events, source.references, track)
    affected = [*motion_ranges(track, motions, limits), *verdict_ranges(track, table)]
    last = _last(track, motions)
    dropped = dropped_of(source)
    report = RecordingReport(
        robot=source.robot,
        camera=source.camera,
        gripper="" if meta is None else meta.gripper,
        recording_id=source.recording_id,
        version="" if meta is None else meta.version,
        files=tuple(str(path) for path in source.files),
        start_ns=int(track.stamp_ns[0]) if len(track) else 0,
        end_ns=int(track.stamp_ns[-1]) if len(track) else 0,
        summary="",
        limits=limits,
        at_end=track.displacement(track.against_first, last),
        at_end_against_reference=track.displacement(track.against_reference, _of_newest_reference(track, last)),
        last_measured_ns=int(track.stamp_ns[last[-1]]) if last.size else None,
        events=_numbered(events, source, track),
        affected=tuple(sorted(affected, key=lambda a: (a.start_ns, a.what))),
        running=running_of(table, track, source.states, dropped),
        curves=curves_of(table, track, [event.onset.stamp_ns for event in motions]),
        references=_references(source.references, track),
        commands=tuple(
            CommandEntry(track.time_of(c.seq, c.stamp_ns), c.name, c.argument, c.done, c.text) for c in source.commands
        ),
        missable_m=None if missable_m is None else max(missable_m, limits.affected_m),  # smaller ones aren't told
        integrity=integrity_of(table, limits),
        faults=(*(fault for fault in source.faults if fault not in dropped), *track.faults),
    )
    return msgspec.structs.replace(report, summary=paragraph(report))


def _of_newest_reference(track: Track, frames: NDArray[np.intp]) -> NDArray[np.intp]:
    """Those of some frames (indices) that are measured against the same reference as the last one."""
    return frames[track.reference[frames] == track.reference[frames[-1]]] if frames.size else frames


def _last(track: Track, motions: Sequence[Event]) -> NDArray[np.intp]:
    """The measured frames that show where the TCP was at the end: of the last second, and none from before a motion."""
    last = np.flatnonzero(track.measured)[-_END_FRAMES:]
    if not last.size:
        return last
    since_ns = max([int(track.stamp_ns[last[-1]]) - SECOND_NS, *(event.onset.stamp_ns for event in motions)])
    shown = last[track.stamp_ns[last] >= since_ns]
    return shown if shown.size else last


def _numbered(events: Sequence[Event], source: Recording, track: Track) -> tuple[Event, ...]:
    ordered = sorted(events, key=lambda e: (e.onset.stamp_ns, e.noticed_ns or 0))
    images = np.flatnonzero(np.isin(track.seq, source.image_seqs))
    return tuple(
        msgspec.structs.replace(event, number=i, **picture_seqs(event, source, track, images))
        for i, event in enumerate(ordered, 1)
    )


def _references(references: Sequence[ReferenceRecord], track: Track) -> tuple[ReferenceEntry, ...]:
    known = {(r.reference_id, r.revision): r for r in references}
    out: list[ReferenceEntry] = []
    before: ReferenceRecord | None = None
    for key, stamp_ns in track.in_force_ns().items():
        if (record := known.get(key)) is None:
            out.append(ReferenceEntry(*key, stamp_ns, "not recorded", "not recorded", "unknown", None))
            continue
        step = None if before is None else _step(before, record)
        out.append(ReferenceEntry(*key, stamp_ns, record.origin, record.accepted_by, record.cause, step))
        before = record
    return tuple(out)


def _step(before: ReferenceRecord, after: ReferenceRecord) -> Displacement:
    vector = perturbation_between(from_record(before.cam_T_grip), from_record(after.cam_T_grip))
    variances = [np.reshape(r.covariance, (6, 6)).diagonal() for r in (before, after)]
    return displacement(vector, np.sqrt(np.maximum(variances[0] + variances[1], 0.0)))


def _summary(reports: Sequence[RecordingReport]) -> str:
    """One paragraph; for several recordings a sentence for each whose frames are missing or whose camera moved."""
    if len(reports) == 1:
        return reports[0].summary
    few = [f"{r.robot} / {r.camera}: {text}" for r in reports if (text := missing(r))]
    robots = len({(r.robot, r.camera) for r in reports})
    moved = [r for r in reports if any(e.kind in MOTIONS for e in r.events)]
    which = f"{count(len(reports), 'recording')} of {count(robots, 'camera')}"
    return " ".join([*few, f"{which}; the camera moved in {len(moved) or 'none'} of them.", *map(headline, moved)])
