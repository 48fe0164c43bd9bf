"""What the runs came to, as a table, and what was to be reached."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks import kit
from benchmarks.kit import Report

from servoing import controller, eye, stage
from servoing.figures import LABELS, Figures, figures, renewed_on_the_way, targets
from servoing.runs import TRUTH, Run

_TOO_MANY = 0.1  # share of frames that are missing from which the figures are the machine's
_HEAD = (
    "knocked by", "transform", "distance, median (mm)", "worst", "across, worst", "along, worst", "above truth, median",
    "worst", "grasped", "moved on `unknown`",
)  # fmt: skip


def show(runs: Sequence[Run], report: Report) -> None:
    every = figures(runs)
    missed, seen = sum(run.missed for run in runs), sum(len(run.time_s) for run in runs)
    report.values["rows"] = every
    report.say(
        f"approach from {1e3 * stage.DISTANCE_M:g} mm in {stage.APPROACH_S:g} s, the mount is knocked after "
        f"{stage.BUMP_S - stage.BEGIN_S:g} s; object seen to {eye.SIGMA_PX:g} px; gain {controller.GAIN_PER_S:g} /s",
        f"frames of which nothing came: {missed} of {missed + seen}; runs with a new reference before the fingers "
        f"closed: {sum(map(renewed_on_the_way, runs))} of {len(runs)}",
        kit.table(_HEAD, [_cells(each) for each in every]),
    )
    report.reach(targets(every))
    stopped = sum(each.stopped_by_range for each in every)
    if stopped:
        report.say(f"a joint's range stopped an arm in {stopped} runs: their distances are the arm's")
    if missed > _TOO_MANY * (missed + seen):
        report.say("too many frames are missing, so that this measures the machine; without --realtime none is skipped")


def _cells(each: Figures) -> list[str]:
    mm = [np.median(each.final_m), each.final_m.max(), each.across_m.max(), each.along_m.max()]
    worse = ["", ""] if each.source == TRUTH else [_mm(np.median(each.worse_m)), _mm(each.worse_m.max())]
    unknown = sum(c.unknown for c in each.conduct)
    moved = f"{sum(c.moved_on_unknown for c in each.conduct)} of {unknown}" if unknown else "–"
    return [each.row, LABELS[each.source], *map(_mm, mm), *worse, f"{each.grasped} of {each.runs}", moved]


def _mm(value_m: float) -> str:
    return f"{1e3 * float(value_m):.3f}"
