"""Frames -> columns of a rerun recording: which entity holds what.

Timelines: ``capture_time`` (the frame's ``stamp_ns``) and ``frame`` (its ``seq``).  A whole batch of frames becomes one
chunk an entity, which costs a tenth of logging frame by frame.

==============================  ====================================================================================
``rig``                         camera axes (x right, y down, z forward), metres
``rig/camera``                  pinhole without lens distortion;  ``image`` and its overlay in distorted pixels
``rig/gripper``                 ``cam_T_grip`` of the frame, below it the fingers at the frame's jaw opening
``rig/reference``               ``cam_T_grip`` of the reference
``drift/…``                     TCP shift (mm, camera axes) with its standard deviation, ``d`` (mm), ``delta`` (degrees)
``quality/…``, ``timing/…``     residual, counts of points and corners, latency
``jaw/reported_m``              the opening that came with the frame (the record's is what the monitor believed)
``image/…``                     statistics of the recorded images
``status/state``, ``verdict``   as state changes;  ``events`` alerts and changes as text
``record``                      the frame's whole record, one JSON line as ``replay`` writes it, to the last digit
==============================  ====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from gripmon.recording import palette
from gripmon.recording.overlay import OverlayWriter
from gripmon.recording.rig import RigWriter
from gripmon.recording.wire import Scene, TraceNote
from gripmon.records import (
    Alert,
    AlertEvent,
    AlertRecord,
    FrameRecord,
    ReferenceRecord,
    Severity,
    State,
    Verdict,
    to_json,
)

_LONGEST_SILENCE_NS = 86_400_000_000_000  # between a frame and an alert that belongs to no frame: a day
_LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded image and what was measured on it (grey values 0..255)."""

    blob: bytes
    media_type: str
    mean_grey: float
    contrast_grey: float
    saturated_percent: float
    sharpness: float


@dataclass(frozen=True, slots=True)
class Row:
    record: FrameRecord
    picture: Picture | None
    trace: TraceNote | None
    truth_tcp_m: tuple[float, float, float] | None
    jaw_reported_m: float | None = None


@dataclass(frozen=True, slots=True)
class Event:
    stamp_ns: int
    seq: int
    level: str
    text: str


class Sender:
    """Sends columns with both timelines."""

    def __init__(self, stream: rr.RecordingStream):
        self.stream = stream

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        for archetype in archetypes:
            self.stream.log(path, archetype, static=True)

    def columns(self, path: str, stamps_ns: list[int], seqs: list[int], columns: rr.ComponentColumnList) -> None:
        times = np.array(stamps_ns, np.int64).astype("datetime64[ns]")
        indexes = [rr.TimeColumn("capture_time", timestamp=times), rr.TimeColumn("frame", sequence=seqs)]
        self.stream.send_columns(path, indexes, columns)

    def frames(self, path: str, rows: Sequence[Row], columns: rr.ComponentColumnList) -> None:
        self.columns(path, [r.record.stamp_ns for r in rows], [r.record.seq for r in rows], columns)

    def scalars(self, path: str, rows: Sequence[Row], values: Sequence[Sequence[float]]) -> None:
        """Several curves; a row without values leaves a gap in them."""
        flat = np.array([v for some in values for v in some], dtype=np.float64)
        self.frames(path, rows, rr.Scalars.columns(scalars=flat).partition([len(some) for some in values]))

    def curve(self, path: str, rows: Sequence[Row], values: Sequence[float | None]) -> None:
        """One curve; None leaves a gap in it."""
        self.scalars(path, rows, [() if value is None else (value,) for value in values])


class RowWriter:
    """Writes rows into one file.  The constructor writes what is static."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene):
        self._send = Sender(stream)
        self._overlay = OverlayWriter(self._send, scene)
        self._rig = RigWriter(self._send, scene)
        self._state = ""
        self._verdict = ""
        self._references: list[ReferenceRecord] = []
        self._newest_stamp_ns: int | None = None
        self._reference_tcp_m: dict[tuple[str, int], tuple[float, float, float]] = {}
        self._log_static(scene)

    def write(self, rows: Sequence[Row], alerts: Sequence[AlertRecord], references: Sequence[ReferenceRecord]) -> None:
        """Send everything that was gathered since the last call.

        References wait for a frame: their own stamp may lie long before the recording, or be no time at all.
        """
        for r in references:
            self._reference_tcp_m[r.reference_id, r.revision] = r.cam_T_grip.translation_m
        self._references += references
        events = [_event(self._on_frames_clock(a.stamp_ns), a.seq, a) for a in alerts]
        if rows:
            self._newest_stamp_ns = rows[-1].record.stamp_ns
            events += [self._write_reference(r, _first_with(r, rows)) for r in self._references]
            self._references.clear()
            events += self._status(rows)
            self._curves(rows)
            self._records(rows)
            self._overlay.write(rows)
            self._rig.write(rows)
        if events:
            columns = rr.TextLog.columns(text=[e.text for e in events], level=[e.level for e in events])
            self._send.columns("events", [e.stamp_ns for e in events], [e.seq for e in events], columns)

    def _on_frames_clock(self, stamp_ns: int) -> int:
        """Frames of old files have old stamps: among them an alert of today, which belongs to no frame, would stretch
        the timeline over years.
        """
        if self._newest_stamp_ns is None or abs(stamp_ns - self._newest_stamp_ns) < _LONGEST_SILENCE_NS:
            return stamp_ns
        return self._newest_stamp_ns

    def _write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> Event:
        self._rig.write_reference(reference, first)
        whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
        self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
        return Event(first.stamp_ns, first.seq, "INFO", f"reference {reference.reference_id} ({reference.origin})")

    def _log_static(self, scene: Scene) -> None:
        static = self._send.static
        x, y, z = palette.AXES
        names = ["x", "y", "z"]
        bands = [palette.faded(colour, 130) for colour in palette.AXES]
        truths = [palette.faded(colour, 90) for colour in palette.AXES]
        static("drift/tcp_shift_mm", rr.SeriesLines(names=names, colors=[x, y, z], widths=[2.0] * 3))
        static(
            "drift/tcp_shift_sigma_mm",
            rr.SeriesLines(names=["x-σ", "y-σ", "z-σ", "x+σ", "y+σ", "z+σ"], colors=bands * 2, widths=[0.7] * 6),
        )
        static("drift/truth_mm", rr.SeriesLines(names=[f"true {n}" for n in names], colors=truths, widths=[6.0] * 3))
        static("drift/error_mm", rr.SeriesLines(names=names, colors=[x, y, z], widths=[1.0] * 3))
        static("drift/d_mm", rr.SeriesLines(names="d (mm)", colors=palette.BUSY, widths=2.0))
        static("drift/delta_deg", rr.SeriesLines(names="δ (°)", colors=palette.DOUBTFUL, widths=2.0))
        static("quality/rms_px", rr.SeriesLines(names="rms (px)", colors=palette.BUSY, widths=1.5))
        static("status/state", _configuration(palette.STATES))
        static("status/verdict", _configuration(palette.VERDICTS))
        static("about", rr.TextDocument(_about(scene), media_type="text/markdown"))

    def _curves(self, rows: Sequence[Row]) -> None:
        send = self._send
        drifts = [r.record.drift for r in rows]
        shifts_mm = [_millimetres(None if d is None else d.tcp_shift_m) for d in drifts]
        send.scalars("drift/tcp_shift_mm", rows, shifts_mm)
        send.scalars("drift/tcp_shift_sigma_mm", rows, [_band_mm(r.record) for r in rows])
        send.curve("drift/d_mm", rows, [None if d is None else 1e3 * d.translation_m for d in drifts])
        send.curve("drift/delta_deg", rows, [None if d is None else math.degrees(d.rotation_rad) for d in drifts])
        if any(r.truth_tcp_m is not None for r in rows):
            truths_mm = [self._truth_mm(r) for r in rows]
            send.scalars("drift/truth_mm", rows, truths_mm)
            send.scalars("drift/error_mm", rows, list(map(_difference, shifts_mm, truths_mm)))
        send.curve("quality/rms_px", rows, [r.record.rms_px for r in rows])
        send.curve("quality/corners_used", rows, [float(sum(c.used for c in r.record.corners)) for r in rows])
        send.curve("jaw/reported_m", rows, [r.jaw_reported_m for r in rows])
        send.curve("timing/latency_us", rows, [1e-3 * r.record.latency_ns for r in rows])
        traced = [r for r in rows if r.trace is not None]
        if traced:
            send.scalars("quality/edge_points", traced, [_edge_point_counts(r.trace) for r in traced if r.trace])
        shown = [r for r in rows if r.picture is not None]
        pictures = [r.picture for r in shown if r.picture is not None]
        if pictures:
            send.curve("image/mean_grey", shown, [p.mean_grey for p in pictures])
            send.curve("image/contrast_grey", shown, [p.contrast_grey for p in pictures])
            send.curve("image/saturated_percent", shown, [p.saturated_percent for p in pictures])
            send.curve("image/sharpness", shown, [p.sharpness for p in pictures])

    def _truth_mm(self, row: Row) -> list[float]:
        """The true TCP against the one of the reference that the frame names."""
        reference_tcp_m = self._reference_tcp_m.get((row.record.reference_id, row.record.revision))
        if row.truth_tcp_m is None or reference_tcp_m is None:
            return []
        return [1e3 * (true - old) for true, old in zip(row.truth_tcp_m, reference_tcp_m, strict=True)]

    def _status(self, rows: Sequence[Row]) -> list[Event]:
        """State and verdict where they change, and what happened as text."""
        events = []
        for row in rows:
            record = row.record
            at = [record.stamp_ns], [record.seq]
            if record.state != self._state or record.verdict != self._verdict:
                before = f"{self._state} ({self._verdict}) → " if self._state else ""
                reason = f": {record.reason}" if record.reason else ""
                text = f"{before}{record.state} ({record.verdict}){reason}"
                events.append(Event(record.stamp_ns, record.seq, "INFO", text))
            if record.state != self._state:
                self._send.columns("status/state", *at, rr.StateChange.columns(state=[record.state]))
            if record.verdict != self._verdict:
                self._send.columns("status/verdict", *at, rr.StateChange.columns(state=[record.verdict]))
            self._state, self._verdict = record.state, record.verdict
            events += [_event(record.stamp_ns, record.seq, alert) for alert in record.alerts]
        return events

    def _records(self, rows: Sequence[Row]) -> None:
        lines = [to_json(row.record).decode() for row in rows]
        self._send.frames("record", rows, rr.AnyValues.columns(json=lines))


def _first_with(reference: ReferenceRecord, rows: Sequence[Row]) -> FrameRecord:
    """The first frame that names the reference; else the first of all."""
    key = (reference.reference_id, reference.revision)
    records = [row.record for row in rows]
    return next((r for r in records if (r.reference_id, r.revision) == key), records[0])


def _millimetres(metres: Sequence[float] | None) -> list[float]:
    return [1e3 * v for v in metres or ()]


def _difference(values: Sequence[float], others: Sequence[float]) -> list[float]:
    """Empty where either is unknown."""
    return [a - b for a, b in zip(values, others, strict=True)] if values and others else []


def _band_mm(record: FrameRecord) -> list[float]:
    """One standard deviation below and above the TCP's shift: x, y, z, x, y, z."""
    if record.drift is None or record.covariance is None:
        return []
    shift_m = record.drift.tcp_shift_m
    sigma_m = [math.sqrt(variance) for variance in record.covariance[:21:7]]
    return [1e3 * (v + sign * s) for sign in (-1.0, 1.0) for v, s in zip(shift_m, sigma_m, strict=True)]


def _edge_point_counts(trace: TraceNote) -> tuple[float, float]:
    used = np.frombuffer(trace.edge_used, np.uint8)
    return float(used.sum()), float(used.size - used.sum())


def _event(stamp_ns: int, seq: int, alert: Alert | AlertRecord) -> Event:
    event = "" if alert.event is AlertEvent.NOTED else f" {alert.event}"
    said = f"{alert.kind}{event} [{alert.cause}] {alert.text}"
    return Event(stamp_ns, seq, _LEVELS[alert.severity], f"{said} ({alert.alert_id})" if alert.alert_id else said)


def _configuration(colours: dict[State, palette.Colour] | dict[Verdict, palette.Colour]) -> rr.StateConfiguration:
    return rr.StateConfiguration(values=[str(value) for value in colours], colors=list(colours.values()))


def _about(scene: Scene) -> str:
    return (
        f"# {scene.robot} / {scene.camera}\n\ngripmon {scene.version}, gripper `{scene.gripper}`, "
        f"{scene.width_px} x {scene.height_px} px\n\nLens: `{scene.lens}`\n\n"
        "Image: predicted edges blue, edge points green where the fit believed them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one.\n"
    )
