"""From tracks to the figures of a row of ``tools/bench accuracy``."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.accuracy_runs import Track
from benchmarks.conditions import CLEAN, Limit
from benchmarks.peers import MARKERLESS

GATE = 22.46
"""Chi-square of six degrees of freedom that one value in a thousand exceeds."""
NEES_RANGE, IN_GATE = (4.5, 7.5), 0.99
SMOOTHED_AFTER_S = 1.0

FASTER = 15.0
"""To reach: ArUco's time over ours."""

Figures = dict[str, Any]


def figures(track: Track, fps: float, limit_um: Limit | None, *, always_seen: bool, standing: bool) -> Figures:
    """Plain values of one estimator on one condition; lengths in µm, rotations in millidegrees, times in ms.

    Errors are those of judged frames that gave a new transform; ``misleading`` is over all frames, judged or not.
    """
    judged, measured = track.judged, track.judged & track.measured
    error_um = 1e6 * np.abs(track.error[measured, :3])
    turn_mdeg = 1e3 * np.rad2deg(np.linalg.norm(track.error[measured, 3:], axis=1))
    sure = measured & track.valid & np.isfinite(track.nees)
    out: Figures = {
        "frames": int(judged.sum()),
        "scenes": len(set(track.scene.tolist())),
        "measured": share(track.measured[judged]),
        "valid": share(track.valid[judged]),
        "misleading": share(track.misleading),
        "mean_um": over(error_um, "mean"),
        "p95_um": over(error_um, "p95"),
        "max_um": over(error_um, "max"),
        "rotation_mdeg": float(turn_mdeg.mean()) if len(turn_mdeg) else None,
        "nees": float(track.nees[sure].mean()) if sure.any() else None,
        "in_gate": share(track.nees[sure] < GATE),
        "sure": int(sure.sum()),
        "median_ms": float(np.median(track.time_ms[judged])) if judged.any() else None,
        "p99_ms": float(np.percentile(track.time_ms[judged], 99.0)) if judged.any() else None,
        "smoothed_um": None,
    }
    if standing:
        late = track.judged & (track.frame >= SMOOTHED_AFTER_S * fps) & np.isfinite(track.smoothed[:, 0])
        out["smoothed_um"] = over(1e6 * np.abs(track.smoothed[late]), "mean")
        out["smoothed_verdict"] = factor_text(out["smoothed_um"], CLEAN) or "met"
    out["verdict"] = None if limit_um is None else verdict(out, limit_um, always_seen=always_seen)
    return out


def peer_figures(track: Track) -> Figures:
    """The same of a peer: it has neither verdict nor covariance.  Frames in which it is lost count as not given."""
    judged, measured = track.judged, track.judged & track.measured
    error_um = 1e6 * np.abs(track.error[measured, :3])
    return {
        "measured": share(track.measured[judged]),
        "mean_um": over(error_um, "mean"),
        "p95_um": over(error_um, "p95"),
        "max_um": over(error_um, "max"),
        "median_ms": float(np.median(track.time_ms[judged])) if judged.any() else None,
        "p99_ms": float(np.percentile(track.time_ms[judged], 99.0)) if judged.any() else None,
    }


def against_peers(ours: Figures, peers: dict[str, Figures]) -> Figures:
    """Our mean error over that of the best markerless peer, on the worst axis (at most a third is to be reached), and
    how often our median time fits into that of the ArUco detector (15 times).
    """
    best = [peers[name]["mean_um"] for name in MARKERLESS if name in peers and peers[name]["mean_um"] is not None]
    out: Figures = {"of_best_peer": None, "times_faster": None}
    if best and ours["mean_um"] is not None:
        least = np.min(best, axis=0)
        out["of_best_peer"] = float(np.max(np.array(ours["mean_um"]) / least))
    if "aruco" in peers and ours["median_ms"]:
        out["times_faster"] = peers["aruco"]["median_ms"] / ours["median_ms"]
    return out


def verdict(row: Figures, limit_um: Limit, *, always_seen: bool) -> str:
    """``met``, or by which factor the mean error exceeds the limit on the worst axis, and what else is wrong: frames
    without a transform where the gripper shows (lost), misleading ones, a covariance that is not true.
    """
    faults = [] if row["mean_um"] is None else [factor_text(row["mean_um"], limit_um)]
    if always_seen and row["measured"] < 1.0:
        faults.append(f"lost {100.0 * (1.0 - row['measured']):.1f} %")
    if row["misleading"] > 0.0:
        faults.append(f"misleading {100.0 * row['misleading']:.1f} %")
    if row["nees"] is not None and (row["nees"] > NEES_RANGE[1] or row["in_gate"] < IN_GATE):
        faults.append("covariance too small")
    elif row["nees"] is not None and row["nees"] < NEES_RANGE[0]:
        faults.append("covariance too large")
    return ", ".join(f for f in faults if f) or "met"


def factor_text(mean_um: list[float] | None, limit_um: Limit) -> str:
    """By which factor the worst axis exceeds its limit; empty if none does."""
    if mean_um is None:
        return ""
    factor = max(value / limit for value, limit in zip(mean_um, limit_um, strict=True))
    return f"{factor:.1f} x the limit" if factor > 1.0 else ""


def together(rows: list[Figures]) -> Figures:
    """NEES over all valid frames of several rows, and how many rows meet their limit."""
    weights = np.array([row["sure"] for row in rows], float)
    if not weights.sum():
        return {"nees": None, "in_gate": None, "sure": 0, "met": 0, "limited": len(rows)}
    nees = [row["nees"] or 0.0 for row in rows]
    inside = [row["in_gate"] if row["sure"] else 0.0 for row in rows]
    return {
        "nees": float(np.average(nees, weights=weights)),
        "in_gate": float(np.average(inside, weights=weights)),
        "sure": int(weights.sum()),
        "met": sum(row["mean_um"] is not None and not factor_text(row["mean_um"], row["limit_um"]) for row in rows),
        "limited": len(rows),
    }


def share(flags: Any) -> float:
    return float(np.mean(flags)) if len(flags) else float("nan")


def over(values: Any, how: str) -> list[float] | None:
    """Mean, 95 % or largest of the columns of (n, 3); None for none."""
    if not len(values):
        return None
    function = {"mean": np.mean, "p95": lambda v, axis: np.percentile(v, 95.0, axis=axis), "max": np.max}[how]
    return [float(v) for v in function(values, axis=0)]  # type: ignore[operator]
