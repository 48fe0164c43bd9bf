"""The plots of a page: Plotly's figures as data, drawn from a report's data alone.

Lines and letters take their colours from the page's style sheet, so that they are readable in light and dark; the
colours here are those of what is shown, of middle lightness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from gripmon.analyse.content import Curve, RecordingReport, Stretch
from gripmon.analyse.words import clock_time, iso, span
from gripmon.model.records import Array

BLUE, ORANGE, PURPLE, PALE_PURPLE = "#3f7fdd", "#dd8420", "#8f63cf", "#c7b1e7"
GOOD, DOUBTFUL, BAD, IDLE, REPAIR = "#41ad6b", "#e0a22f", "#d9504d", "#8d94a1", "#a86bd0"
SERIES = ("#3f7fdd", "#dd8420", "#2f9c5c", "#a861c9", "#cf4f7a", "#2a9aa5", "#8d7a3c", "#7a7f8c")
NAMES = {
    "valid": GOOD, "suspect": DOUBTFUL, "unknown": IDLE,
    "acquiring": "#4f8fe0", "tracking": GOOD, "drifting": DOUBTFUL, "recalibrating": REPAIR, "occluded": "#e07b3f",
    "lost": BAD, "stale": IDLE,
    "old_calibration": "#c2456b", "stale_reference": BAD,
    "warning": DOUBTFUL, "error": BAD,
}  # fmt: skip
"""Of verdicts, states, affected times and severities; others have :data:`IDLE`."""
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
_YEARS = 1e5  # of at most four digits, and a sign
_CLEAR, _GRID = "rgba(0,0,0,0)", "rgba(128,128,128,0.18)"
_TOP_PX, _BOTTOM_PX, _STRIP_PX = 52, 44, 15
LONGEST_NAME = 26
"""Characters of 12 px type beside a plot: half of a telephone's 390 px."""
_DRIFT = (
    (1, "tcp_from_reference_m", "from the reference in force", ORANGE),
    (1, "tcp_from_beginning_m", "from the calibration at the beginning", BLUE),
    (2, "x_m", "x", "#dc5450"),
    (2, "y_m", "y", "#2f9c5c"),
    (2, "z_m", "z", "#4c7fe6"),
    (3, "rotation_rad", "turn", PURPLE),
)


class Figure:
    """Plots below each other, the first at the top, on one axis: of time, or with another ``axis`` of numbers."""

    def __init__(self, height_px: int, rows: Sequence[tuple[str, float]], gap: float = 0.06, axis: str = "UTC"):
        """``rows``: title of the y axis, and share of the height."""
        self.data: list[dict[str, Any]] = []
        over = 1.0 + 24 / (height_px - _TOP_PX - _BOTTOM_PX)
        self.layout: dict[str, Any] = {
            "height": height_px, "margin": {"l": 62, "r": 16, "t": _TOP_PX, "b": _BOTTOM_PX},
            "paper_bgcolor": _CLEAR, "plot_bgcolor": _CLEAR, "font": {"family": _FONT, "size": 12.5},
            "legend": {"orientation": "h", "x": 0, "y": over, "yanchor": "bottom", "itemsizing": "constant"},
            "hovermode": "closest", "hoverlabel": {"namelength": -1}, "dragmode": "zoom",
            "modebar": {"bgcolor": _CLEAR, "color": IDLE, "activecolor": BLUE}, "uirevision": "kept",
            "shapes": [], "annotations": [],
            "xaxis": {
                "anchor": f"y{len(rows)}", "title": {"text": axis}, "gridcolor": _GRID, "ticks": "outside",
                **({"type": "date", "hoverformat": "%H:%M:%S.%L"} if axis == "UTC" else {}),
            },
        }  # fmt: skip
        top = 1.0
        for row, (title, share) in enumerate(rows, 1):
            bottom = max(top - share * (1.0 - gap * (len(rows) - 1)), 0.0)
            self.axis(
                row, anchor="x", domain=[bottom, top], title={"text": title, "standoff": 8}, zeroline=False,
                gridcolor=_GRID, automargin=True,
            )  # fmt: skip
            top = bottom - gap

    def axis(self, row: int, **changes: Any) -> None:
        """Set what a row's y axis is like."""
        self.layout.setdefault(f"yaxis{row if row > 1 else ''}", {}).update(changes)

    def add(self, row: int, x: Any, y: Any, name: str, **trace: Any) -> None:
        """Anything over one row; by default a line without an entry in the legend."""
        plain = {"type": "scatter", "mode": "lines", "showlegend": False, "legendgroup": f"{row} {name}"}
        self.data.append(plain | {"x": x, "y": y, "name": name, "xaxis": "x", "yaxis": f"y{row}"} | trace)

    def curve(self, row: int, curve: Curve, name: str, colour: str, *, legend: bool = True) -> None:
        """The middle as a line, the bounds as a band; in mm or degrees."""
        x, scale = _times(curve.stamp_ns), _scale(curve.name)
        y, low, high = (scale * np.array(values, float) for values in (curve.middle, curve.low, curve.high))
        band_x, band_y = _band(x, low, high)
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        fill = {"fill": "toself", "fillcolor": f"rgba({red},{green},{blue},0.22)", "line": {"width": 0}}
        self.add(row, band_x, band_y, name, hoverinfo="skip", **fill)
        hover = f"{name}: %{{y:.3f}}<br>%{{x|%H:%M:%S.%L}} UTC<extra></extra>"
        self.add(row, x, y, name, line={"color": colour, "width": 1.6}, showlegend=legend, hovertemplate=hover)

    def level(self, row: int, report: RecordingReport, value: float, text: str, severity: str) -> None:
        """A dashed line over all of the time; a trace, since a shape's text stands elsewhere on a logarithmic axis."""
        self.add(
            row, _times([report.start_ns, report.end_ns]), [value] * 2, text, mode="lines+text", text=["", text],
            textposition="top left", textfont={"size": 11}, cliponaxis=False,
            hovertemplate=f"{text} %{{y:g}}<extra></extra>",
            line={"color": NAMES[severity], "width": 1.2, "dash": "dash"},
        )  # fmt: skip

    def strip(self, row: int, label: str, stretches: Sequence[Stretch]) -> None:
        """One line of a strip chart, one colour for each name."""
        self.axis(row, type="category", autorange="reversed", showgrid=False)
        for name in dict.fromkeys(s.name for s in stretches):
            mine = [s for s in stretches if s.name == name]
            x = [t for s in mine for t in (1e-6 * s.start_ns, 1e-6 * max(s.end_ns, s.start_ns + 1), None)]
            words = [f"{name.replace('_', ' ')}, {clock_time(s.start_ns)}, {span(s.start_ns, s.end_ns)}" for s in mine]
            self.add(
                row, x, [label] * len(x), name, text=[t for each in words for t in (each, each, "")],
                line={"color": NAMES.get(name, IDLE), "width": _STRIP_PX}, hovertemplate="%{text}<extra></extra>",
            )  # fmt: skip

    def mark(self, stamp_ns: int, number: int, text: str, colour: str, dash: str) -> None:
        """A thin numbered line through all rows."""
        place = {"xref": "x", "yref": "paper"}
        x, line = 1e-6 * stamp_ns, {"color": colour, "width": 1.2, "dash": dash}
        self.layout["shapes"].append({"type": "line", "x0": x, "x1": x, "y0": 0, "y1": 1, "line": line} | place)
        words = {"text": str(number), "hovertext": text, "font": {"size": 12}, "showarrow": False}
        self.layout["annotations"].append({"x": x, "y": 1.0, "yanchor": "bottom"} | words | place)

    def json(self) -> str:
        """For a script element, escaped so that no text in it can end the element."""
        data, layout = self.data, self.layout
        if layout["xaxis"].get("type") == "date":
            data = [trace | {"x": [_date(x) for x in trace["x"]]} for trace in data]
            for name in ("shapes", "annotations"):
                marks = [{k: _date(v) if k in ("x", "x0", "x1") else v for k, v in m.items()} for m in layout[name]]
                layout = layout | {name: marks}
        text = msgspec.json.encode({"data": data, "layout": layout}, enc_hook=_numbers).decode()
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def drift_figure(report: RecordingReport) -> Figure:
    """The TCP's displacement from the calibration and the reference in force (mm), its components, the rotation (°),
    and strips of verdicts, states and affected times; a line for every event that is more than information.
    """
    rows = ("TCP off by (mm)", 0.36), ("TCP shift (mm)", 0.27), ("turn (°)", 0.16), ("", 0.21)
    figure, limits = Figure(720, rows, gap=0.035), report.limits
    curves = {curve.name: curve for curve in report.curves}
    for row, name, label, colour in _DRIFT:
        if name != "tcp_from_reference_m" or len(report.references) > 1:
            figure.curve(row, curves[name], label, colour)
    for row, name, affected, limit in (
        (1, "tcp_from_beginning_m", limits.affected_m, limits.limit_m),
        (3, "rotation_rad", limits.affected_rad, limits.limit_rad),
    ):
        figure.axis(row, rangemode="tozero")
        figure.level(row, report, _scale(name) * affected, "affected", "warning")
        if limit <= 1.6 * max((v for v in curves[name].high if v is not None), default=0.0):  # in sight
            figure.level(row, report, _scale(name) * limit, "limit", "error")
    figure.strip(4, "verdict", report.running.verdict_history)
    figure.strip(4, "state", report.running.state_history)
    for what, label in (("old_calibration", "calibration off"), ("stale_reference", "reference off")):
        figure.strip(4, label, [Stretch(a.what, a.start_ns, a.end_ns) for a in report.affected if a.what == what])
    for event in report.events:
        renewed = event.kind in ("recalibrated", "restored", "reference")
        if event.kind != "gap" and (renewed or event.severity != "info"):
            colour = REPAIR if renewed else NAMES.get(event.severity, IDLE)
            text = plain(f"{event.title}, {iso(event.onset.stamp_ns)}")
            figure.mark(event.onset.stamp_ns, event.number, text, colour, "dot" if renewed else "solid")
    return figure


def overview_figure(reports: Sequence[RecordingReport]) -> Figure:
    """All recordings on one time axis: how far each TCP was off, and the verdicts."""
    names = list(dict.fromkeys(f"{r.robot} / {r.camera}" for r in reports))
    strips = 26 * len(names) + 40
    figure = Figure(330 + strips, (("TCP off by (mm)", 280 / (280 + strips)), ("", strips / (280 + strips))))
    figure.axis(1, rangemode="tozero")
    figure.axis(2, tickvals=[plain(name) for name in names], ticktext=[plain(_shortened(name)) for name in names])
    shown: set[str] = set()
    for report in reports:
        name = f"{report.robot} / {report.camera}"
        for curve in report.curves[:1]:
            colour = SERIES[names.index(name) % len(SERIES)]
            figure.curve(1, curve, plain(_shortened(name)), colour, legend=name not in shown)
            shown.add(name)
        figure.strip(2, plain(name), report.running.verdict_history)
    return figure


def _shortened(name: str) -> str:
    """With its middle left out if it would be wider than half of a telephone's screen."""
    return name if len(name) <= LONGEST_NAME else f"{name[:10]}…{name[11 - LONGEST_NAME :]}"


def running_figure(report: RecordingReport) -> Figure:
    """Verdicts, rate and latency over time."""
    slices = report.running.slices
    figure = Figure(460, (("verdicts (%)", 0.34), ("frames/s", 0.33), ("latency (ms)", 0.33)))
    figure.layout |= {"barmode": "stack", "bargap": 0}
    figure.axis(1, range=[0, 100])
    middle = _times([(s.start_ns + s.end_ns) // 2 for s in slices])
    width = [1e-6 * (s.end_ns - s.start_ns) for s in slices]
    for name in ("valid", "suspect", "unknown"):
        share = [100.0 * getattr(s, name) for s in slices]
        bars = {"type": "bar", "width": width, "marker": {"color": NAMES[name], "line": {"width": 0}}}
        hover = f"{name} %{{y:.1f}} %<extra></extra>"
        figure.add(1, middle, share, name, showlegend=True, hovertemplate=hover, **bars)
    rate = [s.frames / (1e-9 * (s.end_ns - s.start_ns)) for s in slices]
    p99_ms, median_ms = (
        1e3 * np.array([getattr(s, f"latency_{which}_s") for s in slices], float) for which in ("p99", "median")
    )
    for row, y, name, colour in (
        (2, rate, "frames/s", PURPLE), (3, p99_ms, "99 %", ORANGE), (3, median_ms, "median", BLUE),
    ):  # fmt: skip
        figure.axis(row, rangemode="tozero")
        figure.add(row, middle, y, name, showlegend=True, line={"color": colour, "shape": "hvh"})
    return figure


def protection_figure(report: RecordingReport) -> Figure:
    """Bounds on the errors of position and rotation, logarithmic, with the alert limits."""
    figure = Figure(380, (("TCP within (mm)", 0.6), ("turn within (°)", 0.4)), gap=0.07)
    curves, limits = {curve.name: curve for curve in report.curves}, report.limits
    # Which of both is the protection level, valid_by says: the other one.
    other = "absolute" if limits.valid_by == "reference" else "since_reference"
    for row, unit, limit in ((1, "m", limits.alert_limit_m), (2, "rad", limits.alert_limit_rad)):
        figure.axis(row, type="log", nticks=4)  # of six decades no parts are named
        for name, label, colour in (
            ("protection", "protection level", PURPLE), (other, other.replace("_", " the "), PALE_PURPLE)
        ):  # fmt: skip
            if (curve := curves.get(f"{name}_{unit}")) is not None:
                figure.curve(row, curve, label, colour, legend=row == 1)
        if limit is not None:
            figure.level(row, report, _scale(f"_{unit}") * limit, "alert limit", "error")
    return figure


def mountings_figure(names: Sequence[str], shift_m: Array, mountings: Any) -> Figure:
    """The TCP of each stretch of a dataset against the first one's, along the camera's axes (mm);
    one colour per mounting.
    """
    figure = Figure(460, [(f"{axis} (mm)", 1 / 3) for axis in "xyz"], 0.05, "stretches in the episodes' order")
    if len(mountings) <= 10:
        figure.layout["xaxis"]["dtick"] = 1  # no half ones
    for number in np.unique(mountings).tolist():
        mine = np.flatnonzero(mountings == number)
        for row in (1, 2, 3):
            figure.add(
                row, mine, 1e3 * shift_m[mine, row - 1], f"mounting {number}", mode="markers", showlegend=row == 1,
                legendgroup=str(number), marker={"color": SERIES[number % len(SERIES)], "size": 5},
                text=[plain(names[k]) for k in mine.tolist()], hovertemplate="%{text}<br>%{y:.3f} mm<extra></extra>",
            )  # fmt: skip
    return figure


def _scale(name: str) -> float:
    """From SI to what people read, by the unit that ends a name: millimetres or degrees."""
    return 1e3 if name.endswith("_m") else math.degrees(1.0)


def _band(x: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """A closed polygon for every part without a hole."""
    there = np.isfinite(low) & np.isfinite(high)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    xs: list[Array] = [np.empty(0)]
    ys: list[Array] = [np.empty(0)]
    for start, stop in edges.reshape(-1, 2).tolist():
        part, back = slice(start, stop), slice(stop - 1, start - 1 if start else None, -1)
        xs += [x[part], x[back], np.array([np.nan])]
        ys += [high[part], low[back], np.array([np.nan])]
    return np.concatenate(xs), np.concatenate(ys)


def _times(stamps_ns: Sequence[int]) -> Array:
    """Milliseconds, as a date axis counts them."""
    return 1e-6 * np.array(stamps_ns, np.float64)


def _date(time_ms: float | None) -> float | str | None:
    """A time as it is, but in words where Plotly would take the number for a year: in the first seconds of 1970, when
    images without capture times are counted from.
    """
    if time_ms is None or math.isnan(time_ms):
        return None
    if abs(time_ms) >= _YEARS:
        return round(float(time_ms), 6)
    return str(np.datetime64(round(1e6 * time_ms), "ns"))


def _numbers(values: Any) -> list[float]:
    """Of an array, with six digits behind the point: a micrometre's thousandth, a nanosecond; NaN becomes null."""
    return list(np.round(values, 6).tolist())


def plain(text: str) -> str:
    """Plotly reads some HTML in its texts: what a person has named stays as it is."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
