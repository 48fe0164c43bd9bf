"""The results of ``tools/bench integrity`` in words: tables, the targets, the worst frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from benchmarks import kit
from benchmarks.integrity_limits import POSITIONS_M
from benchmarks.integrity_stats import VIEWS, targets
from benchmarks.kit import Report, percent

Figures = dict[str, Any]


def number(value: float | None) -> str:
    if value is None:
        return "–"
    return "never" if math.isinf(value) else f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}"


def _microns(length_m: float | None) -> str:
    return "–" if length_m is None else f"{1e6 * length_m:.3g}"


def _knock(row: Figures) -> str:
    """Frames until a jump of the mount is said, found, and valid again."""
    if not row["knocks"]:
        return "–"
    times = (row[f"knock_{what}"] for what in ("said", "found", "valid"))
    return "/".join("x" if math.isinf(frames) else f"{frames:g}" for frames in times)


def _of(key: str, to_text: Callable[[Any], str], index: int | None = None) -> Callable[[Figures], str]:
    return lambda row: to_text(row[key] if index is None else row[key][index])


COLUMNS: dict[str, Callable[[Figures], str]] = {
    "scenes": _of("scenes", str),
    "frames": _of("frames", str),
    "> AL": _of("lies", str),
    "> AL at most": _of("lies_at_most", "{:.1g}".format),
    "> PL": _of("unbounded", str),
    "> PL at most": _of("unbounded_at_most", "{:.1g}".format),
    "suspect > PL": _of("suspect_unbounded", str),
    "> AL, > PL in scenes": lambda row: f"{row['lies_scenes']}, {row['unbounded_scenes']}",
    "err/PL": _of("worst_excess", number),
    "asked %": _of("asked_share", percent),
    "valid %": _of("valid_share", percent),
    **{
        f"{name} %": _of("available", percent, view)
        for view, name in enumerate(("valid: free", "both tips", "one tip", "no tip"))
    },
    **{f"{1e3 * limit_m:g} mm %": _of("within", percent, k) for k, limit_m in enumerate(POSITIONS_M)},
    "PL µm": _of("median_level_m", _microns),
    "since µm": _of("median_both_m", _microns, 0),
    "absolute µm": _of("median_both_m", _microns, 1),
    "error µm": _of("median_error_m", _microns),
    "PL/error": _of("level_over_error", number),
    "NEES": _of("nees", number),
    "first": _of("first_valid", number),
    "never": _of("never_valid", str),
    "back %": _of("back", percent),
    "latest": _of("latest_back", number),
    "knock": _knock,
    "alerts": _of("false_alerts", str),
}
"""Heading, and the cell of some scenes' figures."""
BRIEF = ("frames", "> AL", "> PL", "err/PL", "asked %", "valid %", "PL µm", "first", "knock")
"""Of two revisions beside each other."""
LEGEND = """\
- \\> AL, > PL: valid frames whose error (TCP position, or rotation) exceeds the alert limit, or the frame's own \
protection level; at most: exact 95 % upper bound on the rate, as if frames were independent; in scenes: with at least \
one of each; err/PL: the largest error of a valid frame over its protection level
- suspect > PL: published with a bound but not valid, and beyond the bound
- asked %: valid of the frames that show enough; valid %: of all
- valid: share where the whole gripper is seen, where something hides part of it but both tips' outlines are seen, \
where one tip is hidden, and where both are; without conditions in which the gripper differs from its file, without \
the frames just after a jump or after the view became free
- 0.5, 1, 2 mm: the same, of all views, were that the position's alert limit: by the bounds, nothing is run again
- PL µm, error µm: medians of valid frames; since, absolute: of both bounds, where they are published; NEES: mean of \
valid frames
- first: median of the frames until the first valid one; never: scenes without one
- back: valid within 3 frames after the view is free again; latest: the most frames that it took
- knock: medians of the frames from a jump of the mount until an alert says it, until the gripper is measured where it \
is, and from then until it is valid; x: not before the end
- alerts: new ones that name a wrong cause: the mount, another camera, a finger, the opening, the lens"""


def show(lines: list[dict[str, Any]], found: Figures, report: Report) -> None:
    """Everything about the scenes of one run; ``found``: their :func:`benchmarks.integrity_stats.summary`."""
    total = found["total"]
    rows = [[name, *(cell(row) for cell in COLUMNS.values())] for name, row in [*found["rows"].items(), ("all", total)]]
    report.say(
        "\n".join(f"- {line}" for line in _about(lines, total)),
        kit.table(("condition", *COLUMNS), rows),
        LEGEND,
        _scales(found["scales"]),
        "possible: share of the same frames in which the published covariance alone, with normal errors, would allow a "
        "protection level within the alert limit",
    )
    report.reach(targets(total))
    report.say("worst frames, one of each scene:", "\n".join(f"- {_again(item)}" for item in found["worst"]))


def _about(lines: list[dict[str, Any]], total: Figures) -> list[str]:
    """On what this was measured."""
    limits_m, limits_rad = ([line[key] for line in lines] for key in ("limit_m", "limit_rad"))
    degrees = " to ".join(f"{math.degrees(end(limits_rad)):.2g}" for end in (min, max))
    kept, seconds, cpu_s = total["promised"], total["seconds"], sum(line.get("cpu_s", 0.0) for line in lines)
    by = " and ".join(sorted({line["valid_by"] for line in lines}))
    commits = ", ".join(sorted({line["commit"] for line in lines}))
    promised = (
        f"valid by the {by} bound; of {kept['scenes']} promised scenes beyond it: {kept['unbounded_scenes']} (95 %: at "
        f"most {100.0 * kept['unbounded_scenes_at_most']:.2g} % of such scenes)"
    )
    return [
        f"commit {commits}; seed {lines[0]['seed']}, {lines[0]['asked']} frames a scene",
        f"alert limits, fixed beforehand: {1e3 * min(limits_m):.3g} to {1e3 * max(limits_m):.3g} mm, {degrees} degrees",
        promised,
        "position beyond the absolute bound: {} valid frames in {} scenes".format(*total["beyond_absolute"]),
        f"{seconds / len(lines):.1f} s a scene, {seconds / 60.0:.1f} min in all, processor {cpu_s / 60.0:.1f} min",
    ]


def _scales(scales: list[Figures]) -> str:
    """Availability by image scale."""
    rows = []
    for row in scales:
        end = "and more" if math.isinf(row["high"]) else f"to {row['high']:g}"
        jaw = "opening exact" if row["jaw_exact"] else "opening as reported"
        shares = [percent(row[key][view]) for view in range(3) for key in ("available", "possible")]
        levels = [_microns(row["median_level_m"]), _microns(row["median_error_m"])]
        name = f"{row['low']:g} {end} px/mm, {jaw}"
        rows.append([name, row["scenes"], *shares, *levels, row["misleading_scenes"]])
    views = [f"{view}: {what} %" for view in ("free", "both tips", "one tip") for what in ("valid", "possible")]
    head = ("scale at the TCP, jaw", "scenes", *views, "PL µm", "error µm", "misleading scenes")
    return kit.table(head, rows)


def _again(item: Figures) -> str:
    """How to see one of the worst frames again, and what it was."""
    level = "none"
    if item["level_m"] is not None:
        level = f"{1e3 * item['level_m']:.3g} mm and {1e3 * item['level_rad']:.3g} mrad"
    return (
        f'`--only "{item["condition"]}" --seed {item["seed"]} --scene {item["scene"]}`: frame {item["frame"]}, '
        f"{'valid' if item['valid'] else 'suspect'}, error {1e3 * item['error_m']:.3g} mm and "
        f"{1e3 * item['error_rad']:.3g} mrad, protection level {level}, {item['view']}"
        f"{'; ' + item['why'] if item['why'] else ''}; {item['misleading']} misleading frames in this scene"
    )


def frame_by_frame(line: dict[str, Any]) -> list[str]:
    """One scene."""
    rows = []
    for index, view in enumerate(line["view"]):
        values = [line[key][index] for key in ("error_m", "level_m", "error_rad", "level_rad")]
        scaled = ["–" if value is None else f"{1e3 * value:.3g}" for value in values]
        verdict = "valid" if line["valid"][index] else "suspect" if values[0] is not None else "unknown"
        rows.append([index, VIEWS[view], verdict, *scaled, number(line["nees"][index]), line["why"][index]])
    title = (
        f"{line['condition']}, seed {line['seed']}, scene {line['scene']}: {line['gripper']}, {line['fps']:g} frames/s"
    )
    head = ("frame", "view", "verdict", "error mm", "PL mm", "error mrad", "PL mrad", "NEES", "hypothesis")
    alerts = [f"- frame {frame}: false alert: {text}" for frame, text in line["false_alerts"]]
    return [title, kit.table(head, rows), *(["\n".join(alerts)] if alerts else [])]
