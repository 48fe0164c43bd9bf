"""The page: one HTML file that needs nothing else, neither a network nor other files."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Any

import numpy as np

from gripmon.analyse.report import formats
from gripmon.analyse.report.build import Told
from gripmon.analyse.report.content import AffectedRange, Event, Noise, RecordingReport, Report
from gripmon.analyse.report.happenings import MOTIONS
from gripmon.analyse.report.pictures import Looked, Shown, together
from gripmon.analyse.report.words import CAUSES, cause_words
from gripmon.model.records import AlertKind, CauseWeight, Origin

_MOST_CARDS = 20  # events of one recording that are shown with pictures and all that was said
_MOST_ROWS = 400
_AROUND_S = 3.0
_AFFECTED = {
    "old_calibration": "Calibration from the beginning off",
    "stale_reference": "Reference in force off",
    "suspect": "Transform suspect",
    "unknown": "No transform",
}
_ENDED = {
    "recalibration": "a new reference",
    "return": "the camera being back",
    "measured_again": "being measured again",
    "end_of_recording": "– (end of the recording)",
}
_RANK = {"error": 2, "warning": 1, "info": 0}


def page(report: Report, told: Sequence[Told], step: Callable[[], None] = lambda: None) -> bytes:
    """The whole page, UTF-8; ``step`` is called after each recording.

    ``told`` belongs to ``report``'s recordings, in their order: pictures come from there.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    from gripmon.analyse.report.plots import as_json, drift_figure, overview_figure, protection_figure, running_figure

    shown: dict[tuple[int, int], tuple[Shown | None, ...]] = {}
    figures: dict[str, str] = {}
    if len(told) > 1:
        figures["overview"] = as_json(overview_figure(report.recordings))
    for n, each in enumerate(told, 1):
        if each.report.running.frames:
            figures[f"drift-{n}"] = as_json(drift_figure(each.report))
            if each.report.integrity is not None:
                figures[f"protection-{n}"] = as_json(protection_figure(each.report))
            figures[f"running-{n}"] = as_json(running_figure(each.report))
        for event in _cards(each.report.events):
            shown[n, event.number] = _pictures(each, event)
        step()
    environment = Environment(
        loader=PackageLoader("gripmon.analyse.report", "page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.globals.update(_VOCABULARY)
    environment.filters["units"] = _with_units
    text = environment.get_template("report.html.j2").render(
        report=report,
        title=_title(report),
        overview=len(told) > 1,
        shown=shown,
        figures=figures,
        stamp=lambda n, seq: _stamp(told[n - 1], seq),
        has_pictures=lambda n: any(any(each) for (k, _), each in shown.items() if k == n),
        most_rows=_MOST_ROWS,
        plotly=get_plotlyjs(),
        style=_file("style.css"),
        script=_file("page.js"),
    )
    return text.encode("utf-8", "replace")


def _file(name: str) -> str:
    return resources.files("gripmon.analyse.report").joinpath("page", name).read_text("utf-8")


def _title(report: Report) -> str:
    robots = list(dict.fromkeys(f"{r.robot} / {r.camera}" for r in report.recordings))
    days = list(dict.fromkeys(formats.date(r.start_ns) for r in report.recordings if r.running.frames))
    who = robots[0] if len(robots) == 1 else f"{len(robots)} cameras"
    return f"{who}, {days[0]}" + (f" to {days[-1]}" if len(days) > 1 else "") if days else who


def _cards(events: Sequence[Event]) -> list[Event]:
    """Motions, new references and what is worth a warning; if there are many, the gravest and largest of them."""
    worthy = [
        e for e in events if e.kind in (*MOTIONS, AlertKind.RECALIBRATED) or (e.severity != "info" and e.kind != "gap")
    ]
    worthy.sort(key=lambda e: (_RANK.get(e.severity, 0), 0.0 if e.moved is None else e.moved.size_m), reverse=True)
    return worthy[:_MOST_CARDS]


def _pictures(told: Told, event: Event) -> tuple[Shown | None, ...]:
    return together([_looked(told, seq) for seq in (event.before_seq, event.at_seq, event.after_seq)])


def _looked(told: Told, seq: int | None) -> Looked | None:
    picture = None if seq is None else told.source.picture(seq)
    if seq is None or picture is None:
        return None
    table = told.source.frames
    return Looked(picture, bool(table.source[_index(told, seq)] != table.ORIGINS.index(Origin.HELD)))


def _stamp(told: Told, seq: int) -> int:
    return int(told.source.frames.stamp_ns[_index(told, seq)])


def _index(told: Told, seq: int) -> int:
    table = told.source.frames
    return min(int(np.searchsorted(table.seq, seq)), len(table) - 1)


def _with_units(text: str) -> str:
    """No line ends between a number and its unit."""
    return re.sub(r"(?<=[\d>]) (?=(?:±|mm|ms|s|min|h|d|%|\d)(?:\W|\d|$))", "\u00a0", re.sub("± ", "±\u00a0", text))


def _labels(event: Event) -> tuple[str, str, str]:
    """Of its pictures."""
    return "Before", "As it moved" if event.kind in MOTIONS else "During", "After"


def _times_moved(report: RecordingReport) -> str:
    number = sum(event.kind in MOTIONS for event in report.events)
    return {0: "no", 1: "once", 2: "twice"}.get(number, f"{number} times")


def _lasting(report: RecordingReport, what: str) -> str:
    total_s = sum(1e-9 * (a.end_ns - a.start_ns) for a in report.affected if a.what == what)
    return formats.duration(total_s) if total_s else "never"


def _length(event: Event) -> str:
    if event.kind == AlertKind.STEP:
        return "at once"
    if event.kind in MOTIONS:
        return "–" if event.moved_in_s is None else formats.duration(event.moved_in_s)
    if event.end_ns is None:
        return "not over"
    return "–" if event.end_ns <= event.onset.stamp_ns else formats.span(event.onset.stamp_ns, event.end_ns)


def _cause(event: Event) -> str:
    return "–" if event.cause == "unknown" and not event.causes else cause_words(event)


def _cause_name(cause: CauseWeight) -> str:
    name = CAUSES.get(cause.cause, str(cause.cause).replace("_", " "))
    return f"{name} ({cause.part})" if cause.part else name


def _told(event: Event) -> str:
    """The event in a sentence or two."""
    parts = []
    if event.moved is not None:
        within = f" within {formats.duration(event.moved_in_s)} (95 % of it)" if event.moved_in_s else ""
        along = formats.signed_mm(event.moved.tcp_shift_m)
        parts.append(f"The TCP moved by {formats.size(event.moved)}{within}: {along} mm along x, y, z.")
    onset = event.onset
    if onset.latest_ns > onset.earliest_ns:
        parts.append(
            f"It began between {formats.clock_time(onset.earliest_ns, 3)} and {formats.clock_time(onset.latest_ns, 3)}."
        )
    if event.noticed_ns is not None and event.noticed_ns > onset.stamp_ns:
        parts.append(f"Noticed after {formats.span(onset.stamp_ns, event.noticed_ns)}.")
    if event.cause != "unknown":
        parts.append(f"Cause: {cause_words(event)}.")
    if event.moved is None and event.story:
        said = event.story[0].text.removeprefix("raised: ")
        parts.insert(0, f"{said[:1].upper()}{said[1:]}.".replace("..", "."))
    if event.end_text:
        parts.append(
            f"It was over at {formats.clock_time(event.end_ns, 1)}: {event.end_text}."
            if event.end_ns and event.kind not in MOTIONS
            else f"In the end: {event.end_text}."
        )
    return " ".join(parts)


def _around(event: Event) -> tuple[float, float]:
    """Milliseconds, for the plot: the event with what surrounds it."""
    start_s = 1e-9 * event.onset.earliest_ns
    end_s = 1e-9 * max(event.end_ns or event.onset.latest_ns, event.onset.latest_ns)
    margin_s = max(_AROUND_S, 0.3 * (end_s - start_s))
    return round(1e3 * (start_s - margin_s), 1), round(1e3 * (end_s + margin_s), 1)


def _affected_name(affected: AffectedRange) -> str:
    return _AFFECTED.get(affected.what, affected.what)


def _ended(affected: AffectedRange) -> str:
    return _ENDED.get(affected.ended_by, affected.ended_by)


def _meanings(report: RecordingReport) -> list[tuple[str, str]]:
    return list(dict.fromkeys((_affected_name(a), a.meaning) for a in report.affected))


def _rate(report: RecordingReport) -> str:
    rate = report.running.frames_per_s
    return "–" if rate is None else f"{rate:.1f} frames/s"


def _milliseconds(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.2f} ms"


def _noise_rows(noise: Noise) -> list[tuple[str, ...]]:
    rows = zip(noise.position_m, noise.claimed_position_m, noise.rotation_rad, noise.claimed_rotation_rad, strict=True)
    return [
        (axis, f"{1e3 * p:.4f}", f"{1e3 * cp:.4f}", f"{math.degrees(r):.4f}", f"{math.degrees(cr):.4f}")
        for axis, (p, cp, r, cr) in zip("xyz", rows, strict=True)
    ]


_FORMATS = ("clock_time", "count", "date", "degrees", "iso", "millimetres", "percent", "size", "span")
_VOCABULARY: dict[str, Any] = {
    **{name: getattr(formats, name) for name in _FORMATS},
    "times_moved": _times_moved,
    "lasting": _lasting,
    "length": _length,
    "cause": _cause,
    "cause_name": _cause_name,
    "told": _told,
    "around": _around,
    "labels": _labels,
    "zip": zip,
    "affected_name": _affected_name,
    "ended": _ended,
    "meanings": _meanings,
    "rate": _rate,
    "milliseconds": _milliseconds,
    "noise_rows": _noise_rows,
}  # fmt: skip
