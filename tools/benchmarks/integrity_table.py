"""The results of ``tools/bench integrity`` in words: a table, the targets, the worst frames."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.integrity_limits import POSITIONS_M
from benchmarks.integrity_stats import VIEWS, targets

HEAD = (
    "condition",
    "scenes",
    "frames",
    "> AL",
    "at most",
    "> PL",
    "at most",
    "suspect > PL",
    "> AL, > PL in scenes",
    "err/PL",
    "valid: free %",
    "both tips %",
    "one tip %",
    "no tip %",
    *(f"{1e3 * limit_m:g} mm %" for limit_m in POSITIONS_M),
    "PL µm",
    "since µm",
    "absolute µm",
    "error µm",
    "PL/error",
    "NEES",
    "first",
    "never",
    "back %",
    "latest",
    "knock",
    "alerts",
)
LEGEND = tuple(
    """\
> AL, > PL: valid frames whose error (TCP position, or rotation) exceeds the alert limit, or the frame's own \
protection level; at most: exact 95 % upper bound on the rate, as if frames were independent; in scenes: with at least \
one of each; err/PL: the largest error of a valid frame over its protection level
suspect > PL: published with a bound but not valid, and beyond the bound
valid: share where the whole gripper is seen, where something hides part of it but both tips' outlines are seen, where \
one tip is hidden, and where both are; without conditions in which the gripper differs from its file, without the \
frames just after a jump or after the view became free
0.5, 1, 2 mm: the same, of all views, were that the position's alert limit: by the bounds, nothing is run again
PL µm, error µm: medians of valid frames; since, absolute: of both bounds, where they are published; NEES: mean of \
valid frames
first: median of the frames until the first valid one; never: scenes without one
back: valid within 3 frames after the view is free again; latest: the most frames that it took
knock: medians of the frames from a jump of the mount until an alert says it, until the gripper is measured where it \
is, and from then until it is valid; x: not before the end
alerts: new ones that name a wrong cause: the mount, another camera, a finger, the opening, the lens""".splitlines()
)

_POSSIBLE = (
    "possible: share of the same frames in which the published covariance alone, with normal errors, would allow a "
    "protection level within the alert limit"
)


def cells(name: str, row: dict[str, Any]) -> list[str]:
    """A condition's line."""
    return [
        name,
        str(row["scenes"]),
        str(row["frames"]),
        str(row["lies"]),
        f"{row['lies_at_most']:.1g}",
        str(row["unbounded"]),
        f"{row['unbounded_at_most']:.1g}",
        str(row["suspect_unbounded"]),
        f"{row['lies_scenes']}, {row['unbounded_scenes']}",
        number(row["worst_excess"]),
        *(percent(share) for share in row["available"]),
        *(percent(share) for share in row["within"]),
        microns(row["median_level_m"]),
        *(microns(level_m) for level_m in row["median_both_m"]),
        microns(row["median_error_m"]),
        number(row["level_over_error"]),
        number(row["nees"]),
        number(row["first_valid"]),
        str(row["never_valid"]),
        percent(row["back"]),
        number(row["latest_back"]),
        knock(row),
        str(row["false_alerts"]),
    ]


def knock(row: dict[str, Any]) -> str:
    """Frames until a jump of the mount is said, found, and valid again."""
    if not row["knocks"]:
        return "–"
    times = (row[f"knock_{what}"] for what in ("said", "found", "valid"))
    return "/".join("x" if math.isinf(frames) else f"{frames:g}" for frames in times)


def percent(share: float | None) -> str:
    return "–" if share is None else f"{100.0 * share:.1f}"


def microns(length_m: float | None) -> str:
    return "–" if length_m is None else f"{1e6 * length_m:.3g}"


def number(value: float | None) -> str:
    if value is None:
        return "–"
    return "never" if math.isinf(value) else f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}"


def table(results: dict[str, Any]) -> list[list[str]]:
    """Head, a line for each condition, and one for all together."""
    rows = [cells(name, row) for name, row in results["rows"].items()]
    return [list(HEAD), *rows, cells("all", results["total"])]


SCALE_HEAD = ("scale at the TCP, jaw", "scenes", "free: valid %", "possible %", "both tips: valid %", "possible %")
SCALE_HEAD += ("one tip: valid %", "possible %", "PL µm", "error µm", "misleading scenes")


def scale_table(results: dict[str, Any]) -> list[list[str]]:
    """Availability by image scale; possible: the covariance alone would allow a level within the alert limit."""
    rows = [list(SCALE_HEAD)]
    for row in results["scales"]:
        end = "and more" if math.isinf(row["high"]) else f"to {row['high']:g}"
        jaw = "opening exact" if row["jaw_exact"] else "opening as reported"
        shares = [percent(row[key][view]) for view in range(3) for key in ("available", "possible")]
        levels = [microns(row["median_level_m"]), microns(row["median_error_m"])]
        name = f"{row['low']:g} {end} px/mm, {jaw}"
        rows.append([name, str(row["scenes"]), *shares, *levels, str(row["misleading_scenes"])])
    return rows


def target_lines(total: dict[str, Any]) -> list[str]:
    words = {True: "met", False: "MISSED", None: "not judged"}
    return [f"{what}: {reached} - {words[met]}" for what, reached, met in targets(total)]


def worst_lines(worst: list[dict[str, Any]]) -> list[str]:
    """How to see each of the worst frames again, and what it was."""
    lines = []
    for item in worst:
        level = "none"
        if item["level_m"] is not None:
            level = f"{1e3 * item['level_m']:.3g} mm and {1e3 * item['level_rad']:.3g} mrad"
        verdict = "valid" if item["valid"] else "suspect"
        lines.append(
            f'--only "{item["condition"]}" --seed {item["seed"]} --scene {item["scene"]}: frame {item["frame"]}, '
            f"{verdict}, error {1e3 * item['error_m']:.3g} mm and {1e3 * item['error_rad']:.3g} mrad, "
            f"protection level {level}, {item['view']}"
            f"{'; ' + item['why'] if item['why'] else ''}; {item['misleading']} misleading frames in this scene"
        )
    return lines


def frame_lines(line: dict[str, Any]) -> list[str]:
    """One scene frame by frame."""
    rows = [["frame", "view", "verdict", "error mm", "PL mm", "error mrad", "PL mrad", "NEES", "hypothesis"]]
    for index, view in enumerate(line["view"]):
        values = [line[key][index] for key in ("error_m", "level_m", "error_rad", "level_rad")]
        scaled = ["–" if value is None else f"{1e3 * value:.3g}" for value in values]
        verdict = "valid" if line["valid"][index] else "suspect" if values[0] is not None else "unknown"
        rows.append([str(index), VIEWS[view], verdict, *scaled, number(line["nees"][index]), line["why"][index]])
    title = (
        f"{line['condition']}, seed {line['seed']}, scene {line['scene']}: {line['gripper']}, {line['fps']:g} frames/s"
    )
    alerts = [f"frame {frame}: false alert: {text}" for frame, text in line["false_alerts"]]
    return [title, aligned(rows), *alerts, ""]


def aligned(rows: list[list[str]]) -> str:
    """Columns of equal width; the first to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        padded = [
            cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(padded))
    return "\n".join(lines)


def as_text(results: dict[str, Any]) -> str:
    """The report on the terminal."""
    parts = [
        *about(results),
        "",
        aligned(table(results)),
        "",
        *LEGEND,
        "",
        aligned(scale_table(results)),
        _POSSIBLE,
        "",
        *target_lines(results["total"]),
        "",
        "worst frames, one of each scene:",
        *worst_lines(results["worst"]),
    ]
    return "\n".join(parts)


def as_markdown(results: dict[str, Any], pictures: list[str]) -> str:
    """The report as a file."""
    parts = [
        "# Integrity",
        "Written by `tools/bench integrity --out DIR`; the figures behind it: `integrity.json` beside it.",
        "\n".join(f"- {line}" for line in about(results)),
        _markdown_table(table(results)),
        "\n".join(f"- {line}" for line in LEGEND),
        "## Availability by image scale",
        _markdown_table(scale_table(results)),
        _POSSIBLE,
        "## Targets",
        "\n".join(f"- {line}" for line in target_lines(results["total"])),
        "## Worst frames",
        "\n".join(f"- `{line.replace(': frame', '`: frame', 1)}" for line in worst_lines(results["worst"])),
        *(f"![Stanford diagram](integrity/{name})" for name in pictures),
        "## Conditions",
        "\n".join(f"- {name}: {row['what']}" for name, row in results["rows"].items()),
    ]
    return "\n\n".join(parts) + "\n"


def _markdown_table(rows: list[list[str]]) -> str:
    head, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([head, "|" + "---|" * len(rows[0]), *rest])


def about(results: dict[str, Any]) -> list[str]:
    """Where, when and on what this was measured."""
    machine, plan = results["machine"], results["plan"]
    seconds = results["total"]["seconds"]
    each_s = seconds / max(results["total"]["scenes"], 1)
    (low_m, high_m), rads = results["limits_m"], results["limits_rad"]
    degrees = " to ".join(f"{math.degrees(limit_rad):.2g}" for limit_rad in rads)
    kept = results["total"]["promised"]
    beyond = (
        f"valid by the {' and '.join(results['valid_by'])} bound; of {kept['scenes']} promised scenes beyond it: "
        f"{kept['unbounded_scenes']} (95 %: at most {100.0 * kept['unbounded_scenes_at_most']:.2g} % of such scenes)"
    )
    return [
        f"commit {', '.join(results['commits'])}, {machine['date']}, {machine['cpu']}",
        f"seed {plan['seed']}, {plan['scenes']} scenes a condition, {plan['frames']} frames a scene",
        f"alert limits, fixed beforehand: {1e3 * low_m:.3g} to {1e3 * high_m:.3g} mm and {degrees} degrees",
        beyond,
        f"{each_s:.1f} s a scene, {seconds / 60.0:.1f} min in all",
    ]
