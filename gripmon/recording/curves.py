"""Everything that is a number over time, with the limits that it is judged by, in people's units.

==================================  ================================================================================
``drift/tcp_shift_mm``              against the reference, camera axes; and ``…_length_mm``;  ``…_sigma_mm`` the band of
                                    one standard deviation, ``…_smoothed_mm`` that of the smoothed transform
``drift/d_mm``, ``delta_deg``       ``d`` and ``delta`` of equation (14)
``drift/limits_mm``, ``_deg``       of that length and turn: for a warning, for an error and a new reference (of ``d``)
``drift/noticed_mm``, ``_deg``      between which two a constant shift along an axis passes unnoticed: x, y, z; x, y, z
``drift/truth_mm``, ``error_mm``    where a simulator tells the truth
``drift/alerts/<severity>``         a mark at the shift's length where an alert is raised or noted
``test/share``                      the drift test's largest statistic over its threshold;  ``test/alarm`` is 1
``transform/raw``, ``smoothed``     translation (m) and quaternion x, y, z, w
``sigma/…``                         standard deviations, raw and smoothed;  ``noise/…`` what was learnt of the stream's
``residual/rms_px``                 of the corners;  ``corners_px`` each corner's distance from where the transform
                                    has it, ``edges_used_px``, ``edges_refused_px`` each edge point's in the overlay
``quality``, ``timing``, ``jaw``    counts of points and corners, latency, the opening that came with the frame
``image/…``                         statistics of the recorded images
==================================  ================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.recording import palette
from gripmon.recording.columns import Row, Sender
from gripmon.recording.wire import Scene, TraceNote, pairs
from gripmon.records import AlertEvent, FrameRecord, Limits, ReferenceRecord, Severity

_XYZ = ["x", "y", "z"]
_POSE = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"]
_Millimetres = list[float]


class CurveWriter:
    """Writes the entities of the table above."""

    def __init__(self, send: Sender, scene: Scene):
        self._send = send
        self._corner_ids = scene.corner_ids
        self._reference_tcp_m: dict[tuple[str, int], tuple[float, float, float]] = {}
        self._limits: Limits | None = None
        _log_styles(send, scene)

    def add_reference(self, reference: ReferenceRecord) -> None:
        """What drifts are reckoned from."""
        self._reference_tcp_m[reference.reference_id, reference.revision] = reference.cam_T_grip.translation_m

    def write(self, rows: Sequence[Row]) -> None:
        self._drift(rows)
        self._transforms(rows)
        self._test(rows)
        self._measurement(rows)
        self.write_pictures([row for row in rows if row.picture is not None])

    def write_pictures(self, shown: Sequence[Row]) -> None:
        """What belongs to pictures, which may come later than the rest of their frames."""
        send, pictures = self._send, [r.picture for r in shown if r.picture is not None]
        if pictures:
            send.curve("image/mean_grey", shown, [p.mean_grey for p in pictures])
            send.curve("image/contrast_grey", shown, [p.contrast_grey for p in pictures])
            send.curve("image/saturated_percent", shown, [p.saturated_percent for p in pictures])
            send.curve("image/sharpness", shown, [p.sharpness for p in pictures])
        traced = [r for r in shown if r.trace is not None]
        sides = [_edge_residuals_px(r.trace) for r in traced if r.trace is not None]
        for index, name in enumerate(("edges_used_px", "edges_refused_px") if traced else ()):
            some = [side[index] for side in sides]
            whole = rr.AnyValues.columns(distance_px=np.concatenate(some)).partition([len(each) for each in some])
            send.frames(f"residual/{name}", traced, whole)

    def _drift(self, rows: Sequence[Row]) -> None:
        send = self._send
        drifts = [r.record.drift for r in rows]
        shifts_mm = [_millimetres(None if d is None else d.tcp_shift_m) for d in drifts]
        send.scalars("drift/tcp_shift_mm", rows, shifts_mm)
        lengths_mm = [math.hypot(*shift_mm) if shift_mm else None for shift_mm in shifts_mm]
        send.curve("drift/tcp_shift_length_mm", rows, lengths_mm)
        send.scalars("drift/tcp_shift_sigma_mm", rows, [_band_mm(r.record) for r in rows])
        smoothed = [None if (s := r.record.smoothed) is None else s.translation_m for r in rows]
        send.scalars("drift/tcp_shift_smoothed_mm", rows, list(map(self._shift_mm, rows, smoothed)))
        send.curve("drift/d_mm", rows, [None if d is None else 1e3 * d.translation_m for d in drifts])
        send.curve("drift/delta_deg", rows, [None if d is None else math.degrees(d.rotation_rad) for d in drifts])
        if any(r.truth_tcp_m is not None for r in rows):
            truths_mm = [self._shift_mm(r, r.truth_tcp_m) for r in rows]
            send.scalars("drift/truth_mm", rows, truths_mm)
            send.scalars("drift/error_mm", rows, list(map(_difference, shifts_mm, truths_mm)))
        for severity in Severity:
            marked = [i for i, r in enumerate(rows) if _tells_news(r.record, severity)]
            if marked:
                # Without a drift to mark it stands on the axis.
                heights_mm = [lengths_mm[i] or 0.0 for i in marked]
                send.curve(f"drift/alerts/{severity}", [rows[i] for i in marked], heights_mm)

    def _shift_mm(self, row: Row, tcp_m: tuple[float, float, float] | None) -> _Millimetres:
        """A TCP against the one of the reference that the frame names; empty where either is unknown."""
        reference_tcp_m = self._reference_tcp_m.get((row.record.reference_id, row.record.revision))
        if tcp_m is None or reference_tcp_m is None:
            return []
        return [1e3 * (now - old) for now, old in zip(tcp_m, reference_tcp_m, strict=True)]

    def _transforms(self, rows: Sequence[Row]) -> None:
        send = self._send
        raw = [r.record.cam_T_grip for r in rows]
        smoothed = [r.record.smoothed for r in rows]
        send.scalars("transform/raw", rows, [() if t is None else (*t.translation_m, *t.rotation_xyzw) for t in raw])
        send.scalars(
            "transform/smoothed", rows, [() if t is None else (*t.translation_m, *t.rotation_xyzw) for t in smoothed]
        )
        for name, covariances in (
            ("", [r.record.covariance for r in rows]),
            ("smoothed_", [None if s is None else s.covariance for s in smoothed]),
        ):
            sigmas = [[] if c is None else [math.sqrt(variance) for variance in c[::7]] for c in covariances]
            send.scalars(f"sigma/{name}tcp_um", rows, [[1e6 * v for v in s[:3]] for s in sigmas])
            send.scalars(f"sigma/{name}rotation_deg", rows, [list(map(math.degrees, s[3:])) for s in sigmas])

    def _test(self, rows: Sequence[Row]) -> None:
        send = self._send
        send.curve("test/share", rows, [r.statistic_share for r in rows])
        judged = [r for r in rows if r.limits is not None]
        if not judged:
            return
        # A straight line needs its ends only.
        ends = judged[:1] + judged[-1:] if len(judged) > 1 else judged
        limits = [r.limits for r in ends if r.limits is not None]
        send.curve("test/alarm", ends, [1.0] * len(ends))
        send.scalars("drift/limits_mm", ends, [(1e3 * each.warn_m, 1e3 * each.limit_m) for each in limits])
        degrees = [(math.degrees(each.warn_rad), math.degrees(each.limit_rad)) for each in limits]
        send.scalars("drift/limits_deg", ends, degrees)
        changed = []
        for row in judged:
            if row.limits is not self._limits or row is judged[-1]:
                changed.append(row)
            self._limits = row.limits
        limits = [r.limits for r in changed if r.limits is not None]
        send.scalars("drift/noticed_mm", changed, [_noticed(each, slice(0, 3), 1e3) for each in limits])
        send.scalars("drift/noticed_deg", changed, [_noticed(each, slice(3, 6), 180.0 / math.pi) for each in limits])
        scatters = [each.scatter or () for each in limits]
        send.scalars("noise/scatter_um", changed, [[1e6 * v for v in s[:3]] for s in scatters])
        send.scalars("noise/scatter_deg", changed, [list(map(math.degrees, s[3:])) for s in scatters])
        send.scalars("noise/average_share", changed, [each.average_share for each in limits])
        send.scalars("noise/average_walk_um", changed, [[1e6 * w for w in each.average_walk[:3]] for each in limits])

    def _measurement(self, rows: Sequence[Row]) -> None:
        send = self._send
        send.curve("residual/rms_px", rows, [r.record.rms_px for r in rows])
        send.curve("quality/corners_used", rows, [float(sum(c.used for c in r.record.corners)) for r in rows])
        send.curve("jaw/reported_m", rows, [r.jaw_reported_m for r in rows])
        send.curve("timing/latency_us", rows, [1e-3 * r.record.latency_ns for r in rows])
        traced = [r for r in rows if r.trace is not None]
        traces = [r.trace for r in traced if r.trace is not None]
        if not traces:
            return
        corners_px = [_corner_residuals_px(r.record, t) for r, t in zip(traced, traces, strict=True)]
        send.scalars("residual/corners_px", traced, corners_px)
        sides = [_edge_residuals_px(trace) for trace in traces]
        counts = [(float(used.size), float(refused.size)) for used, refused in sides]
        send.scalars("quality/edge_points", traced, counts)
        rms_px = [None if not used.size else float(np.sqrt(np.mean(np.square(used)))) for used, _ in sides]
        send.curve("residual/edges_rms_px", traced, rms_px)


def _log_styles(send: Sender, scene: Scene) -> None:
    """Names, colours and widths of the curves."""
    axes = list(palette.AXES)
    pale, paler = ([palette.faded(colour, alpha) for colour in axes] for alpha in (130, 90))

    def lines(path: str, names: list[str] | str, colours: list[palette.Colour] | palette.Colour, width: float) -> None:
        count = 1 if isinstance(names, str) else len(names)
        send.static(path, rr.SeriesLines(names=names, colors=colours, widths=[width] * count))

    both = [f"{axis}{side}" for side in ("-", "+") for axis in _XYZ]
    lines("drift/tcp_shift_mm", _XYZ, axes, 2.0)
    lines("drift/tcp_shift_sigma_mm", [f"{name}σ" for name in both], pale * 2, 0.7)
    lines("drift/tcp_shift_smoothed_mm", [f"{axis} smoothed" for axis in _XYZ], pale, 1.5)
    lines("drift/truth_mm", [f"true {axis}" for axis in _XYZ], paler, 6.0)
    lines("drift/error_mm", _XYZ, axes, 1.0)
    lines("drift/tcp_shift_length_mm", "length", palette.WHOLE, 1.5)
    lines("drift/d_mm", "d", palette.WHOLE, 1.5)
    lines("drift/delta_deg", "δ", palette.WHOLE, 1.5)
    for unit in ("mm", "deg"):
        lines(f"drift/limits_{unit}", ["warning", "limit"], [palette.DOUBTFUL, palette.BAD], 1.5)
        lines(f"drift/noticed_{unit}", [f"{name} unnoticed" for name in both], pale * 2, 1.0)
    marks = {Severity.INFO: palette.BUSY, Severity.WARNING: palette.DOUBTFUL, Severity.ERROR: palette.BAD}
    for severity, colour in marks.items():
        points = rr.SeriesPoints(names=f"alert: {severity}", colors=colour, markers="Diamond", marker_sizes=6.0)
        send.static(f"drift/alerts/{severity}", points)
    lines("test/share", "statistic / threshold", palette.WHOLE, 1.5)
    lines("test/alarm", "alarm", palette.BAD, 1.5)
    for path in ("transform/raw", "transform/smoothed"):
        send.static(path, rr.SeriesLines(names=_POSE))
    for path in (
        "sigma/tcp_um",
        "sigma/rotation_deg",
        "noise/scatter_um",
        "noise/scatter_deg",
        "noise/average_walk_um",
    ):
        lines(path, _XYZ, axes, 1.5)
    for path in ("sigma/smoothed_tcp_um", "sigma/smoothed_rotation_deg"):
        lines(path, [f"{axis} smoothed" for axis in _XYZ], pale, 1.0)
    send.static("noise/average_share", rr.SeriesLines(names=[*_XYZ, *(f"about {axis}" for axis in _XYZ)]))
    lines("residual/rms_px", "corners, rms", palette.BUSY, 1.5)
    lines("residual/edges_rms_px", "edge points, rms", palette.EDGE_USED, 1.5)
    send.static("residual/corners_px", rr.SeriesLines(names=list(scene.corner_ids)))
    lines("quality/edge_points", ["edge points used", "refused"], [palette.EDGE_USED, palette.EDGE_REFUSED], 1.5)
    lines("quality/corners_used", "corners used", palette.CORNER_USED, 1.5)


def _millimetres(metres: Sequence[float] | None) -> _Millimetres:
    return [1e3 * v for v in metres or ()]


def _difference(values: Sequence[float], others: Sequence[float]) -> list[float]:
    """Empty where either is unknown."""
    return [a - b for a, b in zip(values, others, strict=True)] if values and others else []


def _band_mm(record: FrameRecord) -> _Millimetres:
    """One standard deviation below and above the TCP's shift: x, y, z, x, y, z."""
    if record.drift is None or record.covariance is None:
        return []
    shift_m = record.drift.tcp_shift_m
    sigma_m = [math.sqrt(variance) for variance in record.covariance[:21:7]]
    return [1e3 * (v + sign * s) for sign in (-1.0, 1.0) for v, s in zip(shift_m, sigma_m, strict=True)]


def _tells_news(record: FrameRecord, severity: Severity) -> bool:
    news = (AlertEvent.RAISED, AlertEvent.NOTED)
    return any(alert.severity is severity and alert.event in news for alert in record.alerts)


def _noticed(limits: Limits, axes: slice, scale: float) -> list[float]:
    """The ends of what passes unnoticed, lower ones first; empty while that isn't known."""
    if limits.noticed is None or limits.offset is None:
        return []
    middle, size = np.array(limits.offset[axes]), np.array(limits.noticed[axes])
    return [*(scale * (middle - size)).tolist(), *(scale * (middle + size)).tolist()]


def _corner_residuals_px(record: FrameRecord, trace: TraceNote) -> list[float]:
    """Distance of each corner from where the transform has it; NaN, which leaves a gap, where it was not measured."""
    predicted = pairs(trace.predicted_corners_uv_px)
    measured = [(math.nan, math.nan) if corner.uv_px is None else corner.uv_px for corner in record.corners]
    if len(measured) != len(predicted):
        return []
    return [float(d) for d in np.linalg.norm(np.array(measured) - predicted, axis=1)]


def _edge_residuals_px(trace: TraceNote) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of the points that the fit believed, and of the others, in the order in which the overlay shows them."""
    used = np.frombuffer(trace.edge_used, np.uint8) == 1
    distances = np.frombuffer(trace.edge_residual_px, np.float32)
    return distances[used], distances[~used]
