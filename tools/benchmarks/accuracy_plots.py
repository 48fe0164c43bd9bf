"""Pictures of ``tools/bench accuracy``: errors over frames, everybody's errors and times, and honesty."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy_runs import Track
from benchmarks.accuracy_stats import FASTER, GATE, NEES_RANGE

_ACROSS, _ALONG, _DARK, _LIMIT = "#0072b2", "#d55e00", "#222222", "#009e73"
_WHO = {
    "edges": ("ours, edges", "o", "#0072b2"),
    "corners": ("ours, corners", "s", "#56b4e9"),
    "cornerSubPix": ("cornerSubPix + solvePnP", "v", "#d55e00"),
    "rapid": ("cv2.rapid", "^", "#e69f00"),
    "aruco": ("two tags, cv2.aruco", "x", "#999999"),
    "apriltag": ("two tags, pyapriltags", "+", "#222222"),
}
_COLUMNS = 5
_FLOOR_UM, _CEILING_UM = 0.05, 2000.0

Rows = dict[str, dict[str, Any]]


def draw(rows: Rows, tracks: dict[str, dict[str, Track]], fold: Callable[[str], bool], folder: Path) -> list[Path]:
    """Write all pictures; ``fold`` tells which rows are simulated."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    shown = {name: row for name, row in rows.items() if not row["skipped"]}
    simulated = [name for name in shown if fold(name)]
    others = [name for name in shown if not fold(name)]
    out = []
    for file, names in (("errors_simulated.png", simulated), ("errors_rendered.png", others)):
        if names:
            out.append(_errors(names, shown, tracks, folder / file))
    out.append(_peers(shown, folder / "peers.png"))
    out.append(_honesty(simulated or others, shown, tracks, folder / "honesty.png"))
    return out


def _errors(names: list[str], rows: Rows, tracks: dict[str, dict[str, Track]], path: Path) -> Path:
    """A panel a row: error across and along the optical axis over all its frames, scene after scene."""
    from matplotlib import pyplot

    lines = -(-len(names) // _COLUMNS)
    figure, axes = pyplot.subplots(
        lines, _COLUMNS, figsize=(3.4 * _COLUMNS, 2.1 * lines + 0.7), sharey=True, squeeze=False, layout="constrained"
    )
    for panel in axes.ravel()[len(names) :]:
        panel.set_visible(False)
    for panel, name in zip(axes.ravel(), names, strict=False):
        track = tracks[name]["edges"]
        place = np.arange(len(track.frame))
        across = 1e6 * np.hypot(track.error[:, 0], track.error[:, 1])
        along = 1e6 * np.abs(track.error[:, 2])
        for start in np.flatnonzero(np.diff(track.scene)) + 0.5:
            panel.axvline(start, color="0.85", linewidth=0.6, zorder=0)
        doubted = ~track.valid & track.judged
        panel.plot(place[doubted], np.full(doubted.sum(), 0.7 * _CEILING_UM), "|", color="#cc79a7", markersize=4)
        panel.plot(place, np.clip(across, _FLOOR_UM, _CEILING_UM), ".", color=_ACROSS, markersize=2)
        panel.plot(place, np.clip(along, _FLOOR_UM, _CEILING_UM), ".", color=_ALONG, markersize=2)
        limit = rows[name]["limit_um"]
        if limit:
            panel.axhline(np.hypot(limit[0], limit[1]), color=_ACROSS, linewidth=0.8, linestyle="--")
            panel.axhline(limit[2], color=_ALONG, linewidth=0.8, linestyle="--")
        panel.axhline(200.0, color="0.5", linewidth=0.6, linestyle=":")
        panel.set(yscale="log", ylim=(_FLOOR_UM, _CEILING_UM), xlim=(-0.5, len(place) - 0.5), xticks=[])
        panel.set_title(name, fontsize=9)
        panel.tick_params(labelsize=7)
    for panel in axes[:, 0]:
        panel.set_ylabel("TCP error, µm", fontsize=8)
    figure.suptitle(
        "Ours by edges, frame after frame.  Blue: across the optical axis, orange: along it; dashed: mean to reach\n"
        "Grey lines part the scenes; dotted: 0.2 mm; a pink tick at the top: not valid",
        fontsize=10,
    )
    return _saved(figure, path)


def _peers(rows: Rows, path: Path) -> Path:
    """Everybody's mean error and median time, a line for each row."""
    from matplotlib import pyplot

    names = list(rows)
    height = np.arange(len(names))[::-1]
    figure, (errors, times) = pyplot.subplots(
        1, 2, figsize=(14.0, 0.27 * len(names) + 1.6), sharey=True, layout="constrained", width_ratios=(3, 2)
    )
    for who, (label, marker, colour) in _WHO.items():
        style: dict[str, Any] = {"color": colour, "label": label, "linestyle": "", "marker": marker, "markersize": 5}
        errors.plot([_length(_of(rows[name], who), "mean_um") for name in names], height, **style)
        times.plot([_value(_of(rows[name], who), "median_ms") for name in names], height, **style)
    for y, name in zip(height.tolist(), names, strict=True):
        if rows[name]["limit_um"]:
            limit = float(np.linalg.norm(rows[name]["limit_um"]))
            errors.plot([limit, limit], [y - 0.4, y + 0.4], color=_LIMIT, linewidth=2.0)
        aruco = _value(_of(rows[name], "aruco"), "median_ms")
        times.plot([aruco / FASTER] * 2, [y - 0.4, y + 0.4], color=_LIMIT, linewidth=2.0)
    errors.set(xscale="log", xlabel="mean error of the TCP (root of x² + y² + z²), µm; green: to reach", yticks=height)
    errors.set_yticklabels(names, fontsize=8)
    times.set(xscale="log", xlabel="median time of a frame, ms; green: a fifteenth of ArUco's")
    for panel in (errors, times):
        panel.grid(axis="both", color="0.92", linewidth=0.6)
        panel.set_axisbelow(True)
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper center", ncols=len(_WHO), fontsize=8)
    return _saved(figure, path)


def _honesty(names: list[str], rows: Rows, tracks: dict[str, dict[str, Track]], path: Path) -> Path:
    """NEES of all valid frames against the distribution that a true covariance gives, and its mean in each row."""
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(
        1, 2, figsize=(13.0, max(0.25 * len(names) + 1.5, 4.0)), layout="constrained", width_ratios=(2, 3)
    )
    bins = np.geomspace(0.05, 500.0, 60)
    for way, colour in (("edges", _WHO["edges"][2]), ("corners", _WHO["corners"][2])):
        nees = np.concatenate([_sure(tracks[name][way]) for name in names])
        if len(nees):
            shares = np.histogram(np.clip(nees, bins[0], bins[-1]), bins)[0] / len(nees)
            left.stairs(shares, bins, color=colour, label=f"by {way}, {len(nees)} valid frames")
    left.stairs(np.diff(_chi_square_6(bins)), bins, color=_DARK, linestyle="--", label="true covariance (χ², 6)")
    left.axvline(GATE, color="0.5", linewidth=0.8, linestyle=":")
    left.set(xscale="log", xlabel="squared normalised error (dotted: the 99.9 % gate)", ylabel="share of frames")
    left.legend(fontsize=8)
    height = np.arange(len(names))[::-1]
    right.axvspan(*NEES_RANGE, color=_LIMIT, alpha=0.2)
    for way in ("corners", "edges"):
        label, marker, colour = _WHO[way]
        values = [_value(rows[name]["ours"][way], "nees") for name in names]
        right.plot(values, height, marker, color=colour, label=label, markersize=5)
    right.set(xscale="log", xlabel="mean squared normalised error of valid frames; green: to reach", yticks=height)
    right.set_yticklabels(names, fontsize=8)
    right.grid(color="0.92", linewidth=0.6)
    right.set_axisbelow(True)
    right.legend(fontsize=8)
    return _saved(figure, path)


def _of(row: dict[str, Any], who: str) -> dict[str, Any] | None:
    found: dict[str, Any] | None = row["ours"].get(who) or row["peers"].get(who)
    return found


def _length(figures: dict[str, Any] | None, key: str) -> float:
    if figures is None or figures[key] is None:
        return float("nan")
    return float(np.linalg.norm(figures[key]))


def _value(figures: dict[str, Any] | None, key: str) -> float:
    return float("nan") if figures is None or figures[key] is None else float(figures[key])


def _sure(track: Track) -> NDArray[np.floating[Any]]:
    return track.nees[track.judged & track.valid & np.isfinite(track.nees)]


def _chi_square_6(values: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Its distribution function."""
    half = 0.5 * values
    return 1.0 - np.exp(-half) * (1.0 + half + 0.5 * half**2)


def _saved(figure: Any, path: Path) -> Path:
    from matplotlib import pyplot

    figure.savefig(path, dpi=80)
    pyplot.close(figure)
    return path
