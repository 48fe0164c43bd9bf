"""A picture: distance over time of the four arms, and the monitor's verdicts."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gripmon.model.records import Verdict
from servoing import stage
from servoing.figures import LABELS
from servoing.runs import GRIPMON, SMOOTHED, TRUTH, WITHOUT, Run

_COLOURS = {WITHOUT: "#d55e00", GRIPMON: "#0072b2", SMOOTHED: "#56b4e9", TRUTH: "#222222"}
_STYLES = {WITHOUT: "-", GRIPMON: "-", SMOOTHED: "--", TRUTH: ":"}
_BANDS = {Verdict.SUSPECT: ("#f0e442", 0.35), Verdict.UNKNOWN: ("#cc79a7", 0.45)}
_FLOOR_MM = 1e-3


def draw(runs: Sequence[Run], path: Path) -> None:
    """One run of each row, the first.  Raises OSError if the file can't be written."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    from matplotlib import pyplot
    from matplotlib.patches import Patch

    shown = list({run.row.name: run for run in reversed(runs)}.values())[::-1]
    figure, axes = pyplot.subplots(1, len(shown), figsize=(4.2 * len(shown), 4.0), sharey=True, squeeze=False)
    for panel, run in zip(axes[0], shown, strict=True):
        _panel(panel, run)
    axes[0][0].set_ylabel("distance of the TCP from the object (mm)")
    handles, labels = axes[0][0].get_legend_handles_labels()
    handles += [Patch(color=colour, alpha=alpha, linewidth=0) for colour, alpha in _BANDS.values()]
    labels += [f"verdict {verdict}" for verdict in _BANDS]
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), frameon=False)
    figure.tight_layout(rect=(0.0, 0.07, 1.0, 1.0))
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _panel(panel: object, run: Run) -> None:
    time_s, verdicts = run.time_s, np.array(run.verdict)
    ends_s = np.append(time_s[1:], 2.0 * time_s[-1] - time_s[-2])
    for verdict, (colour, alpha) in _BANDS.items():
        for k in np.flatnonzero(verdicts == verdict).tolist():
            panel.axvspan(time_s[k], ends_s[k], color=colour, alpha=alpha, linewidth=0)  # type: ignore[attr-defined]
    panel.axvline(stage.BUMP_S, color="#999999", linewidth=0.8)  # type: ignore[attr-defined]
    for source, track in run.tracks.items():
        distance_mm = np.maximum(1e3 * track.distance_m, _FLOOR_MM)
        style = {"color": _COLOURS[source], "linestyle": _STYLES[source], "linewidth": 1.3}
        panel.plot(time_s, distance_mm, label=LABELS[source], **style)  # type: ignore[attr-defined]
        if track.grasped[-1]:
            first = track.grasped.index(True)
            panel.plot(time_s[first], distance_mm[first], "o", color=_COLOURS[source], markersize=4)  # type: ignore[attr-defined]
    panel.set_yscale("log")  # type: ignore[attr-defined]
    panel.grid(alpha=0.3)  # type: ignore[attr-defined]
    panel.set_xlabel("time (s); dot: fingers close")  # type: ignore[attr-defined]
    panel.set_title(f"mount knocked by {run.row.name}", fontsize=10)  # type: ignore[attr-defined]
