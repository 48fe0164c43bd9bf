"""The report's plots: plotly figures, drawn from the report's data alone.

Lines and letters take their colours from the page's style sheet, so that they are readable in light and dark; the
colours here are those of what is shown, of middle lightness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from gripmon.analyse.content import Curve, RecordingReport, Stretch, clock_time, iso, span

BLUE, ORANGE, PURPLE, PALE_PURPLE = "#3f7fdd", "#dd8420", "#8f63cf", "#c7b1e7"
AXES = {"x": "#dc5450", "y": "#2f9c5c", "z": "#4c7fe6"}
ROBOTS = ("#3f7fdd", "#dd8420", "#2f9c5c", "#a861c9", "#cf4f7a", "#2a9aa5", "#8d7a3c", "#7a7f8c")
VERDICTS = {"valid": "#41ad6b", "suspect": "#e0a22f", "unknown": "#8d94a1"}
STATES = {
    "acquiring": "#4f8fe0",
    "tracking": "#41ad6b",
    "drifting": "#e0a22f",
    "recalibrating": "#a86bd0",
    "occluded": "#e07b3f",
    "lost": "#d9504d",
    "stale": "#8d94a1",
}
AFFECTED = {"old_calibration": "#c2456b", "stale_reference": "#d9504d", "suspect": "#e0a22f", "unknown": "#8d94a1"}
SEVERITIES = {"info": "#8d94a1", "warning": "#e0a22f", "error": "#d9504d"}
_OTHER = "#8d94a1"
_MM = 1e3
_STRIP_PX = 15


def drift_figure(report: RecordingReport) -> go.Figure:
    """The TCP's displacement from the calibration and the reference in force (mm), its components, the rotation (°),
    and strips of verdicts, states and affected times.
    """
    figure = _figure(0.035, 0.36, 0.27, 0.16, 0.21)
    curves = {curve.name: curve for curve in report.curves}
    if len(report.references) > 1:
        _line(figure, curves["tcp_from_reference_m"], 1, ORANGE, "from the reference in force", _MM)
    _line(figure, curves["tcp_from_beginning_m"], 1, BLUE, "from the calibration at the beginning", _MM)
    for axis, colour in AXES.items():
        _line(figure, curves[f"{axis}_m"], 2, colour, axis, _MM)
    _line(figure, curves["rotation_rad"], 3, PURPLE, "turn", math.degrees(1.0))
    _limits(figure, report, curves)
    _strips(figure, report, 4)
    _marks(figure, report)
    for row, title in enumerate(("TCP off by (mm)", "TCP shift (mm)", "turn (°)"), 1):
        from_zero = "tozero" if row != 2 else "normal"
        figure.update_yaxes(title_text=title, title_standoff=8, row=row, col=1, rangemode=from_zero)
    figure.update_xaxes(title_text="UTC", row=4, col=1, title_standoff=4)
    return _styled(figure, 720)


def overview_figure(reports: Sequence[RecordingReport]) -> go.Figure:
    """All recordings on one time axis: how far each TCP was off, and the verdicts."""
    names = list(dict.fromkeys(f"{r.robot} / {r.camera}" for r in reports))
    strips = 26 * len(names) + 40
    figure = _figure(0.06, 280 / (280 + strips), strips / (280 + strips))
    shown: set[str] = set()
    for report in reports:
        name = f"{report.robot} / {report.camera}"
        curve = next((c for c in report.curves if c.name == "tcp_from_beginning_m"), None)
        if curve is not None:
            colour = ROBOTS[names.index(name) % len(ROBOTS)]
            _line(figure, curve, 1, colour, _plain(name), _MM, legend=name not in shown)
            shown.add(name)
        _strip(figure, 2, _plain(name), report.running.verdict_history, VERDICTS)
    figure.update_yaxes(title_text="TCP off by (mm)", rangemode="tozero", row=1, col=1)
    figure.update_yaxes(type="category", autorange="reversed", showgrid=False, row=2, col=1)
    figure.update_xaxes(title_text="UTC", row=2, col=1)
    return _styled(figure, 330 + strips)


def running_figure(report: RecordingReport) -> go.Figure:
    """Verdicts, rate and latency over time."""
    slices = report.running.slices
    figure = _figure(0.06, 0.34, 0.33, 0.33)
    middle = _times([(s.start_ns + s.end_ns) // 2 for s in slices])
    width = [1e-6 * (s.end_ns - s.start_ns) for s in slices]
    for name, colour in VERDICTS.items():
        share = np.array([100.0 * getattr(s, name) for s in slices])
        figure.add_bar(
            x=middle, y=share, width=width, name=name, marker_color=colour, marker_line_width=0, row=1, col=1,
            hovertemplate=f"{name} %{{y:.1f}} %<extra></extra>",
        )  # fmt: skip
    rate = np.array([s.frames / (1e-9 * (s.end_ns - s.start_ns)) for s in slices])
    p99_ms, median_ms = (
        1e3 * _numbers([getattr(s, name) for s in slices]) for name in ("latency_p99_s", "latency_median_s")
    )
    for row, y, name, colour in (
        (2, rate, "frames/s", BLUE),
        (3, p99_ms, "99 %", ORANGE),
        (3, median_ms, "median", BLUE),
    ):
        line = {"color": colour, "shape": "hvh"}
        figure.add_scatter(x=middle, y=y, mode="lines", line=line, name=name, row=row, col=1)
    for row, title in enumerate(("verdicts (%)", "frames/s", "latency (ms)"), 1):
        figure.update_yaxes(title_text=title, rangemode="tozero", row=row, col=1)
    figure.update_yaxes(range=[0, 100], row=1, col=1)
    figure.update_layout(barmode="stack", bargap=0)
    return _styled(figure, 460)


def protection_figure(report: RecordingReport) -> go.Figure:
    """Bounds on the errors of position and rotation, logarithmic, with the alert limits."""
    figure = _figure(0.07, 0.6, 0.4)
    curves = {curve.name: curve for curve in report.curves}
    limits = report.limits
    for row, name, scale, limit in (
        (1, "protection_m", _MM, limits.alert_limit_m),
        (2, "protection_rad", math.degrees(1.0), limits.alert_limit_rad),
    ):
        label = "protection level" if row == 1 else "of the rotation"
        _line(figure, curves[name], row, PURPLE, label, scale, legend=row == 1)
        # Which of both is the protection level, valid_by says: the other one.
        of = "absolute" if limits.valid_by == "reference" else "since_reference"
        if (other := curves.get(name.replace("protection", of))) is not None:
            _line(figure, other, row, PALE_PURPLE, of.replace("_", " the "), scale, legend=row == 1)
        if limit is not None:  # a line, since a shape's text stands elsewhere on a logarithmic axis
            ends = _times([report.start_ns, report.end_ns])
            figure.add_scatter(
                x=ends, y=[scale * limit] * 2, mode="lines", name="alert limit", showlegend=row == 1, row=row, col=1,
                line={"color": SEVERITIES["error"], "width": 1.2, "dash": "dash"}, hovertemplate="alert limit %{y:g}",
            )  # fmt: skip
    for row, title in enumerate(("TCP within (mm)", "turn within (°)"), 1):
        figure.update_yaxes(type="log", title_text=title, title_standoff=8, row=row, col=1, dtick="D2")
    figure.update_xaxes(title_text="UTC", row=2, col=1, title_standoff=4)
    return _styled(figure, 380)


def _line(
    figure: go.Figure, curve: Curve, row: int, colour: str, name: str, scale: float, *, legend: bool = True
) -> None:
    """The middle as a line, the bounds as a band."""
    x = _times(curve.stamp_ns)
    y, low, high = (_numbers(values) * scale for values in (curve.middle, curve.low, curve.high))
    band_x, band_y = _band(x, low, high)
    figure.add_scatter(
        x=band_x, y=band_y, fill="toself", fillcolor=_pale(colour), line={"width": 0}, mode="lines", hoverinfo="skip",
        showlegend=False, legendgroup=f"{row} {name}", row=row, col=1,
    )  # fmt: skip
    figure.add_scatter(
        x=x, y=y, mode="lines", line={"color": colour, "width": 1.6}, name=name, legendgroup=f"{row} {name}",
        showlegend=legend, row=row, col=1, hovertemplate=f"{name}: %{{y:.3f}}<br>%{{x|%H:%M:%S.%L}} UTC<extra></extra>",
    )  # fmt: skip


def _band(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed polygon for every part without a hole."""
    there = np.isfinite(low) & np.isfinite(high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(np.int8)))
    xs: list[np.ndarray] = []
    ys: list[np.ndarray] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        part = slice(start, stop)
        xs += [x[part], x[part][::-1], np.array([np.nan])]
        ys += [high[part], low[part][::-1], np.array([np.nan])]
    empty = [np.empty(0)]
    return np.concatenate(xs or empty), np.concatenate(ys or empty).astype(np.float32)


def _limits(figure: go.Figure, report: RecordingReport, curves: dict[str, Curve]) -> None:
    """Dashed: what counts as affected, and where the monitor measures the reference again, if that is in sight."""
    limits = report.limits
    levels = (
        (1, "tcp_from_beginning_m", _MM, limits.affected_m, limits.limit_m),
        (3, "rotation_rad", math.degrees(1.0), limits.affected_rad, limits.limit_rad),
    )
    for row, name, scale, affected, limit in levels:
        top = max((v for v in curves[name].high if v is not None), default=0.0)
        for level, severity, text in ((affected, "warning", "affected"), (limit, "error", "limit")):
            if level <= 1.6 * top or level == affected:
                figure.add_hline(
                    y=scale * level, line={"color": SEVERITIES[severity], "width": 1.2, "dash": "dash"}, row=row, col=1,
                    annotation={"text": text, "font": {"size": 11}, "xanchor": "right", "yanchor": "bottom"},
                )  # fmt: skip


def _strips(figure: go.Figure, report: RecordingReport, row: int) -> None:
    _strip(figure, row, "verdict", report.running.verdict_history, VERDICTS)
    _strip(figure, row, "state", report.running.state_history, STATES)
    labels = {"old_calibration": "calibration off", "stale_reference": "reference off"}
    for what, label in labels.items():
        ranges = [Stretch(a.what, a.start_ns, a.end_ns) for a in report.affected if a.what == what]
        if ranges:
            _strip(figure, row, label, ranges, {what: AFFECTED[what]})
    figure.update_yaxes(type="category", autorange="reversed", showgrid=False, row=row, col=1)


def _strip(figure: go.Figure, row: int, label: str, stretches: Sequence[Stretch], colours: dict[str, str]) -> None:
    """One line of a strip chart, one colour per name."""
    for name in dict.fromkeys(s.name for s in stretches):
        mine = [s for s in stretches if s.name == name]
        x = np.array([t for s in mine for t in (1e-6 * s.start_ns, 1e-6 * max(s.end_ns, s.start_ns + 1), np.nan)])
        words = [f"{name.replace('_', ' ')}, {clock_time(s.start_ns)}, {span(s.start_ns, s.end_ns)}" for s in mine]
        text = [t for each in words for t in (each, each, "")]
        figure.add_scatter(
            x=x, y=[label] * len(x), mode="lines", line={"color": colours.get(name, _OTHER), "width": _STRIP_PX},
            name=name, text=text, hovertemplate="%{text}<extra></extra>", showlegend=False, row=row, col=1,
        )  # fmt: skip


def _marks(figure: go.Figure, report: RecordingReport) -> None:
    """A thin line for every event that is more than information, with its number; references dotted."""
    for event in report.events:
        renewed = event.kind in ("recalibrated", "restored", "reference")
        if event.kind == "gap" or not (renewed or event.severity != "info"):
            continue
        colour = "#a86bd0" if renewed else SEVERITIES.get(event.severity, _OTHER)
        line = {"color": colour, "width": 1.2, "dash": "dot" if renewed else "solid"}
        x = 1e-6 * event.onset.stamp_ns
        figure.add_shape(
            type="line", x0=x, x1=x, y0=0, y1=1, xref="x4", yref="paper", line=line, layer="below", name="event"
        )
        figure.add_annotation(
            x=x, y=1.0, xref="x4", yref="paper", yanchor="bottom", text=str(event.number), showarrow=False,
            font={"size": 12}, hovertext=_plain(f"{event.title}, {iso(event.onset.stamp_ns)}"),
        )  # fmt: skip


def _figure(spacing: float, *heights: float) -> go.Figure:
    """Rows of plots on one axis of time."""
    rows = len(heights)
    return make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=spacing, row_heights=list(heights))


def _styled(figure: go.Figure, height_px: int) -> go.Figure:
    clear, grid = "rgba(0,0,0,0)", "rgba(128,128,128,0.18)"
    family = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
    above = 1.0 + 24 / max(height_px - 96, 1)
    figure.update_layout(
        height=height_px,
        margin={"l": 62, "r": 16, "t": 52, "b": 44},
        paper_bgcolor=clear,
        plot_bgcolor=clear,
        font={"family": family, "size": 12.5},
        legend={
            "orientation": "h", "x": 0, "y": above, "yanchor": "bottom", "yref": "paper", "title": None,
            "itemsizing": "constant",
        },
        hovermode="closest",
        hoverlabel={"namelength": -1},
        dragmode="zoom",
        modebar={"bgcolor": clear, "color": "#8d94a1", "activecolor": BLUE},
        uirevision="kept",
    )  # fmt: skip
    figure.update_xaxes(
        type="date", showline=False, ticks="outside", ticklen=4, gridcolor=grid, hoverformat="%H:%M:%S.%L"
    )
    figure.update_yaxes(zeroline=False, gridcolor=grid, automargin=True)
    return figure


def _times(stamps_ns: Sequence[int]) -> np.ndarray:
    """Milliseconds, as a date axis counts them."""
    return 1e-6 * np.array(stamps_ns, np.float64)


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in values], np.float32)


def _pale(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.22)"


def _plain(text: str) -> str:
    """Plotly reads some HTML in its texts: what a person has named stays as it is."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def as_json(figure: go.Figure) -> str:
    """JSON for a script element, escaped so that no text in it can end the element."""
    text: Any = figure.to_json()
    return str(text).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def mountings_figure(names: Sequence[str], shift_m: np.ndarray, mountings: np.ndarray) -> go.Figure:
    """The TCP of each stretch of a dataset against the first one's, along the camera's axes (mm);
    one colour per mounting.
    """
    figure = _figure(0.05, 1 / 3, 1 / 3, 1 / 3)
    for number in np.unique(mountings).tolist():
        mine = np.flatnonzero(mountings == number)
        marker = {"color": ROBOTS[number % len(ROBOTS)], "size": 5}
        for row in range(3):
            figure.add_scatter(
                x=mine, y=_MM * shift_m[mine, row], mode="markers", marker=marker, name=f"mounting {number}",
                legendgroup=str(number), showlegend=row == 0, text=[_plain(names[k]) for k in mine.tolist()],
                hovertemplate="%{text}<br>%{y:.3f} mm<extra></extra>", row=row + 1, col=1,
            )  # fmt: skip
    figure = _styled(figure, 460)
    figure.update_xaxes(type="linear", hoverformat=None)
    figure.update_xaxes(title_text="stretches in the episodes' order", row=3, col=1)
    for row, axis in enumerate("xyz", 1):
        figure.update_yaxes(title_text=f"{axis} (mm)", row=row, col=1)
    return figure
