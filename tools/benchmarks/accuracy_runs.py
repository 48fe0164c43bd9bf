"""Our own monitor, and peers, over the sequences of ``tools/bench accuracy``: each frame's error, covariance, time."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import LOST_M, PEERS, timed
from benchmarks.scenes import Sequence, Shot
from gripmon.judge.drift import DriftSettings
from gripmon.judge.policy import PolicySettings
from gripmon.model.geometry import from_record, make_transform, perturbation_between, rotation_from_xyzw, to_record
from gripmon.model.records import Array, FrameRecord, Origin, ReferenceRecord, Verdict
from gripmon.monitor import Monitor, MonitorSettings

WAYS = ("edges", "corners")
"""Both values of ``monitor.measurement``."""


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
        return cls(
            np.array([r.scene for r in rows], dtype=np.intp),
            np.array([r.frame for r in rows], dtype=np.intp),
            np.array([r.judged for r in rows], dtype=bool),
            np.array([r.valid for r in rows], dtype=bool),
            np.array([r.misleading for r in rows], dtype=bool),
            np.array([r.error for r in rows]).reshape(-1, 6),
            np.array([r.smoothed for r in rows]).reshape(-1, 3),
            np.array([r.nees for r in rows]),
            np.array([r.time_ms for r in rows]),
        )

    @property
    def measured(self) -> NDArray[np.bool_]:
        return np.isfinite(self.error[:, 0])


@dataclass(frozen=True)
class Row:
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


ALERT_LIMIT_M = PolicySettings().alert_limit_m
NOTHING6, NOTHING3 = np.full(6, np.nan), np.full(3, np.nan)


class OurRun:
    """One monitor on one sequence."""

    def __init__(self, sequence: Sequence, way: str, scene: int) -> None:
        self._scene = scene
        self._monitor = monitor_for(sequence, way)

    def add(self, index: int, shot: Shot) -> Row:
        start_ns = time.thread_time_ns()  # of this thread's processor: others on the machine don't count
        record = self._monitor.process(shot.frame)
        time_ms = 1e-6 * (time.thread_time_ns() - start_ns)
        return judge(record, shot, self._scene, index, time_ms)


def monitor_for(sequence: Sequence, way: str) -> Monitor:
    """A monitor as a user would set it up for the sequence's camera, gripper and calibration."""
    known = {} if sequence.jaw_sigma_m is None else {"jaw_sigma_m": sequence.jaw_sigma_m}
    settings = MonitorSettings(measurement=way, drift=DriftSettings(frames_per_s=sequence.fps), **known)  # type: ignore[arg-type]
    covariance = tuple(sequence.start_covariance.ravel().tolist())
    reference = ReferenceRecord("start", 0, 0, "configuration", to_record(sequence.start_cam_T_grip), covariance)
    return Monitor(sequence.camera, sequence.gripper, settings, reference, sequence.taught)


def judge(record: FrameRecord, shot: Shot, scene: int, index: int, time_ms: float) -> Row:
    """A record against the truth.  NEES = error' covariance^-1 error, in the published convention."""
    error, nees, off_m, smoothed = NOTHING6, np.nan, 0.0, NOTHING3
    if record.cam_T_grip is not None and record.covariance is not None:
        published = perturbation_between(from_record(record.cam_T_grip), shot.cam_T_grip)
        off_m = float(np.linalg.norm(published[:3]))
        if record.source is not Origin.HELD:
            error = published
            nees = float(error @ np.linalg.solve(np.reshape(record.covariance, (6, 6)), error))
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
        error = NOTHING6 if pose is None else perturbation_between(pose, shot.cam_T_grip)
        if np.linalg.norm(error[:3]) > LOST_M:
            error = NOTHING6
        return Row(self._scene, index, shot.judged, False, False, error, NOTHING3, np.nan, time_ms)


def run(sequences: Iterable[Sequence], peers: tuple[str, ...]) -> dict[str, Track]:
    """Both of our ways, and peers by name, over all sequences, on the same frames."""
    rows: dict[str, list[Row]] = {name: [] for name in (*WAYS, *peers)}
    for number, sequence in enumerate(sequences):
        ours = {way: OurRun(sequence, way, number) for way in WAYS}
        others = {name: PeerRun(sequence, name, number) for name in peers}
        tags = any(other.tagged for other in others.values())
        for index, shot in enumerate(sequence.shots()):
            for way, own in ours.items():
                rows[way].append(own.add(index, shot))
            plain = np.asarray(shot.frame.image, np.uint8)
            tagged = sequence.tagged(index, shot) if tags else plain
            for name, other in others.items():
                rows[name].append(other.add(index, shot, tagged if other.tagged else plain))
    return {name: Track.of(track) for name, track in rows.items()}
