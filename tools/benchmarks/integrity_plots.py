"""The Stanford diagram of ``tools/bench integrity``: each frame a point, its error across, its protection level up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from benchmarks.integrity_stats import collect

_RANGE_MM = (1e-4, 100.0)
_BINS = np.geomspace(*_RANGE_MM, 97)
_BAD, _WORSE, _UNAVAILABLE, _GOOD = "#f7c6c0", "#e88a80", "#fdf0c4", "#dff0dc"


def draw(lines: list[dict[str, Any]], file: Path) -> None:
    """All published frames with a bound, both axes logarithmic; outside of their range on the border."""
    frames, limit_mm = collect(lines), 1e3 * lines[0]["limit_m"]
    figure = Figure(figsize=(8.0, 7.4), layout="constrained")
    axes = figure.subplots()
    low, high = _RANGE_MM
    ends, inside = np.array([low, high]), np.array([low, limit_mm])
    axes.fill_between(ends, ends, high, color=_UNAVAILABLE, zorder=0)
    axes.fill_between(ends, low, ends, color=_BAD, zorder=0)
    axes.fill_between(inside, inside, limit_mm, color=_GOOD, zorder=0)
    axes.fill_between([limit_mm, high], low, limit_mm, color=_WORSE, zorder=0)
    known = np.isfinite(frames.error_m) & np.isfinite(frames.level_m)
    error, level = (np.clip(1e3 * x[known], low * 1.01, high * 0.99) for x in (frames.error_m, frames.level_m))
    counts, _, _ = np.histogram2d(error, level, bins=(_BINS, _BINS))
    shown, norm = np.ma.masked_less(counts.T, 0.5), LogNorm(1.0, max(counts.max(), 10.0))
    mesh = axes.pcolormesh(_BINS, _BINS, shown, norm=norm, cmap="viridis_r", zorder=2)
    figure.colorbar(mesh, ax=axes, label="frames")
    axes.plot(ends, ends, color="black", lw=1.0, zorder=3)
    for line in (axes.axhline, axes.axvline):
        line(limit_mm, color="black", lw=0.7, ls="--", zorder=3)
    for x, y, text in (
        (3e-4, limit_mm * 0.55, "good"),
        (3e-4, 40.0, "unavailable"),
        (0.03, 3e-4, "misleading: error > level"),
        (limit_mm * 1.3, 2e-3, "misleading:\nvalid, error > limit"),
    ):
        axes.text(x, y, text, fontsize=9, va="top", ha="left" if x < 0.01 or x > 0.1 else "center", zorder=4)
    axes.text(limit_mm * 1.05, low * 1.3, "alert limit", fontsize=7, rotation=90, va="bottom", zorder=4)
    axes.set(xscale="log", yscale="log", xlim=_RANGE_MM, ylim=_RANGE_MM)
    axes.set(title="all conditions", xlabel="error of the TCP's position (mm)", ylabel="protection level (mm)")
    figure.savefig(file, dpi=130)
