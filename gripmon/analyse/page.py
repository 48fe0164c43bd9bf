"""The report as a self-contained HTML page: the summary, and for each recording its facts, plots, events and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Any, NamedTuple

from markupsafe import Markup

from gripmon.analyse.build import AnalysedRecording
from gripmon.analyse.content import Event, Fact, Noise, RecordingReport, Report, facts, size
from gripmon.analyse.events import MOTIONS
from gripmon.analyse.pictures import pictures_of
from gripmon.analyse.plots import Figure
from gripmon.analyse.summary import cause_words, lasting_s, weighed
from gripmon.analyse.words import (
    clock_time,
    count,
    date,
    degrees,
    duration,
    iso,
    millimetres,
    often,
    percent,
    signed_mm,
    span,
)
from gripmon.model.records import AlertKind

_MAX_CARDS = 20  # events of one recording shown with pictures and all alerts
_MAX_ROWS = 400
_AROUND_S = 3.0
_RANK = {"error": 2, "warning": 1, "info": 0}
_AFFECTED = {
    "old_calibration": "Calibration from the beginning off",
    "stale_reference": "Reference in force off",
    "suspect": "Transform suspect",
    "unknown": "No transform",
}
_ENDED_BY = {
    "recalibration": "a new reference",
    "return": "the camera being back",
    "measured_again": "being measured again",
    "end_of_recording": "– (end of the recording)",
}
_AXES = "position (mm)", "claimed", "turn (°)", "claimed"


class Table(NamedTuple):
    """Cells are words, or what is printed so; ``head`` and ``caption`` may be empty."""

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""


def page(report: Report, analysed: Sequence[AnalysedRecording], step: Callable[[], None] = lambda: None) -> bytes:
    """The whole page, UTF-8; ``step`` is called after each recording.

    ``analysed``: the recordings of ``report``, in the same order, for their pictures.
    """
    from gripmon.analyse import plots

    figures: dict[str, Figure] = {}
    recordings = []
    if len(analysed) > 1:
        figures["overview"] = plots.overview_figure(report.recordings)
    for n, (source, each) in enumerate(((a.source, a.report) for a in analysed), 1):
        if each.running.frames:
            figures[f"drift-{n}"] = plots.drift_figure(each)
            figures[f"running-{n}"] = plots.running_figure(each)
        if each.integrity is not None:
            figures[f"protection-{n}"] = plots.protection_figure(each)
        cards = _cards(each.events)
        source.prepare([s for e in cards for s in (e.before_seq, e.at_seq, e.after_seq) if s is not None])
        shown = {event.number: pictures_of(event, source) for event in cards}
        recordings.append({"report": each, "shown": shown, "facts": _facts(each), **_tables(each, n, shown)})
        step()
    return rendered(
        "report.html.j2",
        figures,
        report=report,
        title=_title(report),
        summary=report.summary,
        recordings=recordings,
        overview=_overview(report.recordings) if len(analysed) > 1 else None,
        motions=MOTIONS,
    )


def rendered(template: str, figures: dict[str, Figure], **values: Any) -> bytes:
    """A page from its template, UTF-8, with its ``figures`` by the names that it gives them."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=PackageLoader("gripmon.analyse", "web"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.globals.update({function.__name__.removeprefix("_"): function for function in _FUNCTIONS})
    environment.globals["max_rows"] = _MAX_ROWS
    environment.filters["units"] = _with_units
    web = resources.files("gripmon.analyse") / "web"
    return (
        environment.get_template(template)
        .render(
            style=Markup((web / "style.css").read_text("utf-8")),
            script=Markup((web / "page.js").read_text("utf-8")),
            plotly=Markup(get_plotlyjs() if figures else ""),
            figures={name: Markup(figure.json()) for name, figure in figures.items()},
            **values,
        )
        .encode("utf-8", "replace")
    )


def _title(report: Report) -> str:
    robots = list(dict.fromkeys(f"{r.robot} / {r.camera}" for r in report.recordings))
    days = list(dict.fromkeys(date(r.start_ns) for r in report.recordings if r.running.frames))
    who = robots[0] if len(robots) == 1 else f"{len(robots)} cameras"
    return f"{who}, {days[0]}" + (f" to {days[-1]}" if len(days) > 1 else "") if days else who


def _cards(events: Sequence[Event]) -> list[Event]:
    """Motions, new references and warnings; if there are many, the most severe and largest of them."""
    always = (*MOTIONS, AlertKind.RECALIBRATED)
    worthy = [e for e in events if e.kind in always or (e.severity != "info" and e.kind != "gap")]
    worthy.sort(key=lambda e: (_RANK.get(e.severity, 0), 0.0 if e.moved is None else e.moved.size_m), reverse=True)
    return worthy[:_MAX_CARDS]


def _facts(r: RecordingReport) -> list[Fact]:
    """What is read first of a recording."""
    of = f" of {r.running.frames + r.running.frames_dropped}" if r.running.frames_dropped else ""
    recorded = f"{span(r.start_ns, r.end_ns)}, {count(r.running.frames, 'frame')}{of}"
    return [
        Fact("Moved", often(sum(event.kind in MOTIONS for event in r.events)), "steps, creeps and drifts"),
        Fact("Off at the end", size(r.at_end), "of the calibration at the beginning, when last measured"),
        Fact("Old calibration off", _lasting(r, "old_calibration"), "by more than what counts as affected"),
        Fact("No transform", _lasting(r, "unknown"), "was given"),
        *(facts(r.integrity)[:1] if r.integrity is not None else ()),
        *facts(r),
        Fact("Recorded", recorded, "from the first frame to the last"),
    ]


def _lasting(report: RecordingReport, what: str) -> str:
    total_s = lasting_s(report, what)
    return duration(total_s) if total_s else "never"


def _overview(reports: Sequence[RecordingReport]) -> Table:
    known = [(f"#recording-{n}", f"{r.robot} / {r.camera}", r, _facts(r)[:4]) for n, r in enumerate(reports, 1)]
    names = [fact.name for fact in known[0][3]]
    rows = [(_link(to, who), _day(r.start_ns), _day(r.end_ns), *(f.text for f in told)) for to, who, r, told in known]
    return Table(("Camera", "From", "To", *names), rows)


def _tables(r: RecordingReport, n: int, shown: dict[int, Any]) -> dict[str, Any]:
    """By their names in the template; those without rows are there, too."""
    events = [
        (
            _link(f"#event-{n}-{e.number}", e.number) if e.number in shown else e.number, _when(e.onset.stamp_ns),
            _dot(e) + e.title, size(e.moved), _length(e), _cause(e),
        )
        for e in r.events
    ]  # fmt: skip
    affected = [
        (
            _AFFECTED[a.what], _when(a.start_ns), _when(a.end_ns), span(a.start_ns, a.end_ns), size(a.largest),
            _ENDED_BY[a.ended_by],
        )
        for a in r.affected
    ]  # fmt: skip
    references = [
        (_when(x.in_force_ns), x.reference_id, x.revision, x.origin, x.accepted_by, size(x.step)) for x in r.references
    ]
    commands = [(_when(c.stamp_ns), f"{c.name} {c.argument}", "yes" if c.done else "no", c.text) for c in r.commands]
    shares = [(share.name, share.frames, percent(share.share)) for share in (*r.running.verdicts, *r.running.states)]
    return {
        "events": Table(("No.", "Time", "What", "How far", "How long", "Cause"), events),
        "affected": Table(("What", "From", "To", "Length", "Off by up to", "Ended by"), affected),
        "meanings": {_AFFECTED[a.what]: a.meaning for a in r.affected},
        "references": Table(
            ("In force from", "Reference", "Revision", "Origin", "Accepted by", "Moved by"), references
        ),
        "commands": Table(("Time", "Command", "Done", "Answer"), commands),
        "protection": [] if r.integrity is None else facts(r.integrity),
        "ran": facts(r.running),
        "verdicts": Table((), shares, "Verdicts and states"),
        "noise": Table(("", *_AXES), _noise(r.running.noise), "Noise from frame to frame (one standard deviation)"),
    }


def _noise(noise: Noise | None) -> list[tuple[str, ...]]:
    """A row for each axis."""
    if noise is None:
        return []
    metres, turns = (noise.position_m, noise.claimed_position_m), (noise.rotation_rad, noise.claimed_rotation_rad)
    values = [[1e3 * v for v in some] for some in metres] + [[math.degrees(v) for v in some] for some in turns]
    return [(axis, *(f"{some[k]:.4f}" for some in values)) for k, axis in enumerate("xyz")]


def _when(stamp_ns: int, digits: int = 1) -> Markup:
    return Markup('<time datetime="{}">{}</time>').format(iso(stamp_ns), clock_time(stamp_ns, digits))


def _day(stamp_ns: int) -> Markup:
    return Markup('<time datetime="{}">{}</time> {}').format(iso(stamp_ns), date(stamp_ns), _when(stamp_ns, 0))


def _link(to: str, text: object) -> Markup:
    return Markup('<a href="{}">{}</a>').format(to, text)


def _dot(event: Event) -> Markup:
    return Markup('<span class="dot {0}" title="{0}"></span>').format(event.severity)


def _with_units(text: str) -> str:
    """Keep a number and its unit on one line."""
    return re.sub(r"(?<=[\d>]) (?=(?:mm|ms|s|min|h|d|%|\d)(?:\W|\d|$))", "\u00a0", text)


def _length(event: Event) -> str:
    if event.kind == AlertKind.STEP:
        return "at once"
    if event.kind in MOTIONS:
        return "–" if event.moved_in_s is None else duration(event.moved_in_s)
    if event.end_ns is None:
        return "not over"
    return "–" if event.end_ns <= event.onset.stamp_ns else span(event.onset.stamp_ns, event.end_ns)


def _cause(event: Event) -> str:
    return "–" if event.cause == "unknown" and not event.causes else cause_words(event)


def _sentences(event: Event) -> str:
    """The event in a sentence or two."""
    parts = []
    if event.moved is not None:
        within = f" within {duration(event.moved_in_s)} (95 % of it)" if event.moved_in_s else ""
        along = signed_mm(event.moved.tcp_shift_m)
        parts.append(f"The TCP moved by {size(event.moved)}{within}: {along} mm along x, y, z.")
    elif event.story:
        text = event.story[0].text.removeprefix("raised: ")
        parts.append(f"{text[:1].upper()}{text[1:]}.".replace("..", "."))
    onset = event.onset
    if onset.latest_ns > onset.earliest_ns:
        parts.append(f"It began between {clock_time(onset.earliest_ns, 3)} and {clock_time(onset.latest_ns, 3)}.")
    if event.noticed_ns is not None and event.noticed_ns > onset.stamp_ns:
        most = "at most " if onset.latest_ns > onset.earliest_ns else ""
        parts.append(f"Noticed after {most}{span(min(onset.earliest_ns, onset.stamp_ns), event.noticed_ns)}.")
    if event.cause != "unknown":
        parts.append(f"Cause: {cause_words(event)}.")
    if event.end_text:
        over = event.end_ns and event.kind not in MOTIONS
        when = f"It was over at {clock_time(event.end_ns, 1)}" if over and event.end_ns else "In the end"
        parts.append(f"{when}: {event.end_text}.")
    return " ".join(parts)


def _around(event: Event) -> tuple[float, float]:
    """Range of the plot, ms: the event with a margin."""
    start_s = 1e-9 * event.onset.earliest_ns
    end_s = 1e-9 * max(event.end_ns or event.onset.latest_ns, event.onset.latest_ns)
    margin_s = max(_AROUND_S, 0.3 * (end_s - start_s))
    return round(1e3 * (start_s - margin_s), 1), round(1e3 * (end_s + margin_s), 1)


_FUNCTIONS = (
    count, degrees, millimetres, percent, _when, _dot, _sentences, _around, weighed, zip,
)  # fmt: skip
