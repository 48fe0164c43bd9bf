"""Our own monitor, and peers, over the sequences of ``tools/bench accuracy``, and what their errors come to."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import kit
from benchmarks.conditions import CLEAN, Limit
from benchmarks.drawn import reference_record
from benchmarks.peers import LOST_M, MARKERLESS, PEERS, timed
from benchmarks.scenes import Sequence, Shot
from gripmon.judge.drift import DriftSettings
from gripmon.judge.policy import PolicySettings
from gripmon.model.geometry import from_record, make_transform, perturbation_between, rotation_from_xyzw
from gripmon.model.records import Array, FrameRecord, Origin, Verdict
from gripmon.monitor import Monitor, MonitorSettings

WAYS = ("edges", "corners")
"""Both values of ``monitor.measurement``."""
GATE = 22.46
"""Chi-square of six degrees of freedom that one value in a thousand exceeds."""
NEES_RANGE, IN_GATE = (4.5, 7.5), 0.99
SMOOTHED_AFTER_S = 1.0
ALERT_LIMIT_M = PolicySettings().alert_limit_m
_NOTHING6, _NOTHING3 = np.full(6, np.nan), np.full(3, np.nan)

Figures = dict[str, Any]


class Row(NamedTuple):
    """One frame of a :class:`Track`."""

    scene: int
    frame: int
    judged: bool
    valid: bool
    misleading: bool
    error: Array
    smoothed: Array
    nees: float
    time_ms: float


@dataclass
class Track:
    """What one estimator made of the frames, an array element a frame.

    ``error`` (n, 6): perturbation from the estimate to the truth, m and rad, camera axes, NaN where it gave nothing
    new; ``smoothed`` (n, 3) the same of the smoothed position; ``nees`` (n,) the squared normalised error (NaN without
    a covariance); ``valid``: verdict; ``misleading``: valid, yet farther off than the alert limit or its own bound.
    """

    scene: NDArray[np.intp]
    frame: NDArray[np.intp]
    judged: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    misleading: NDArray[np.bool_]
    error: Array
    smoothed: Array
    nees: Array
    time_ms: Array

    @classmethod
    def of(cls, rows: list[Row]) -> Track:
        return cls(**{field.name: np.array([getattr(row, field.name) for row in rows]) for field in fields(cls)})

    @property
    def measured(self) -> NDArray[np.bool_]:
        return np.isfinite(self.error[:, 0])


def monitor_for(sequence: Sequence, way: str) -> Monitor:
    """A monitor as a user would set it up for the sequence's camera, gripper and calibration."""
    known = {} if sequence.jaw_sigma_m is None else {"jaw_sigma_m": sequence.jaw_sigma_m}
    settings = MonitorSettings(measurement=way, drift=DriftSettings(frames_per_s=sequence.fps), **known)  # type: ignore[arg-type]
    start = reference_record(sequence.start_cam_T_grip, sequence.start_covariance, 0)
    return Monitor(sequence.camera, sequence.gripper, settings, start, sequence.taught)


def judge(record: FrameRecord, shot: Shot, scene: int, index: int, time_ms: float) -> Row:
    """A record against the truth.  NEES = error' covariance^-1 error, in the published convention."""
    error, nees, off_m, smoothed = _NOTHING6, np.nan, 0.0, _NOTHING3
    if record.cam_T_grip is not None and record.covariance is not None:
        published = perturbation_between(from_record(record.cam_T_grip), shot.cam_T_grip)
        off_m = float(np.linalg.norm(published[:3]))
        if record.source is not Origin.HELD:
            error, nees = published, float(kit.nees(published, np.reshape(record.covariance, (6, 6))))
    if record.smoothed is not None:
        s = record.smoothed
        smooth_T = make_transform(rotation_from_xyzw(s.rotation_xyzw), np.array(s.translation_m))
        smoothed = perturbation_between(smooth_T, shot.cam_T_grip)[:3]
    valid = record.verdict is Verdict.VALID
    bound_m = np.inf if record.protection is None else record.protection.position_m
    misleading = valid and off_m > min(ALERT_LIMIT_M, bound_m)
    return Row(scene, index, shot.judged, valid, misleading, error, smoothed, nees, time_ms)


class PeerRun:
    """One peer on one sequence."""

    def __init__(self, sequence: Sequence, name: str, scene: int) -> None:
        self._scene, self._gripper, self._peer = scene, sequence.gripper, PEERS[name](sequence)
        self.tagged = self._peer.tagged

    def add(self, index: int, shot: Shot, image: NDArray[np.uint8]) -> Row:
        """A pose that lies beyond belief counts as none."""
        gripper, jaw_m = self._gripper, shot.frame.jaw_opening_m
        jaw_m = gripper.jaw_nominal_m if jaw_m is None else min(max(jaw_m, gripper.jaw_min_m), gripper.jaw_max_m)
        pose, time_ms = timed(self._peer, image, jaw_m)
        error = _NOTHING6 if pose is None else perturbation_between(pose, shot.cam_T_grip)
        if np.linalg.norm(error[:3]) > LOST_M:
            error = _NOTHING6
        return Row(self._scene, index, shot.judged, False, False, error, _NOTHING3, np.nan, time_ms)


def run(sequences: Iterable[Sequence], peers: tuple[str, ...]) -> dict[str, Track]:
    """Both of our ways, and peers by name, over all sequences, on the same frames."""
    rows: dict[str, list[Row]] = {name: [] for name in (*WAYS, *peers)}
    for number, sequence in enumerate(sequences):
        ours = {way: monitor_for(sequence, way) for way in WAYS}
        others = {name: PeerRun(sequence, name, number) for name in peers}
        tags = any(other.tagged for other in others.values())
        for index, shot in enumerate(sequence.shots()):
            for way, monitor in ours.items():
                start_ns = time.thread_time_ns()  # of this thread's processor: others on the machine don't count
                record = monitor.process(shot.frame)
                rows[way].append(judge(record, shot, number, index, 1e-6 * (time.thread_time_ns() - start_ns)))
            plain = np.asarray(shot.frame.image, np.uint8)
            tagged = sequence.tagged(index, shot) if tags else plain
            for name, other in others.items():
                rows[name].append(other.add(index, shot, tagged if other.tagged else plain))
    return {name: Track.of(track) for name, track in rows.items()}


def peer_figures(track: Track) -> Figures:
    """What a peer has, too; lengths in µm, times in ms: neither verdict nor covariance.  Frames in which it is lost
    count as not given.
    """
    judged, measured = track.judged, track.judged & track.measured
    error_um = 1e6 * np.abs(track.error[measured, :3])
    times_ms = np.percentile(track.time_ms[judged], [50.0, 99.0]).tolist() if judged.any() else [None, None]
    return {
        "measured": _share(track.measured[judged]),
        "mean_um": over(error_um, "mean"),
        "p95_um": over(error_um, "p95"),
        "max_um": over(error_um, "max"),
        "median_ms": times_ms[0],
        "p99_ms": times_ms[1],
    }


def figures(track: Track, fps: float, limit_um: Limit | None, *, always_seen: bool, standing: bool) -> Figures:
    """Plain values of one of our ways on one condition; lengths in µm, rotations in millidegrees, times in ms.

    Errors are those of judged frames that gave a new transform; ``misleading`` is over all frames, judged or not.
    """
    judged, measured = track.judged, track.judged & track.measured
    turn_mdeg = 1e3 * np.rad2deg(np.linalg.norm(track.error[measured, 3:], axis=1))
    sure = measured & track.valid & np.isfinite(track.nees)
    out: Figures = peer_figures(track) | {
        "frames": int(judged.sum()),
        "scenes": len(set(track.scene.tolist())),
        "valid": _share(track.valid[judged]),
        "misleading": _share(track.misleading),
        "rotation_mdeg": float(turn_mdeg.mean()) if len(turn_mdeg) else None,
        "nees": float(track.nees[sure].mean()) if sure.any() else None,
        "in_gate": _share(track.nees[sure] < GATE),
        "sure": int(sure.sum()),
        "smoothed_um": None,
    }
    if standing:
        late = track.judged & (track.frame >= SMOOTHED_AFTER_S * fps) & np.isfinite(track.smoothed[:, 0])
        out["smoothed_um"] = over(1e6 * np.abs(track.smoothed[late]), "mean")
        out["smoothed_verdict"] = factor_text(out["smoothed_um"], CLEAN) or "met"
    out["verdict"] = None if limit_um is None else verdict(out, limit_um, always_seen=always_seen)
    return out


def against_peers(ours: Figures, peers: dict[str, Figures]) -> Figures:
    """Our mean error over that of the best markerless peer, on the worst axis (at most a third is to be reached), and
    how often our median time fits into that of the ArUco detector (15 times).
    """
    best = [peers[name]["mean_um"] for name in MARKERLESS if name in peers and peers[name]["mean_um"] is not None]
    out: Figures = {"of_best_peer": None, "times_faster": None}
    if best and ours["mean_um"] is not None:
        out["of_best_peer"] = float(np.max(np.array(ours["mean_um"]) / np.min(best, axis=0)))
    if "aruco" in peers and ours["median_ms"]:
        out["times_faster"] = peers["aruco"]["median_ms"] / ours["median_ms"]
    return out


def verdict(row: Figures, limit_um: Limit, *, always_seen: bool) -> str:
    """``met``, or by which factor the mean error exceeds the limit on the worst axis, and what else is wrong: frames
    without a transform where the gripper shows (lost), misleading ones, a covariance that is not true.
    """
    faults = [factor_text(row["mean_um"], limit_um)]
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
    inside = [row["in_gate"] if row["sure"] else 0.0 for row in rows]
    return {
        "nees": float(np.average([row["nees"] or 0.0 for row in rows], weights=weights)),
        "in_gate": float(np.average(inside, weights=weights)),
        "sure": int(weights.sum()),
        "met": sum(row["mean_um"] is not None and not factor_text(row["mean_um"], row["limit_um"]) for row in rows),
        "limited": len(rows),
    }


def _share(flags: Any) -> float:
    return float(np.mean(flags)) if len(flags) else float("nan")


def over(values: Any, how: str) -> list[float] | None:
    """Mean, 95 % or largest of the columns of (n, 3); None for none."""
    if not len(values):
        return None
    if how == "mean":
        return np.mean(values, axis=0).tolist()
    return np.percentile(values, {"p95": 95.0, "max": 100.0}[how], axis=0).tolist()
