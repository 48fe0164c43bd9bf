"""The report as a self-contained HTML page, with pictures before, at and after an event and their measurements."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.build import AnalysedRecording
from gripmon.analyse.content import (
    Event,
    RecordingReport,
    Report,
    clock_time,
    count,
    date,
    degrees,
    duration,
    iso,
    millimetres,
    percent,
    signed_mm,
    size,
    span,
)
from gripmon.analyse.events import MOTIONS
from gripmon.analyse.overlay import Colour, Line, Marks, jpeg
from gripmon.analyse.summary import CAUSES, cause_words
from gripmon.model.records import AlertKind, CauseWeight, Origin
from gripmon.record.recorder import to_8_bit
from gripmon.record.recordings import Picture

_MOST_CARDS = 20  # events of one recording shown with pictures and all alerts
_MOST_ROWS = 400
_AROUND_S = 3.0
_WEB = resources.files("gripmon.analyse") / "web"
_RANK = {"error": 2, "warning": 1, "info": 0}


def page(report: Report, analysed: Sequence[AnalysedRecording], step: Callable[[], None] = lambda: None) -> bytes:
    """The whole page, UTF-8; ``step`` is called after each recording.

    ``analysed``: the recordings of ``report``, in the same order, for their pictures.
    """
    from plotly.offline import get_plotlyjs

    from gripmon.analyse.plots import as_json, drift_figure, overview_figure, protection_figure, running_figure

    shown: dict[tuple[int, int], tuple[ShownPicture | None, ...]] = {}
    figures: dict[str, str] = {}
    if len(analysed) > 1:
        figures["overview"] = as_json(overview_figure(report.recordings))
    for n, each in enumerate(analysed, 1):
        if each.report.running.frames:
            figures[f"drift-{n}"] = as_json(drift_figure(each.report))
            if each.report.integrity is not None:
                figures[f"protection-{n}"] = as_json(protection_figure(each.report))
            figures[f"running-{n}"] = as_json(running_figure(each.report))
        cards = _cards(each.report.events)
        seqs = [seq for event in cards for seq in (event.before_seq, event.at_seq, event.after_seq) if seq is not None]
        each.source.prepare(seqs)
        for event in cards:
            shown[n, event.number] = _pictures(each, event)
        step()
    return rendered(
        "report.html.j2",
        report=report,
        title=_title(report),
        overview=len(analysed) > 1,
        shown=shown,
        figures=figures,
        stamp=lambda n, seq: int(analysed[n - 1].source.frames.stamp_ns[_index(analysed[n - 1], seq)]),
        motions=MOTIONS,
        has_pictures=lambda n: any(any(each) for (k, _), each in shown.items() if k == n),
        most_rows=_MOST_ROWS,
        plotly=get_plotlyjs(),
        script=(_WEB / "page.js").read_text("utf-8"),
    )


def rendered(template: str, **values: Any) -> bytes:
    """A page from its template, UTF-8, with the functions and the style that all pages share."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("gripmon.analyse", "web"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.globals.update({function.__name__.removeprefix("_"): function for function in _FUNCTIONS})
    environment.filters["units"] = _with_units
    style = (_WEB / "style.css").read_text("utf-8")
    return environment.get_template(template).render(style=style, **values).encode("utf-8", "replace")


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
    return worthy[:_MOST_CARDS]


def _pictures(analysed: AnalysedRecording, event: Event) -> tuple[ShownPicture | None, ...]:
    seqs = event.before_seq, event.at_seq, event.after_seq
    return cut_alike([_judged(analysed, seq) for seq in seqs])


def _judged(analysed: AnalysedRecording, seq: int | None) -> JudgedPicture | None:
    picture = None if seq is None else analysed.source.picture(seq)
    if seq is None or picture is None:
        return None
    table = analysed.source.frames
    held = table.source[_index(analysed, seq)] == table.ORIGINS.index(Origin.HELD)
    return JudgedPicture(picture, used=not held)


def _index(analysed: AnalysedRecording, seq: int) -> int:
    table = analysed.source.frames
    return min(int(np.searchsorted(table.seq, seq)), len(table) - 1)


def _with_units(text: str) -> str:
    """Keep a number and its unit on one line."""
    return re.sub(r"(?<=[\d>]) (?=(?:mm|ms|s|min|h|d|%|\d)(?:\W|\d|$))", "\u00a0", text)


def _times_moved(report: RecordingReport) -> str:
    number = sum(event.kind in MOTIONS for event in report.events)
    return {0: "no", 1: "once", 2: "twice"}.get(number, f"{number} times")


def _lasting(report: RecordingReport, what: str) -> str:
    total_s = sum(1e-9 * (a.end_ns - a.start_ns) for a in report.affected if a.what == what)
    return duration(total_s) if total_s else "never"


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


def _cause_name(cause: CauseWeight) -> str:
    name = CAUSES.get(cause.cause, str(cause.cause).replace("_", " "))
    return f"{name} ({cause.part})" if cause.part else name


def _sentences(event: Event) -> str:
    """The event in a sentence or two."""
    parts = []
    if event.moved is not None:
        within = f" within {duration(event.moved_in_s)} (95 % of it)" if event.moved_in_s else ""
        along = signed_mm(event.moved.tcp_shift_m)
        parts.append(f"The TCP moved by {size(event.moved)}{within}: {along} mm along x, y, z.")
    onset = event.onset
    if onset.latest_ns > onset.earliest_ns:
        parts.append(f"It began between {clock_time(onset.earliest_ns, 3)} and {clock_time(onset.latest_ns, 3)}.")
    if event.noticed_ns is not None and event.noticed_ns > onset.stamp_ns:
        parts.append(f"Noticed after {span(onset.stamp_ns, event.noticed_ns)}.")
    if event.cause != "unknown":
        parts.append(f"Cause: {cause_words(event)}.")
    if event.moved is None and event.story:
        text = event.story[0].text.removeprefix("raised: ")
        parts.insert(0, f"{text[:1].upper()}{text[1:]}.".replace("..", "."))
    if event.end_text:
        parts.append(
            f"It was over at {clock_time(event.end_ns, 1)}: {event.end_text}."
            if event.end_ns and event.kind not in MOTIONS
            else f"In the end: {event.end_text}."
        )
    return " ".join(parts)


def _around(event: Event) -> tuple[float, float]:
    """Range of the plot, ms: the event with a margin."""
    start_s = 1e-9 * event.onset.earliest_ns
    end_s = 1e-9 * max(event.end_ns or event.onset.latest_ns, event.onset.latest_ns)
    margin_s = max(_AROUND_S, 0.3 * (end_s - start_s))
    return round(1e3 * (start_s - margin_s), 1), round(1e3 * (end_s + margin_s), 1)


_FUNCTIONS = (
    clock_time, count, date, degrees, iso, millimetres, percent, size, span,
    _times_moved, _lasting, _length, _cause, _cause_name, _sentences, _around, zip,
)  # fmt: skip

_WIDTH_PX = 560  # of a picture on the page
_MARGIN = 0.18  # of the gripper's size, around it
_SMALLEST = 0.35  # of the image's width: a smaller part doesn't show the scene
_JPEG_QUALITY = 82
Points = NDArray[np.float32]
PREDICTED: Colour = (255, 200, 60)
USED: Colour = (120, 235, 70)
REFUSED: Colour = (70, 70, 255)
CORNER: Colour = (60, 225, 255)
BEFORE: Colour = (255, 255, 255)


class JudgedPicture(NamedTuple):
    """A picture, and whether its measurement was used; otherwise all its points are shown as refused."""

    picture: Picture
    used: bool


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """A picture on the page; ``uri`` is a JPEG in a data URI."""

    seq: int
    uri: str
    width_px: int
    height_px: int


def cut_alike(pictures: Sequence[JudgedPicture | None]) -> tuple[ShownPicture | None, ...]:
    """Pictures in order of time (any may be None), cropped to the same part of the image; the gripper's outline in the
    first one is also drawn into the later ones, in white.
    """
    there = [each.picture for each in pictures if each is not None]
    if not there:
        return tuple(None for _ in pictures)
    height, width = there[0].image.shape[:2]
    shown = (points for p in there for points in (*p.predicted_edges, p.edges_used, _corners(p)))
    box = _box(list(shown), width, height)
    first = pictures[0]
    outline = () if first is None else tuple(first.picture.predicted_edges)
    return tuple(None if each is None else _shown(each, box, () if each is first else outline) for each in pictures)


def _corners(picture: Picture) -> Points:
    """(n, 2) corners that were measured and used."""
    found = [corner.uv_px for corner in picture.corners if corner.uv_px is not None and corner.used]
    return np.array(found, np.float32).reshape(-1, 2)


def _box(points: Sequence[Points], width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom around the gripper, in the image's aspect ratio; the whole image without a gripper."""
    finite = [p.reshape(-1, 2)[np.isfinite(p.reshape(-1, 2)).all(axis=1)] for p in points]
    joined = np.concatenate([*finite, np.empty((0, 2))])
    inside = joined[(joined >= 0.0).all(axis=1) & (joined[:, 0] < width) & (joined[:, 1] < height)]
    if len(inside) < 3:
        return 0, 0, width, height
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = max(*((high - low) * (1.0 + 2.0 * _MARGIN) / (width, height)), _SMALLEST)
    if share >= 0.9:
        return 0, 0, width, height
    size = np.round(share * np.array([width, height])).astype(int)
    corner = np.clip(np.round(0.5 * (low + high) - 0.5 * size).astype(int), 0, (width, height) - size)
    return int(corner[0]), int(corner[1]), int(corner[0] + size[0]), int(corner[1] + size[1])


def _shown(judged: JudgedPicture, box: tuple[int, int, int, int], outline: Sequence[Points]) -> ShownPicture | None:
    left, top, right, bottom = box
    picture, used = judged
    lines = [Line(strip, BEFORE, 2) for strip in outline]
    lines += [Line(strip, PREDICTED) for strip in picture.predicted_edges]
    marks = [Marks(picture.edges_used, USED if used else REFUSED), Marks(picture.edges_refused, REFUSED)]
    marks += [Marks(_corners(picture), CORNER, rings=True)] if used else []
    if not to_8_bit(picture.image)[top:bottom, left:right].size:
        return None
    text = base64.b64encode(jpeg(to_8_bit(picture.image), lines, marks, _WIDTH_PX, _JPEG_QUALITY, box)).decode("ascii")
    height_px = max(round(_WIDTH_PX / (right - left) * (bottom - top)), 1)
    return ShownPicture(int(picture.seq), f"data:image/jpeg;base64,{text}", _WIDTH_PX, height_px)
