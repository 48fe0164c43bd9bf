"""The results of ``tools/bench accuracy`` as files: a report in Markdown, everything in JSON, and pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks import accuracy_plots
from benchmarks.accuracy_notes import TEXTURE, WHY
from benchmarks.accuracy_runs import Track
from benchmarks.accuracy_table import LEGEND, about, cells, number, percent, summary, triple
from benchmarks.rows import is_simulated

PICTURES = "accuracy"
_CAPTIONS = {
    "errors_simulated.png": "Error of every frame on the simulator",
    "errors_rendered.png": "Error of every frame of the rendered sequences",
    "peers.png": "Mean error and time of all methods",
    "honesty.png": "Consistency of the published covariance",
}
_METHOD = """\
Every row of the first table is a condition on the project's own simulator: several scenes, each with another pose, jaw
opening, gripper (two box fingers, tapered fingers, adaptive fingers that move on arcs), light, background and seed,
since systematic errors stay the same within a scene. A scene starts from a reference that is wrong by 0.1 mm
and 1 mrad on each axis (standard deviations), which the monitor is given as covariance; its first frame doesn't count.
The rendered sequences come from another renderer (not in this repository); their jaw opening is as
reported (rounded to 0.1 mm; the default `jaw_sigma_m`), then the true one.

The peers get the same frames: `cv2.cornerSubPix` from where their last pose puts the corners, then
`cv2.solvePnP`; `cv2.rapid` on a mesh of the fingers; two AprilTags printed onto the fingers of the same scene, found
by `cv2.aruco` (sub-pixel corners) and by `pyapriltags`, then `solvePnP`. A frame in which a peer is off by more than
2 mm counts as not given, not as an error."""


def write(results: dict[str, Any], tracks: dict[str, dict[str, Track]], folder: Path) -> None:
    """``accuracy.md``, ``accuracy.json`` and ``accuracy/*.png`` in a folder that is there."""
    pictures = accuracy_plots.draw(results["rows"], tracks, is_simulated, folder / PICTURES)
    (folder / "accuracy.md").write_text(as_markdown(results, pictures), encoding="utf-8")
    (folder / "accuracy.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def as_markdown(results: dict[str, Any], pictures: list[Path]) -> str:
    """The report for people."""
    rows = results["rows"]
    parts = [
        "# Accuracy",
        "Written by `tools/bench accuracy --out docs/results`; its `accuracy.json` isn't in the repository.",
        "\n".join(f"- {line}" for line in about(results)),
        _METHOD,
        "## Results",
        "\n".join(f"- {line}" for line in summary(results)),
        "\n".join(f"- {line}" for line in LEGEND),
        _ours(rows, "edges", "### By all inlier edgels (`measurement: edges`, the default)"),
        _ours(rows, "corners", "### By the corners and equation (17) (`measurement: corners`)"),
        _smoothed(rows),
        _unmet(rows),
        _peers(rows),
    ]
    if results.get("series"):
        verdicts = "\n".join(f"- {line}" for line in results["series"]["verdicts"])
        parts += ["## The paper's two series", results["series"]["markdown"], verdicts]
    parts.append("## Pictures")
    parts += [f"![{_CAPTIONS[path.name]}]({PICTURES}/{path.name})" for path in pictures]
    return "\n\n".join(part for part in parts if part) + "\n"


def _ours(rows: dict[str, Any], way: str, title: str) -> str:
    head = [
        "condition",
        "limit",
        "mean x / y / z",
        "95 %",
        "max",
        "rot",
        "given",
        "valid",
        "misleading",
        "NEES",
        "gate",
        "ms",
    ]
    head += ["99 %", "peer", "times", "verdict"]
    lines = [title, "", *_head(head)]
    for name, row in rows.items():
        if row["skipped"]:
            lines.append(_line([name, f"skipped: {row['skipped']}"]))
            continue
        texts = cells(row["ours"][way], row["limit_um"])
        lines.append(_line([name, texts[-1], *texts[:-1], f"**{row['ours'][way]['verdict']}**"]))
    return "\n".join(lines)


def _smoothed(rows: dict[str, Any]) -> str:
    """The average over time, one second after standing still."""
    lines = ["### Smoothed, one second after standing still", "", *_head(["condition", "edges", "", "corners", ""])]
    for name, row in rows.items():
        texts = [name]
        for f in row.get("ours", {}).values():
            texts += [triple(f["smoothed_um"]), f.get("smoothed_verdict", "")]
        if any(f["smoothed_um"] for f in row.get("ours", {}).values()):
            lines.append(_line(texts))
    return "\n".join(lines)


def _unmet(rows: dict[str, Any]) -> str:
    """Why a row's verdict is not ``met``, where that is known."""
    lines = [
        f"- {name}: {row['ours']['edges']['verdict']}. {WHY.get(name, 'Not looked into yet.')}"
        for name, row in rows.items()
        if not row["skipped"] and row["ours"]["edges"]["verdict"] != "met"
    ]
    return "\n".join(["### What is not met by edges, and why", "", TEXTURE, "", *(lines or ["Everything is."])])


def _peers(rows: dict[str, Any]) -> str:
    head = ["condition", "who", "mean x / y / z", "95 %", "max", "given", "ms", "99 %"]
    lines = ["### Others on the same frames", "", *_head(head)]
    for name, row in rows.items():
        for peer, f in row.get("peers", {}).items():
            errors = [triple(f[key]) for key in ("mean_um", "p95_um", "max_um")]
            times = [number(f["median_ms"], 2), number(f["p99_ms"], 2)]
            lines.append(_line([name, peer, *errors, percent(f["measured"]), *times]))
        lines += [_line([name, peer, why]) for peer, why in row.get("missing_peers", {}).items()]
    return "\n".join(lines) if len(lines) > 4 else ""


def _head(titles: list[str]) -> list[str]:
    return [_line(titles), _line(["---"] * len(titles))]


def _line(texts: list[str]) -> str:
    return f"| {' | '.join(texts)} |"
