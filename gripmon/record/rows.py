"""Frames -> columns of a rerun recording: which entity holds what.

Timelines: ``capture_time`` (the frame's ``stamp_ns``) and ``frame`` (its ``seq``).  A batch of frames becomes one chunk
per entity, which costs a tenth of logging frame by frame.

==================================  ================================================================================
``rig``                             camera axes (x right, y down, z forward), metres
``rig/camera``                      pinhole without lens distortion;  ``image`` and its overlay in distorted pixels
``rig/gripper``                     ``cam_T_grip`` of the frame, and below it the fingers at its jaw opening
``rig/reference``, ``smoothed``     ``cam_T_grip`` of the reference; the smoothed transform
``status/state``, ``verdict``       as state changes;  ``events`` alerts and changes as text
``record``                          the frame's whole record, one JSON line as ``replay`` writes it, to the last digit
``meta``, ``configuration``         about this file, and the monitor's configuration; static, JSON like all below
``reference``                       the reference in force when the file begins, and each new one
``alert``                           alerts that are in no frame's record, from the daemon
``command``, ``state``              commands that were carried out or refused; state messages
``drift/tcp_shift_mm``              against the reference: camera axes, and its length;  ``…_sigma_mm`` the band of one
                                    standard deviation, ``…_smoothed_mm`` that of the smoothed transform
``drift/d_mm``, ``delta_deg``       ``d`` and ``delta`` of equation (14)
``drift/limits_mm``, ``_deg``       limits of that shift and turn: warning; error and new reference (of ``d``)
``drift/noticed_mm``, ``_deg``      the interval within which a constant shift goes undetected: x, y, z; x, y, z
``drift/truth_mm``, ``error_mm``    where a simulator provides the truth
``drift/alerts/<severity>``         a mark at the shift's length where an alert is raised, noted or changes kind
``protection/level_mm``, ``_deg``   bounds on the errors of the TCP's position and of the rotation: what valid means
``protection/…``                    ``since_reference_…`` of the motion since the reference, ``absolute_…`` as measured
``protection/limit_mm``, ``_deg``   the alert limits that the bounds are compared with
``test/share``                      the drift test's largest statistic over its threshold;  ``test/alarm`` is 1
``transform``                       translation (m) and quaternion x, y, z, w, raw and smoothed
``sigma/…``                         standard deviations, raw and smoothed;  ``noise/…`` as learned from the stream
``residual/rms_px``                 of corners and of used edge points, relative to their predicted positions
``residual/corners_px``             each corner's distance;  ``residual/edge_points`` each point's of the overlay
``quality``, ``timing``, ``jaw``    counts of points and corners, latency, the opening reported with the frame
``image/…``                         statistics of the recorded images
==================================  ================================================================================
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.model.camera import LensSettings
from gripmon.model.gripper import Gripper
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    FrameRecord,
    Limits,
    ReferenceRecord,
    Severity,
    to_json,
)
from gripmon.record.columns import Line, Palette, Row, Sender, Writer, faded
from gripmon.record.recorder import Events, Scene, TraceNote, pairs
from gripmon.record.scene import OverlayWriter, RigWriter

_XYZ = ["x", "y", "z"]
_POSE = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"]
_LIMITS_PERIOD_NS = 2_000_000_000


class RowWriter(Writer):
    """Writes the frames of a wrist camera."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        assert scene.gripper is not None, "a wrist camera's"
        gripper = Gripper(scene.gripper)
        super().__init__(stream, scene, file_number, _about(scene.lens, gripper.name))
        self.corner_ids = gripper.corner_ids
        self._curves = CurveWriter(self._send, gripper.corner_ids)
        self._overlay = OverlayWriter(self._send, gripper.corner_ids, scene.lens.height_px)
        self._rig = RigWriter(self._send, scene, gripper)
        self._references: list[ReferenceRecord] = []

    def write(self, rows: Sequence[Row], events: Events) -> None:
        """Send everything since the last call.

        References wait for a frame: their own stamp may be long before the recording, or unset.
        """
        for r in events.references:
            self._curves.add_reference(r)
        self._references += events.references
        lines: list[Line] = []
        if rows:
            lines = [self._write_reference(r, _first_with(r, rows)) for r in self._references]
            self._references.clear()
            self._curves.write(rows)
            self._write_records(rows)
            self._overlay.write(rows)
            self._rig.write(rows)
        self._events.write(rows, events, lines)

    def repeat(self) -> None:
        super().repeat()
        self._rig.repeat()

    def write_pictures(self, rows: Sequence[Row]) -> None:
        if rows:
            self._curves.write_pictures(rows)
            self._overlay.write_late(rows)

    def finish(self) -> None:
        self._curves.finish()

    def _write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> Line:
        self._rig.write_reference(reference, first)
        whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
        self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
        return Line(first.stamp_ns, first.seq, "INFO", f"reference {reference.reference_id} ({reference.origin})")


def _first_with(reference: ReferenceRecord, rows: Sequence[Row]) -> FrameRecord:
    """The first frame that names the reference; else the first frame."""
    key = (reference.reference_id, reference.revision)
    records = [row.record for row in rows]
    return next((r for r in records if (r.reference_id, r.revision) == key), records[0])


def _about(lens: LensSettings, gripper: str) -> str:
    return (
        f"gripper `{gripper}`, {lens.width_px} x {lens.height_px} px\n\nLens: `{to_json(lens).decode()}`\n\n"
        "Image: predicted edges blue, edge points green where the fit used them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one."
    )


class CurveWriter:
    """Writes all numbers over time, with the limits that they are compared with, in mm and degrees."""

    def __init__(self, send: Sender, corner_ids: tuple[str, ...]):
        self._send = send
        self._reference_tcp_m: dict[tuple[str, int], tuple[float, float, float]] = {}
        self._open: dict[str, tuple[AlertKind, Severity]] = {}  # the open alerts
        self._newest: Row | None = None
        self._drawn_ns: int | None = None
        _log_styles(send, corner_ids)

    def add_reference(self, reference: ReferenceRecord) -> None:
        """A reference that drifts are measured from."""
        self._reference_tcp_m[reference.reference_id, reference.revision] = reference.cam_T_grip.translation_m

    def write(self, rows: Sequence[Row]) -> None:
        self._drift(rows)
        self._protection(rows)
        self._transforms(rows)
        self._test(rows)
        self._measurement(rows)
        self.write_pictures([row for row in rows if row.picture is not None])

    def write_pictures(self, shown: Sequence[Row]) -> None:
        """What belongs to pictures, which may be written later than the rest of their frames."""
        send, pictures = self._send, [r.picture for r in shown if r.picture is not None]
        if pictures:
            send.curve("image/mean_grey", shown, [p.mean_grey for p in pictures])
            send.curve("image/contrast_grey", shown, [p.contrast_grey for p in pictures])
            send.curve("image/saturated_percent", shown, [p.saturated_percent for p in pictures])
            send.curve("image/sharpness", shown, [p.sharpness for p in pictures])
        traced = [r for r in shown if r.trace is not None]
        sides = [_edge_residuals_px(r.trace) for r in traced if r.trace is not None]
        columns: list[rr.ComponentColumn] = []
        for i, name in enumerate(("used_px", "refused_px")):
            each = [side[i] for side in sides]
            if any(len(residuals) for residuals in each):  # rerun makes no column from nothing
                columns += rr.AnyValues.columns(True, **{name: np.concatenate(each)}).partition(
                    [len(one) for one in each]
                )
        if columns:
            send.frames("residual/edge_points", traced, rr.ComponentColumnList(columns))

    def _drift(self, rows: Sequence[Row]) -> None:
        send = self._send
        drifts = [r.record.drift for r in rows]
        shifts_mm = [[] if d is None else [1e3 * v for v in d.tcp_shift_m] for d in drifts]
        with_length_mm = [[*shift_mm, math.hypot(*shift_mm)] if shift_mm else [] for shift_mm in shifts_mm]
        send.scalars("drift/tcp_shift_mm", rows, with_length_mm)
        send.scalars("drift/tcp_shift_sigma_mm", rows, [_band_mm(r.record) for r in rows])
        smoothed = [None if (s := r.record.smoothed) is None else s.translation_m for r in rows]
        send.scalars("drift/tcp_shift_smoothed_mm", rows, list(map(self._shift_mm, rows, smoothed)))
        send.curve("drift/d_mm", rows, [None if d is None else 1e3 * d.translation_m for d in drifts])
        send.curve("drift/delta_deg", rows, [None if d is None else math.degrees(d.rotation_rad) for d in drifts])
        if any(r.truth_tcp_m is not None for r in rows):
            truths_mm = [self._shift_mm(r, r.truth_tcp_m) for r in rows]
            send.scalars("drift/truth_mm", rows, truths_mm)
            both = zip(shifts_mm, truths_mm, strict=True)
            send.scalars("drift/error_mm", rows, [np.subtract(a, b).tolist() if a and b else [] for a, b in both])
        news = [self._news(r.record) for r in rows]
        for severity in Severity:
            marked = [i for i, some in enumerate(news) if severity in some]
            if marked:
                # Without a drift the mark is on the axis.
                heights_mm = [with_length_mm[i][3] if with_length_mm[i] else 0.0 for i in marked]
                send.curve(f"drift/alerts/{severity}", [rows[i] for i in marked], heights_mm)

    def _protection(self, rows: Sequence[Row]) -> None:
        bounds = [r.record.protection for r in rows]
        if all(b is None for b in bounds):  # from a version without them; or nothing was measured
            return
        self._send.curve("protection/level_mm", rows, [None if b is None else 1e3 * b.position_m for b in bounds])
        degrees = [None if b is None else math.degrees(b.rotation_rad) for b in bounds]
        self._send.curve("protection/level_deg", rows, degrees)
        for name in ("since_reference", "absolute"):
            known = [getattr(r.record, name) for r in rows]
            self._send.curve(f"protection/{name}_mm", rows, [None if b is None else 1e3 * b.position_m for b in known])
            degrees = [None if b is None else math.degrees(b.rotation_rad) for b in known]
            self._send.curve(f"protection/{name}_deg", rows, degrees)

    def _news(self, record: FrameRecord) -> set[Severity]:
        """Severities of alerts that are raised, noted, or change kind or severity (a creep that ends in a step)."""
        news = set()
        for alert in record.alerts:
            if alert.event is AlertEvent.CLEARED:
                self._open.pop(alert.alert_id, None)
                continue
            if alert.event is not AlertEvent.UPDATED or self._open.get(alert.alert_id) != (alert.kind, alert.severity):
                news.add(alert.severity)
            if alert.alert_id:
                self._open[alert.alert_id] = alert.kind, alert.severity
        return news

    def _shift_mm(self, row: Row, tcp_m: tuple[float, float, float] | None) -> list[float]:
        """A TCP relative to that of the reference that the frame names; empty if either is unknown."""
        reference_tcp_m = self._reference_tcp_m.get((row.record.reference_id, row.record.revision))
        if tcp_m is None or reference_tcp_m is None:
            return []
        return [1e3 * (now - old) for now, old in zip(tcp_m, reference_tcp_m, strict=True)]

    def _transforms(self, rows: Sequence[Row]) -> None:
        poses, tcp_um, turns_deg = [], [], []
        for record in (row.record for row in rows):
            raw, smoothed = record.cam_T_grip, record.smoothed
            poses.append(_both(7, *([*t.translation_m, *t.rotation_xyzw] if t else [] for t in (raw, smoothed))))
            covariances = (record.covariance or (), () if smoothed is None else smoothed.covariance)
            sigmas = [[math.sqrt(variance) for variance in covariance[::7]] for covariance in covariances]
            tcp_um.append(_both(3, *([1e6 * v for v in sigma[:3]] for sigma in sigmas)))
            turns_deg.append(_both(3, *([math.degrees(v) for v in sigma[3:]] for sigma in sigmas)))
        self._send.scalars("transform", rows, poses)
        self._send.scalars("sigma/tcp_um", rows, tcp_um)
        self._send.scalars("sigma/rotation_deg", rows, turns_deg)

    def _test(self, rows: Sequence[Row]) -> None:
        self._send.curve("test/share", rows, [r.statistic_share for r in rows])
        judged = [r for r in rows if r.limits is not None]
        if not judged:
            return
        self._newest = judged[-1]
        # Slow changes need few points, and every chunk costs two kilobytes.
        if self._drawn_ns is None or not 0 <= judged[-1].record.stamp_ns - self._drawn_ns < _LIMITS_PERIOD_NS:
            self._draw_limits(judged[:1] + judged[-1:] if len(judged) > 1 else judged)

    def finish(self) -> None:
        """At the end of the file: extend the limit lines to its last frame."""
        if self._newest is not None and self._newest.record.stamp_ns != self._drawn_ns:
            self._draw_limits([self._newest])

    def _draw_limits(self, rows: Sequence[Row]) -> None:
        send, limits = self._send, [r.limits for r in rows if r.limits is not None]
        self._drawn_ns = rows[-1].record.stamp_ns
        send.curve("test/alarm", rows, [1.0] * len(rows))
        send.scalars("drift/limits_mm", rows, [(1e3 * each.warn_m, 1e3 * each.limit_m) for each in limits])
        degrees = [(math.degrees(each.warn_rad), math.degrees(each.limit_rad)) for each in limits]
        send.scalars("drift/limits_deg", rows, degrees)
        send.scalars("drift/noticed_mm", rows, [_noticed(each, slice(0, 3), 1e3) for each in limits])
        send.scalars("drift/noticed_deg", rows, [_noticed(each, slice(3, 6), 180.0 / math.pi) for each in limits])
        alert_limits = [(each.alert_limit_m, each.alert_limit_rad) for each in limits]
        if all(m is not None and rad is not None for m, rad in alert_limits):
            send.curve("protection/limit_mm", rows, [1e3 * (m or 0.0) for m, _ in alert_limits])
            send.curve("protection/limit_deg", rows, [math.degrees(rad or 0.0) for _, rad in alert_limits])
        scatters = [each.scatter or () for each in limits]
        send.scalars("noise/scatter_um", rows, [[1e6 * v for v in s[:3]] for s in scatters])
        send.scalars("noise/scatter_deg", rows, [list(map(math.degrees, s[3:])) for s in scatters])
        send.scalars("noise/average_share", rows, [each.average_share for each in limits])
        send.scalars("noise/average_walk_um", rows, [[1e6 * w for w in each.average_walk[:3]] for each in limits])

    def _measurement(self, rows: Sequence[Row]) -> None:
        send = self._send
        send.curve("quality/corners_used", rows, [float(sum(c.used for c in r.record.corners)) for r in rows])
        send.curve("jaw/reported_m", rows, [r.jaw_reported_m for r in rows])
        send.curve("timing/latency_us", rows, [1e-3 * r.record.latency_ns for r in rows])
        sides = [None if r.trace is None else _edge_residuals_px(r.trace) for r in rows]
        edges = [[] if side is None or not side[0].size else [_rms(side[0])] for side in sides]
        corners = [[] if r.record.rms_px is None else [r.record.rms_px] for r in rows]
        send.scalars("residual/rms_px", rows, list(map(functools.partial(_both, 1), corners, edges)))
        traced = [r for r in rows if r.trace is not None]
        if traced:
            corners_px = [_corner_residuals_px(r.record, r.trace) for r in traced if r.trace is not None]
            send.scalars("residual/corners_px", traced, corners_px)
            counts = [[float(used.size), float(refused.size)] for used, refused in filter(None, sides)]
            send.scalars("quality/edge_points", traced, counts)


def _log_styles(send: Sender, corner_ids: tuple[str, ...]) -> None:
    """Names, colours and widths of the curves."""
    axes, lines = list(Palette.AXES), send.lines
    pale, paler = ([faded(colour, alpha) for colour in axes] for alpha in (130, 90))

    both = [f"{axis}{side}" for side in ("-", "+") for axis in _XYZ]
    lines("drift/tcp_shift_mm", [*_XYZ, "length"], [*axes, Palette.WHOLE], 1.8)
    lines("drift/tcp_shift_sigma_mm", [f"{name}σ" for name in both], pale * 2, 0.7)
    lines("drift/tcp_shift_smoothed_mm", [f"{axis} smoothed" for axis in _XYZ], pale, 1.5)
    lines("drift/truth_mm", [f"true {axis}" for axis in _XYZ], paler, 6.0)
    lines("drift/error_mm", _XYZ, axes, 1.0)
    lines("drift/d_mm", "d", Palette.WHOLE, 1.5)
    lines("drift/delta_deg", "δ", Palette.WHOLE, 1.5)
    for unit in ("mm", "deg"):
        lines(f"drift/limits_{unit}", ["warning", "limit"], [Palette.DOUBTFUL, Palette.BAD], 1.5)
        lines(f"drift/noticed_{unit}", [f"{name} unnoticed" for name in both], pale * 2, 1.0)
        lines(f"protection/level_{unit}", "protection level", Palette.WHOLE, 1.5)
        lines(f"protection/since_reference_{unit}", "since the reference", faded(Palette.WHOLE, 130), 1.0)
        lines(f"protection/absolute_{unit}", "absolute", faded(Palette.WHOLE, 130), 1.0)
        lines(f"protection/limit_{unit}", "alert limit", Palette.BAD, 1.5)
    marks = {Severity.INFO: Palette.BUSY, Severity.WARNING: Palette.DOUBTFUL, Severity.ERROR: Palette.BAD}
    for severity, colour in marks.items():
        points = rr.SeriesPoints(names=f"alert: {severity}", colors=colour, markers="Diamond", marker_sizes=6.0)
        send.static(f"drift/alerts/{severity}", points)
    lines("test/share", "statistic / threshold", Palette.WHOLE, 1.5)
    lines("test/alarm", "alarm", Palette.BAD, 1.5)
    send.static("transform", rr.SeriesLines(names=[*_POSE, *(f"{name} smoothed" for name in _POSE)]))
    for path in ("sigma/tcp_um", "sigma/rotation_deg"):
        lines(path, _XYZ, axes, 1.5)
    for name in ("scatter_um", "scatter_deg", "average_walk_um"):
        lines(f"noise/{name}", _XYZ, axes, 1.5)
    send.static("noise/average_share", rr.SeriesLines(names=[*_XYZ, *(f"about {axis}" for axis in _XYZ)]))
    lines("residual/rms_px", ["corners, rms", "edge points, rms"], [Palette.CORNER_USED, Palette.EDGE_USED], 1.5)
    send.static("residual/corners_px", rr.SeriesLines(names=list(corner_ids)))
    lines("quality/edge_points", ["edge points used", "refused"], [Palette.EDGE_USED, Palette.EDGE_REFUSED], 1.5)
    lines("quality/corners_used", "corners used", Palette.CORNER_USED, 1.5)


def _both(size: int, raw: list[float], other: list[float]) -> list[float]:
    """Two series of ``size`` numbers side by side; NaN, shown as a gap, if only one of them is unknown."""
    gap = [math.nan] * size
    return [*(raw or gap), *(other or gap)] if raw or other else []


def _rms(values: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _band_mm(record: FrameRecord) -> list[float]:
    """One standard deviation below and above the TCP's shift: x, y, z, x, y, z."""
    if record.drift is None or record.covariance is None:
        return []
    shift_m = record.drift.tcp_shift_m
    sigma_m = [math.sqrt(variance) for variance in record.covariance[:21:7]]
    return [1e3 * (v + sign * s) for sign in (-1.0, 1.0) for v, s in zip(shift_m, sigma_m, strict=True)]


def _noticed(limits: Limits, axes: slice, scale: float) -> list[float]:
    """Bounds of the undetected shift, the lower ones first; empty while they are unknown."""
    if limits.noticed is None or limits.offset is None:
        return []
    middle, size = np.array(limits.offset[axes]), np.array(limits.noticed[axes])
    return [*(scale * (middle - size)).tolist(), *(scale * (middle + size)).tolist()]


def _corner_residuals_px(record: FrameRecord, trace: TraceNote) -> list[float]:
    """Distance of each corner from its predicted position; NaN, shown as a gap, where it was not measured."""
    predicted = pairs(trace.predicted_corners_uv_px)
    measured = [(math.nan, math.nan) if corner.uv_px is None else corner.uv_px for corner in record.corners]
    if len(measured) != len(predicted) or not measured:
        return []
    return [float(d) for d in np.linalg.norm(np.array(measured) - predicted, axis=1)]


def _edge_residuals_px(trace: TraceNote) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of the edge points that the fit used, and of the others, in the overlay's order."""
    used = np.frombuffer(trace.edge_used, np.uint8) == 1
    distances = np.frombuffer(trace.edge_residual_px, np.float32)
    return distances[used], distances[~used]
