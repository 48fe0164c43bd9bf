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
``meta``, ``configuration``     what this file is and what the monitor ran with, static, JSON as all that follows
``reference``                   the one in force at the file's beginning, and each new one
``alert``                       alerts that are in no frame's record: the daemon's own
``command``, ``state``          commands that were carried out or refused; state messages
==============================  ====================================================================================
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import rerun as rr

from gripmon.recording import palette
from gripmon.recording.columns import Row, Sender
from gripmon.recording.events import EventWriter, Line
from gripmon.recording.overlay import OverlayWriter
from gripmon.recording.rig import RigWriter
from gripmon.recording.settings import RecordingSettings
from gripmon.recording.wire import Events, Scene, TraceNote
from gripmon.records import FrameRecord, Meta, ReferenceRecord, to_json


class RowWriter:
    """Writes rows into one file.  The constructor writes what is static."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        self._send = Sender(stream)
        self._events = EventWriter(self._send)
        self._overlay = OverlayWriter(self._send, scene)
        self._rig = RigWriter(self._send, scene)
        self._references: list[ReferenceRecord] = []
        self._reference_tcp_m: dict[tuple[str, int], tuple[float, float, float]] = {}
        self._log_static(scene)
        self._log_origin(scene, file_number)

    def write(self, rows: Sequence[Row], events: Events) -> None:
        """Send everything that was gathered since the last call.

        References wait for a frame: their own stamp may lie long before the recording, or be no time at all.
        """
        for r in events.references:
            self._reference_tcp_m[r.reference_id, r.revision] = r.cam_T_grip.translation_m
        self._references += events.references
        lines: list[Line] = []
        if rows:
            lines = [self._write_reference(r, _first_with(r, rows)) for r in self._references]
            self._references.clear()
            self._curves(rows)
            self._records(rows)
            self._overlay.write(rows)
            self._rig.write(rows)
        self._events.write(rows, events, lines)

    def write_pictures(self, rows: Sequence[Row]) -> None:
        """Send the pictures of frames that were written before without them."""
        if rows:
            self._picture_curves(rows)
            self._overlay.write_late(rows)

    def _write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> Line:
        self._rig.write_reference(reference, first)
        whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
        self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
        return Line(first.stamp_ns, first.seq, "INFO", f"reference {reference.reference_id} ({reference.origin})")

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
        static("about", rr.TextDocument(_about(scene), media_type="text/markdown"))

    def _log_origin(self, scene: Scene, file_number: int) -> None:
        """What this file is, and what the monitor ran with: each file stands alone."""
        meta = Meta(
            name=scene.name,
            recording_id=scene.recording_id,
            robot=scene.robot,
            camera=scene.camera,
            gripper=scene.gripper,
            version=scene.version,
            file_number=file_number,
            started_ns=time.time_ns(),
            image_policy=image_policy(scene.settings),
            has_truth=scene.has_truth,
        )
        self._send.static("meta", rr.AnyValues(json=to_json(meta).decode()))
        if scene.configuration is not None:
            self._send.static("configuration", rr.AnyValues(json=to_json(scene.configuration).decode()))

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
        self._picture_curves(rows)

    def _picture_curves(self, rows: Sequence[Row]) -> None:
        send = self._send
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


def image_policy(settings: RecordingSettings) -> str:
    """Which images are kept, and how, in words."""
    kind = "PNG" if settings.image_format == "png" else f"JPEG {settings.jpeg_quality} %"
    rate = f"{settings.image_rate_hz:g} images/s" if settings.image_rate_hz > 0.0 else "no images but"
    every = f", of every {settings.image_every}. frame" if settings.image_every > 0 else ""
    around = (
        f", all within {settings.around_alert_s:g} s of a warning or error" if settings.around_alert_s > 0.0 else ""
    )
    return f"{kind}, {rate}{every}, one at every alert and change{around}"


def _about(scene: Scene) -> str:
    return (
        f"# {scene.robot} / {scene.camera}\n\ngripmon {scene.version}, gripper `{scene.gripper}`, "
        f"{scene.width_px} x {scene.height_px} px\n\nLens: `{scene.lens}`\n\n"
        "Image: predicted edges blue, edge points green where the fit believed them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one.\n"
    )
