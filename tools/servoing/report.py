"""The figures as a table, and as plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from servoing import controller, eye, stage
from servoing.figures import LABELS, Figures, Target, renewed_on_the_way
from servoing.runs import TRUTH, Run

_LABEL, _COLUMN = 26, 12
_TOO_MANY = 0.1  # share of frames that are missing from which the figures are the machine's


def as_text(machine: dict[str, Any], runs: Sequence[Run], every: Sequence[Figures], reached: Sequence[Target]) -> str:
    """The whole report."""
    missed, seen = sum(run.missed for run in runs), sum(len(run.time_s) for run in runs)
    approach = f"approach from {1e3 * stage.DISTANCE_M:g} mm in {stage.APPROACH_S:g} s"
    knocked = f"the mount is knocked after {stage.BUMP_S - stage.BEGIN_S:g} s"
    lines = [
        f"gripmon {machine['commit']}, {machine['date']}, {machine['cpu']}, {machine['cpus']} cores",
        f"{approach}, {knocked}; object seen to {eye.SIGMA_PX:g} px; gain {controller.GAIN_PER_S:g} /s",
        f"frames of which nothing came: {missed} of {missed + seen}",
        f"runs with a new reference before the fingers closed: {sum(map(renewed_on_the_way, runs))} of {len(runs)}",
    ]
    row = ""
    for each in every:
        if each.row != row:
            row = each.row
            lines += ["", *_head(f"{row}, {each.runs} runs")]
        lines.append(_line(each))
    lines += ["", "targets", *(f"  {t.what}: {t.measured}   {'met' if t.met else 'NOT MET'}" for t in reached)]
    stopped = sum(each.stopped_by_range for each in every)
    if stopped:
        lines.append(
            f"  a joint's range stopped an arm in {stopped} runs: those distances are the arm's, not the transform's"
        )
    if missed > _TOO_MANY * (missed + seen):
        lines.append(
            "  too many frames are missing, so that this measures the machine; without --realtime none is skipped"
        )
    return "\n".join(lines)


def _head(title: str) -> list[str]:
    upper = ("median", "worst", "across", "along", "above truth", "above truth", "grasped", "moved on")
    lower = ("", "", "worst", "worst", "median", "worst", "", "unknown")
    return [title, _row("distance at the end (mm)", *upper), _row("", *lower)]


def _line(each: Figures) -> str:
    mm = [np.median(each.final_m), each.final_m.max(), each.across_m.max(), each.along_m.max()]
    worse = ["", ""] if each.source == TRUTH else [_mm(np.median(each.worse_m)), _mm(each.worse_m.max())]
    unknown = sum(c.unknown for c in each.conduct)
    moved = f"{sum(c.moved_on_unknown for c in each.conduct)} of {unknown}" if unknown else "–"
    return _row(f"  {LABELS[each.source]}", *map(_mm, mm), *worse, f"{each.grasped} of {each.runs}", moved)


def _mm(value_m: Any) -> str:
    return f"{1e3 * float(value_m):.3f}"


def _row(label: str, *values: str) -> str:
    return label.ljust(_LABEL) + "".join(value.rjust(_COLUMN) for value in values)


def markdown(every: Sequence[Figures]) -> str:
    """The table for a document."""
    lines = [
        "| knocked by | transform | distance, median (mm) | worst | above truth, median | worst | moved on `unknown` |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for each in every:
        worse = ("", "") if each.source == TRUTH else (_mm(np.median(each.worse_m)), _mm(each.worse_m.max()))
        unknown = sum(c.unknown for c in each.conduct)
        moved = f"{sum(c.moved_on_unknown for c in each.conduct)} of {unknown}" if unknown else "–"
        cells = [each.row, LABELS[each.source], _mm(np.median(each.final_m)), _mm(each.final_m.max()), *worse, moved]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def as_values(machine: dict[str, Any], every: Sequence[Figures], reached: Sequence[Target]) -> dict[str, Any]:
    """Everything that was measured, for JSON."""
    rows = []
    for each in every:
        values = {f.name: getattr(each, f.name) for f in dataclasses.fields(each)}
        values = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}
        values["conduct"] = [dataclasses.asdict(c) for c in each.conduct]
        rows.append(values)
    return {"machine": machine, "rows": rows, "targets": [dataclasses.asdict(t) for t in reached]}
