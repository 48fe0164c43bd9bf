"""``tools/bench integrity``: the lines of all scenes become figures, a report, and pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from benchmarks import integrity_table, machine
from benchmarks.integrity_runs import about
from benchmarks.integrity_stats import by_scale, figures, targets, worst

PICTURES = "integrity"


def summarize(lines: list[dict[str, Any]], seed: int, scenes: int, frames: int) -> dict[str, Any]:
    """Figures of each condition and of all, as plain values; ``scenes`` of each condition, ``frames`` of each scene."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        by_name.setdefault(line["condition"], []).append(line)
    total = figures(lines)
    return {
        "machine": machine.description(),
        "commits": sorted({line["commit"] for line in lines}),
        "plan": {"seed": seed, "scenes": scenes, "frames": frames},
        "valid_by": sorted({line["valid_by"] for line in lines}),
        "limits_m": _range([line["limit_m"] for line in lines]),
        "limits_rad": _range([line["limit_rad"] for line in lines]),
        "rows": {name: {"what": about(name), **figures(own)} for name, own in by_name.items()},
        "total": total,
        "scales": by_scale(lines),
        "targets": [{"target": what, "reached": reached, "met": met} for what, reached, met in targets(total)],
        "worst": worst(lines),
    }


def _range(values: list[float]) -> list[float]:
    return [min(values), max(values)]


def write(results: dict[str, Any], lines: list[dict[str, Any]], folder: Path) -> None:
    """``integrity.md``, ``integrity.json`` and ``integrity/*.png`` in a folder that is there."""
    from benchmarks import integrity_plots

    pictures = integrity_plots.draw(lines, folder / PICTURES)
    text = integrity_table.as_markdown(results, [picture.name for picture in pictures])
    (folder / "integrity.md").write_text(text, encoding="utf-8")
    (folder / "integrity.json").write_text(json.dumps(_finite(results), indent=1) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """The same with null for what is infinite: JSON has no word for it."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and math.isinf(value) else value
