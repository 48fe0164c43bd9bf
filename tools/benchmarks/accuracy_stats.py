"""From tracks to the figures of a row of ``tools/bench accuracy``."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.accuracy_runs import Track
from benchmarks.conditions import Limit

WRONG_M = 2e-4
"""A valid transform further from the truth than this is a lie."""
GATE = 22.46
"""Chi-square of six degrees of freedom that one value in a thousand exceeds."""
NEES_RANGE = (4.5, 7.5)
SMOOTHED_AFTER_S = 1.0

Figures = dict[str, Any]


def figures(track: Track, fps: float, limit_um: Limit | None, *, always_seen: bool, standing: bool) -> Figures:
    """Plain values of one estimator on one condition; lengths in µm, rotations in millidegrees, times in ms.

    Errors are those of judged frames that gave a new transform; ``wrong`` is over all frames, judged or not.
    """
    judged, measured = track.judged, track.judged & track.measured
    error_um = 1e6 * np.abs(track.error[measured, :3])
    turn_mdeg = 1e3 * np.rad2deg(np.linalg.norm(track.error[measured, 3:], axis=1))
    sure = measured & track.valid & np.isfinite(track.nees)
    wrong = track.valid & (track.far > WRONG_M)
    out: Figures = {
        "frames": int(judged.sum()),
        "scenes": len(set(track.scene.tolist())),
        "measured": share(track.measured[judged]),
        "valid": share(track.valid[judged]),
        "wrong": share(wrong),
        "wrong_frames": [[int(s), int(f)] for s, f in zip(track.scene[wrong], track.frame[wrong], strict=True)],
        "mean_um": over(error_um, "mean"),
        "p95_um": over(error_um, "p95"),
        "max_um": over(error_um, "max"),
        "rotation_mdeg": float(turn_mdeg.mean()) if len(turn_mdeg) else None,
        "nees": float(track.nees[sure].mean()) if sure.any() else None,
        "in_gate": share(track.nees[sure] < GATE),
        "median_ms": float(np.median(track.time_ms[judged])) if judged.any() else None,
        "p99_ms": float(np.percentile(track.time_ms[judged], 99.0)) if judged.any() else None,
        "smoothed_um": None,
    }
    if standing:
        late = track.judged & (track.frame >= SMOOTHED_AFTER_S * fps) & np.isfinite(track.smoothed[:, 0])
        out["smoothed_um"] = over(1e6 * np.abs(track.smoothed[late]), "mean")
    out["verdict"] = None if limit_um is None else verdict(out, limit_um, always_seen=always_seen)
    return out


def verdict(row: Figures, limit_um: Limit, *, always_seen: bool) -> str:
    """``met``, or by which factor the mean error exceeds the limit on the worst axis, and what else is wrong."""
    faults = []
    if row["mean_um"] is None:
        return "nothing measured"
    factor = max(value / limit for value, limit in zip(row["mean_um"], limit_um, strict=True))
    if factor > 1.0:
        faults.append(f"{factor:.1f} x")
    if always_seen and row["measured"] < 1.0:
        faults.append(f"lost {100.0 * (1.0 - row['measured']):.1f} %")
    if row["wrong"] > 0.0:
        faults.append("lies")
    return ", ".join(faults) if faults else "met"


def share(flags: Any) -> float:
    return float(np.mean(flags)) if len(flags) else float("nan")


def over(values: Any, how: str) -> list[float] | None:
    """Mean, 95 % or largest of the columns of (n, 3); None for none."""
    if not len(values):
        return None
    function = {"mean": np.mean, "p95": lambda v, axis: np.percentile(v, 95.0, axis=axis), "max": np.max}[how]
    return [float(v) for v in function(values, axis=0)]  # type: ignore[operator]
