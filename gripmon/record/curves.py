"""Curves of a recording: one table of paths, names, colours and values; in mm, degrees, µm, px and µs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.model.records import AlertEvent, AlertKind, FrameRecord, Limits, ReferenceRecord, Severity
from gripmon.record.columns import Colour, Palette, Sender, faded
from gripmon.record.recorder import Row, TraceNote, pairs
from gripmon.record.table import COLUMNS, Column

_LIMITS_PERIOD_NS = 2_000_000_000
_DEG = math.degrees(1.0)
_Position = tuple[float, float, float]
_Values = Sequence[float] | None


@dataclass(frozen=True, slots=True)
class Curve:
    """The curves of one entity.

    ``values`` takes a row and the position of the TCP at the reference that it names (None: unknown).  Empty: a gap.
    None: unknown, which is a gap if any row of the batch is known; an entity of unknown values isn't written.
    """

    path: str
    names: Sequence[str]
    colours: Sequence[Colour]
    width: float
    values: Callable[[Row, _Position | None], _Values]


def _scaled(values: Sequence[float] | None, scale: float) -> Sequence[float]:
    return [] if values is None else [scale * value for value in values]


def _shift_mm(row: Row, _: _Position | None = None) -> Sequence[float]:
    """The TCP's shift along the camera's axes, and its length."""
    if row.record.drift is None:
        return []
    shift_mm = _scaled(row.record.drift.tcp_shift_m, 1e3)
    return [*shift_mm, math.hypot(*shift_mm)]


def _band_mm(row: Row, _: _Position | None) -> Sequence[float]:
    """One standard deviation below and above the TCP's shift: x, y, z, x, y, z."""
    drift, covariance = row.record.drift, row.record.covariance
    if drift is None or covariance is None:
        return []
    sigma_m = np.sqrt(covariance[:21:7])
    return [*(1e3 * (drift.tcp_shift_m - sigma_m)).tolist(), *(1e3 * (drift.tcp_shift_m + sigma_m)).tolist()]


def _from_mm(tcp_m: _Position | None, reference_tcp_m: _Position | None) -> Sequence[float]:
    if tcp_m is None or reference_tcp_m is None:
        return []
    return [1e3 * (now - old) for now, old in zip(tcp_m, reference_tcp_m, strict=True)]


def _truth_mm(row: Row, reference_tcp_m: _Position | None) -> _Values:
    return None if row.truth_tcp_m is None else _from_mm(row.truth_tcp_m, reference_tcp_m)


def _error_mm(row: Row, reference_tcp_m: _Position | None) -> _Values:
    shift_mm, truth_mm = _shift_mm(row)[:3], _truth_mm(row, reference_tcp_m)
    if truth_mm is None:
        return None
    return np.subtract(shift_mm, truth_mm).tolist() if shift_mm and truth_mm else []


def _both(size: int, raw: Sequence[float], other: Sequence[float]) -> Sequence[float]:
    """Two series of ``size`` numbers side by side; NaN, shown as a gap, if only one of them is unknown."""
    gap = [math.nan] * size
    return [*(raw or gap), *(other or gap)] if raw or other else []


def _poses(row: Row, _: _Position | None) -> Sequence[float]:
    both = ([*t.translation_m, *t.rotation_xyzw] if t else [] for t in (row.record.cam_T_grip, row.record.smoothed))
    return _both(7, *both)


def _sigmas(axes: slice, scale: float) -> Callable[[Row, _Position | None], Sequence[float]]:
    def values(row: Row, _: _Position | None) -> Sequence[float]:
        smoothed = row.record.smoothed
        covariances = (row.record.covariance or (), () if smoothed is None else smoothed.covariance)
        return _both(3, *([scale * math.sqrt(v) for v in covariance[::7][axes]] for covariance in covariances))

    return values


def _rms_px(row: Row, _: _Position | None) -> Sequence[float]:
    """Of the corners, and of the edge points that the fit used."""
    used = None if row.trace is None else _edge_residuals_px(row.trace)[0]
    edges = [] if used is None or not used.size else [float(np.sqrt(np.mean(np.square(used, dtype=np.float64))))]
    return _both(1, [] if row.record.rms_px is None else [row.record.rms_px], edges)


def _corners_px(row: Row, _: _Position | None) -> _Values:
    """Distance of each corner from its predicted position; NaN, shown as a gap, where it was not measured."""
    if row.trace is None:
        return None
    predicted = pairs(row.trace.predicted_corners_uv_px)
    measured = [(math.nan, math.nan) if corner.uv_px is None else corner.uv_px for corner in row.record.corners]
    if len(measured) != len(predicted) or not measured:
        return []
    return [float(d) for d in np.linalg.norm(np.array(measured) - predicted, axis=1)]


def _edge_counts(row: Row, _: _Position | None) -> _Values:
    return None if row.trace is None else [float(side.size) for side in _edge_residuals_px(row.trace)]


def _edge_residuals_px(trace: TraceNote) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of the edge points that the fit used, and of the others, in the overlay's order."""
    used = np.frombuffer(trace.edge_used, np.uint8) == 1
    distances = np.frombuffer(trace.edge_residual_px, np.float32)
    return distances[used], distances[~used]


def _statistic(name: str) -> Callable[[Row, _Position | None], _Values]:
    return lambda row, _: None if row.picture is None else [getattr(row.picture, name)]


def _of_limits(values: Callable[[Limits], _Values]) -> Callable[[Row, _Position | None], _Values]:
    return lambda row, _: None if row.limits is None else values(row.limits)


def _noticed(limits: Limits, axes: slice, scale: float) -> Sequence[float]:
    """Bounds of the undetected shift, the lower ones first; empty while they are unknown."""
    if limits.noticed is None or limits.offset is None:
        return []
    middle, size = np.array(limits.offset[axes]), np.array(limits.noticed[axes])
    return [*(scale * (middle - size)).tolist(), *(scale * (middle + size)).tolist()]


def _known(value: float | None, scale: float) -> _Values:
    return None if value is None else [scale * value]


_XYZ, _TURNS = slice(0, 3), slice(3, 6)
_AXES, _WHOLE = list(Palette.AXES), [Palette.WHOLE]
_PALE, _PALER = ([faded(colour, alpha) for colour in _AXES] for alpha in (130, 90))
_FAINT = [faded(Palette.WHOLE, 130)]
_LIMIT_COLOURS = [Palette.DOUBTFUL, Palette.BAD]
_BELIEF = [Palette.EDGE_USED, Palette.EDGE_REFUSED]
_BOTH = [f"{axis}{side}" for side in ("-", "+") for axis in "xyz"]
_POSE = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"]
_ANY: list[Colour] = []  # the viewer's own colours

_DRAWN = {"m": ("_mm", 1e3), "rad": ("_deg", _DEG), "ns": ("_us", 1e-3), "1": ("", 1.0)}
"""Units of the frame table: those of its curves, and what its values are multiplied by."""
_LOOKS = {
    "protection/since_reference": (_FAINT, 1.0),
    "protection/absolute": (_FAINT, 1.0),
    "quality/corners_used": ([Palette.CORNER_USED], 1.5),
}


def curve_path(column: Column) -> str:
    """The entity of a column's curve."""
    assert column.curve is not None
    return f"{column.curve[0]}{_DRAWN[column.unit][0]}"


def _of_column(column: Column) -> Curve:
    assert column.curve is not None
    (stem, name), scale = column.curve, _DRAWN[column.unit][1]
    colours, width = _LOOKS.get(stem, (_WHOLE, 1.5))

    def values(row: Row, _: _Position | None) -> _Values:
        value = column.of(row.record)
        return [] if value is None else [scale * value]

    return Curve(curve_path(column), [name], colours, width, values)


FRAME_CURVES = (
    *(_of_column(column) for column in COLUMNS.values() if column.curve is not None),
    Curve("drift/tcp_shift_mm", [*"xyz", "length"], [*_AXES, Palette.WHOLE], 1.8, _shift_mm),
    Curve("drift/tcp_shift_sigma_mm", [f"{name}σ" for name in _BOTH], _PALE * 2, 0.7, _band_mm),
    Curve("drift/tcp_shift_smoothed_mm", [f"{axis} smoothed" for axis in "xyz"], _PALE, 1.5,
          lambda r, tcp_m: _from_mm(None if r.record.smoothed is None else r.record.smoothed.translation_m, tcp_m)),
    Curve("drift/truth_mm", [f"true {axis}" for axis in "xyz"], _PALER, 6.0, _truth_mm),
    Curve("drift/error_mm", [*"xyz"], _AXES, 1.0, _error_mm),
    Curve("transform", [*_POSE, *(f"{name} smoothed" for name in _POSE)], _ANY, 0.0, _poses),
    Curve("sigma/tcp_um", [*"xyz"], _AXES, 1.5, _sigmas(_XYZ, 1e6)),
    Curve("sigma/rotation_deg", [*"xyz"], _AXES, 1.5, _sigmas(_TURNS, _DEG)),
    Curve("test/share", ["statistic / threshold"], _WHOLE, 1.5,
          lambda r, _: [] if r.statistic_share is None else [r.statistic_share]),
    Curve("jaw/reported_m", [], _ANY, 0.0, lambda r, _: [] if r.jaw_reported_m is None else [r.jaw_reported_m]),
    Curve("residual/rms_px", ["corners, rms", "edge points, rms"], [Palette.CORNER_USED, Palette.EDGE_USED], 1.5,
          _rms_px),
)  # fmt: skip
"""Of every frame."""

TRACED_CURVES = (
    Curve("residual/corners_px", [], _ANY, 0.0, _corners_px),
    Curve("quality/edge_points", ["edge points used", "refused"], _BELIEF, 1.5, _edge_counts),
)
"""Of frames with a trace."""

LIMIT_CURVES = (
    Curve("test/alarm", ["alarm"], [Palette.BAD], 1.5, lambda *_: [1.0]),
    Curve("drift/limits_mm", ["warning", "limit"], _LIMIT_COLOURS, 1.5,
          _of_limits(lambda each: [1e3 * each.warn_m, 1e3 * each.limit_m])),
    Curve("drift/limits_deg", ["warning", "limit"], _LIMIT_COLOURS, 1.5,
          _of_limits(lambda each: [_DEG * each.warn_rad, _DEG * each.limit_rad])),
    Curve("drift/noticed_mm", [f"{name} unnoticed" for name in _BOTH], _PALE * 2, 1.0,
          _of_limits(lambda each: _noticed(each, _XYZ, 1e3))),
    Curve("drift/noticed_deg", [f"{name} unnoticed" for name in _BOTH], _PALE * 2, 1.0,
          _of_limits(lambda each: _noticed(each, _TURNS, _DEG))),
    Curve("protection/limit_mm", ["alert limit"], [Palette.BAD], 1.5,
          _of_limits(lambda each: _known(each.alert_limit_m, 1e3))),
    Curve("protection/limit_deg", ["alert limit"], [Palette.BAD], 1.5,
          _of_limits(lambda each: _known(each.alert_limit_rad, _DEG))),
    Curve("noise/scatter_um", [*"xyz"], _AXES, 1.5, _of_limits(lambda each: _scaled((each.scatter or ())[:3], 1e6))),
    Curve("noise/scatter_deg", [*"xyz"], _AXES, 1.5, _of_limits(lambda each: _scaled((each.scatter or ())[3:], _DEG))),
    Curve("noise/average_share", [*"xyz", *(f"about {axis}" for axis in "xyz")], _ANY, 0.0,
          _of_limits(lambda each: each.average_share)),
    Curve("noise/average_walk_um", [*"xyz"], _AXES, 1.5, _of_limits(lambda each: _scaled(each.average_walk[:3], 1e6))),
)  # fmt: skip
"""Of frames whose limits are known: those in force then."""

PICTURE_CURVES = tuple(
    Curve(f"image/{name}", [], _ANY, 0.0, _statistic(name))
    for name in ("mean_grey", "contrast_grey", "saturated_percent", "sharpness")
)
"""Of recorded images, which may be written later than the rest of their frames."""

_MARKS = {Severity.INFO: Palette.BUSY, Severity.WARNING: Palette.DOUBTFUL, Severity.ERROR: Palette.BAD}


class CurveWriter:
    """Writes all numbers over time, with the limits that they are compared with, in mm and degrees."""

    def __init__(self, send: Sender, corner_ids: tuple[str, ...]):
        self._send = send
        self._reference_tcp_m: dict[tuple[str, int], _Position] = {}
        self._open: dict[str, tuple[AlertKind, Severity]] = {}  # the open alerts
        self._newest: Row | None = None
        self._drawn_ns: int | None = None
        for curve in (*FRAME_CURVES, *TRACED_CURVES, *LIMIT_CURVES):
            if curve.colours:
                send.lines(curve.path, curve.names, curve.colours, curve.width)
            elif curve.names:
                send.static(curve.path, rr.SeriesLines(names=curve.names))
        send.static("residual/corners_px", rr.SeriesLines(names=list(corner_ids)))
        for severity, colour in _MARKS.items():
            points = rr.SeriesPoints(names=f"alert: {severity}", colors=colour, markers="Diamond", marker_sizes=6.0)
            send.static(f"drift/alerts/{severity}", points)

    def add_reference(self, reference: ReferenceRecord) -> None:
        """A reference that drifts are measured from."""
        self._reference_tcp_m[reference.reference_id, reference.revision] = reference.cam_T_grip.translation_m

    def write(self, rows: Sequence[Row]) -> None:
        self._write(FRAME_CURVES, rows)
        self._write(TRACED_CURVES, [row for row in rows if row.trace is not None])
        self._mark_alerts(rows)
        self._limits([row for row in rows if row.limits is not None])
        self.write_pictures([row for row in rows if row.picture is not None])

    def write_pictures(self, shown: Sequence[Row]) -> None:
        """What belongs to pictures, which may be written later than the rest of their frames."""
        self._write(PICTURE_CURVES, shown)
        traced = [row for row in shown if row.trace is not None]
        sides = [_edge_residuals_px(row.trace) for row in traced if row.trace is not None]
        columns: list[rr.ComponentColumn] = []
        for i, name in enumerate(("used_px", "refused_px")):
            each = [side[i] for side in sides]
            if any(len(residuals) for residuals in each):  # rerun makes no column from nothing
                flat = rr.AnyValues.columns(True, **{name: np.concatenate(each)})
                columns += flat.partition([len(one) for one in each])
        if columns:
            self._send.frames("residual/edge_points", traced, rr.ComponentColumnList(columns))

    def finish(self) -> None:
        """At the end of the file: extend the limit lines to its last frame."""
        if self._newest is not None and self._newest.record.stamp_ns != self._drawn_ns:
            self._write(LIMIT_CURVES, [self._newest])

    def _write(self, curves: Sequence[Curve], rows: Sequence[Row]) -> None:
        tcps_m = [self._reference_tcp_m.get((row.record.reference_id, row.record.revision)) for row in rows]
        for curve in curves:
            values = [curve.values(row, tcp_m) for row, tcp_m in zip(rows, tcps_m, strict=True)]
            if any(some is not None for some in values):
                self._send.scalars(curve.path, rows, [some or () for some in values])

    def _limits(self, rows: Sequence[Row]) -> None:
        """Slow changes need few points, and every chunk costs two kilobytes."""
        if not rows:
            return
        self._newest, stamp_ns = rows[-1], rows[-1].record.stamp_ns
        if self._drawn_ns is None or not 0 <= stamp_ns - self._drawn_ns < _LIMITS_PERIOD_NS:
            self._drawn_ns = stamp_ns
            self._write(LIMIT_CURVES, [*rows[:1], *rows[1:][-1:]])

    def _mark_alerts(self, rows: Sequence[Row]) -> None:
        """At the shift's length; without a drift on the axis."""
        news = [self._news(row.record) for row in rows]
        for severity in Severity:
            marked = [row for row, some in zip(rows, news, strict=True) if severity in some]
            if marked:
                heights_mm = [_shift_mm(row)[3:] or [0.0] for row in marked]
                self._send.scalars(f"drift/alerts/{severity}", marked, heights_mm)

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
