"""Picture of ``tools/bench offline``: errors by plate and way, and what reveals a gripper off the plate."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.offline_plane import Errors, Revealed

_COLOURS = {"known": "#0072b2", "inferred": "#d55e00", "single": "#009e73"}
_LABELS = {"known": "gripper known", "inferred": "gripper inferred", "single": "camera from the same image"}


def draw(errors: list[Errors], revealed: list[Revealed], path: Path) -> None:
    """Write the picture."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    from matplotlib import pyplot

    figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(13.0, 4.6), layout="constrained")
    for row in errors:
        if not row.error:
            continue
        size = row.position_mm
        style = "-" if row.plate == "perfect" else "--"
        share = np.linspace(0.0, 1.0, len(size) + 1)[1:]
        label = f"{_LABELS[row.way]}, {row.plate}"
        across = np.sort(np.hypot(size[:, 0], size[:, 1]))
        left.plot(1e3 * across, share, style, color=_COLOURS[row.way], label=label)
        middle.plot(1e3 * np.sort(size[:, 2]), share, style, color=_COLOURS[row.way])
    for panel, what, limit in ((left, "across", 20.0), (middle, "along", 50.0)):
        panel.axvline(limit, color="#222222", linewidth=0.8)
        panel.set(xscale="log", xlabel=f"TCP error {what} the optical axis (µm)", ylim=(0.0, 1.0))
    left.set(ylabel="part of the trials")
    # Below: the curves fill their panels.  By columns, so that each way stands above itself on a printed plate.
    figure.legend(*_by_way(left), fontsize=9, loc="outside lower left", ncols=3)
    _draw_apart(right, revealed)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _by_way(panel: Any) -> tuple[list[Any], list[str]]:
    """Lines and labels, the plates of each way beside each other: a legend fills column by column."""
    lines, labels = panel.get_legend_handles_labels()
    ways = list(_LABELS.values())
    order = sorted(range(len(labels)), key=lambda k: (ways.index(labels[k].split(", ")[0]), k))
    return [lines[k] for k in order], [labels[k] for k in order]


def _draw_apart(panel: Any, revealed: list[Revealed]) -> None:
    kinds = list(dict.fromkeys(row.what for row in revealed))
    for kind, colour in zip(kinds, ("#999999", "#0072b2", "#56b4e9", "#d55e00"), strict=False):
        rows = [row for row in revealed if row.what == kind and row.count]
        told = [100.0 * max(row.by_apart, row.by_residuals) / row.count for row in rows]
        panel.plot([row.noise_dn for row in rows], told, "o-", color=colour, label=kind)
    panel.set(xscale="log", xlabel="noise of the image (DN)", ylabel="detected (% of the images)", ylim=(-3, 103))
    noises = sorted({row.noise_dn for row in revealed})
    panel.set_xticks(noises, labels=[f"{noise:g}" for noise in noises])
    panel.minorticks_off()
    panel.legend(fontsize=8)
