"""Stanford diagrams: each frame a point, its error across, its protection level up, both logarithmic."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from benchmarks.integrity_stats import Frames, collect

mpl.use("Agg")

_RANGE_MM = (1e-4, 100.0)
_BINS = np.geomspace(*_RANGE_MM, 97)
_COLUMNS, _ROWS = 5, 4
_BAD, _WORSE = "#f7c6c0", "#e88a80"
_UNAVAILABLE, _GOOD = "#fdf0c4", "#dff0dc"


def draw(lines: list[dict[str, Any]], folder: Path) -> list[Path]:
    """One diagram of all frames, and small ones of each condition."""
    limit_mm = 1e3 * lines[0]["limit_m"]
    figure = Figure(figsize=(8.0, 7.4), layout="constrained")
    axes = figure.subplots()
    _diagram(axes, collect(lines), limit_mm, labelled=True)
    axes.set_title("all conditions")
    axes.set_xlabel("error of the TCP's position (mm)")
    axes.set_ylabel("protection level (mm)")
    written = [folder / "all.png"]
    figure.savefig(written[0], dpi=130)
    by_name: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        by_name.setdefault(line["condition"], []).append(line)
    names, page = list(by_name), _COLUMNS * _ROWS
    for number in range(math.ceil(len(names) / page)):
        part = names[number * page : (number + 1) * page]
        written.append(folder / f"conditions_{number + 1}.png")
        _page({name: collect(by_name[name]) for name in part}, limit_mm, written[-1])
    return written


def _page(parts: dict[str, Frames], limit_mm: float, file: Path) -> None:
    rows = math.ceil(len(parts) / _COLUMNS)
    figure = Figure(figsize=(3.2 * _COLUMNS, 3.1 * rows), layout="constrained")
    grid = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
    for axes, (name, frames) in zip(grid.flat, parts.items(), strict=False):
        _diagram(axes, frames, limit_mm, labelled=False)
        misleading = int((frames.lies | frames.unbounded).sum())
        axes.set_title(f"{name}\n{misleading} of {len(frames.view)} misleading", fontsize=9)
    for axes in grid.flat[len(parts) :]:
        axes.set_visible(False)
    figure.supxlabel("error of the TCP's position (mm)")
    figure.supylabel("protection level (mm)")
    figure.savefig(file, dpi=100)


def _diagram(axes: Axes, frames: Frames, limit_mm: float, *, labelled: bool) -> None:
    """Every published frame with a bound; outside the axes' range it lies on their border."""
    low, high = _RANGE_MM
    known = np.isfinite(frames.error_m) & np.isfinite(frames.level_m)
    error, level = (np.clip(1e3 * x[known], low * 1.01, high * 0.99) for x in (frames.error_m, frames.level_m))
    ends = np.array([low, high])
    axes.fill_between(ends, ends, high, color=_UNAVAILABLE, zorder=0)
    axes.fill_between(ends, low, ends, color=_BAD, zorder=0)
    inside = np.array([low, limit_mm])
    axes.fill_between(inside, inside, limit_mm, color=_GOOD, zorder=0)
    axes.fill_between([limit_mm, high], low, limit_mm, color=_WORSE, zorder=0)
    if known.any():
        counts, _, _ = np.histogram2d(error, level, bins=(_BINS, _BINS))
        shown = np.ma.masked_less(counts.T, 0.5)
        mesh = axes.pcolormesh(
            _BINS, _BINS, shown, norm=LogNorm(1.0, max(counts.max(), 10.0)), cmap="viridis_r", zorder=2
        )
        if labelled:
            assert axes.figure is not None
            axes.figure.colorbar(mesh, ax=axes, label="frames")
    axes.plot(ends, ends, color="black", lw=1.0, zorder=3)
    axes.axhline(limit_mm, color="black", lw=0.7, ls="--", zorder=3)
    axes.axvline(limit_mm, color="black", lw=0.7, ls="--", zorder=3)
    axes.set(xscale="log", yscale="log", xlim=_RANGE_MM, ylim=_RANGE_MM)
    size = 9 if labelled else 6
    texts = (
        (3e-4, limit_mm * 0.55, "good"),
        (3e-4, 40.0, "unavailable"),
        (0.03, 3e-4, "misleading: error > level"),
        (limit_mm * 1.3, 2e-3, "misleading:\nvalid, error > limit"),
    )
    for x, y, text in texts:
        axes.text(x, y, text, fontsize=size, va="top", ha="left" if x < 0.01 or x > 0.1 else "center", zorder=4)
    if labelled:
        axes.text(limit_mm * 1.05, low * 1.3, "alert limit", fontsize=7, rotation=90, va="bottom", zorder=4)
