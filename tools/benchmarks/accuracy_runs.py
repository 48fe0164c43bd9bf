"""Our own monitor over the sequences of ``tools/bench accuracy``: each frame's error, claimed covariance and time."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes import Sequence, Shot
from gripmon.geometry import from_record, make_transform, perturbation_between, rotation_from_xyzw, to_record
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.policy import PolicySettings
from gripmon.records import Array, FrameRecord, Origin, ReferenceRecord, Verdict

WAYS = ("edges", "corners")
"""Both values of ``monitor.measurement``."""


@dataclass
class Track:
    """What one estimator made of the frames, an array element a frame.

    ``error`` (n, 6): perturbation from the estimate to the truth, m and rad, camera axes, NaN where it gave nothing
    new; ``smoothed`` (n, 3) the same of the smoothed position; ``nees`` (n,) the squared normalised error (NaN without
    a covariance); ``valid``: verdict; ``far`` (n,): distance of whatever was published from the truth, m.
    """

    scene: NDArray[np.intp]
    frame: NDArray[np.intp]
    judged: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    error: Array
    smoothed: Array
    nees: Array
    far: Array
    time_ms: Array

    @classmethod
    def of(cls, rows: list[Row]) -> Track:
        return cls(
            np.array([r.scene for r in rows], dtype=np.intp),
            np.array([r.frame for r in rows], dtype=np.intp),
            np.array([r.judged for r in rows], dtype=bool),
            np.array([r.valid for r in rows], dtype=bool),
            np.array([r.error for r in rows]).reshape(-1, 6),
            np.array([r.smoothed for r in rows]).reshape(-1, 3),
            np.array([r.nees for r in rows]),
            np.array([r.far for r in rows]),
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
    error: Array
    smoothed: Array
    nees: float
    far: float
    time_ms: float


NOTHING6, NOTHING3 = np.full(6, np.nan), np.full(3, np.nan)


class OurRun:
    """One monitor on one sequence."""

    def __init__(self, sequence: Sequence, way: str, scene: int) -> None:
        self._scene = scene
        self._monitor = monitor_for(sequence, way)

    def add(self, index: int, shot: Shot) -> Row:
        start_ns = time.perf_counter_ns()
        record = self._monitor.process(shot.frame)
        time_ms = 1e-6 * (time.perf_counter_ns() - start_ns)
        return judge(record, shot, self._scene, index, time_ms)


def monitor_for(sequence: Sequence, way: str) -> Monitor:
    """A monitor as a user would set it up for the sequence's camera, gripper and calibration."""
    known = {} if sequence.jaw_sigma_m is None else {"jaw_sigma_m": sequence.jaw_sigma_m}
    settings = MonitorSettings(measurement=way, policy=PolicySettings(frames_per_s=sequence.fps), **known)  # type: ignore[arg-type]
    covariance = tuple(sequence.start_covariance.ravel().tolist())
    reference = ReferenceRecord("start", 0, 0, "configuration", to_record(sequence.start_cam_T_grip), covariance)
    return Monitor(sequence.camera, sequence.gripper, settings, reference)


def judge(record: FrameRecord, shot: Shot, scene: int, index: int, time_ms: float) -> Row:
    """A record against the truth.  NEES = error' covariance^-1 error, in the published convention."""
    error, nees, far, smoothed = NOTHING6, np.nan, np.nan, NOTHING3
    if record.cam_T_grip is not None and record.covariance is not None:
        published = perturbation_between(from_record(record.cam_T_grip), shot.cam_T_grip)
        far = float(np.linalg.norm(published[:3]))
        if record.source is not Origin.HELD:
            error = published
            nees = float(error @ np.linalg.solve(np.reshape(record.covariance, (6, 6)), error))
    if record.smoothed is not None:
        s = record.smoothed
        smooth_T = make_transform(rotation_from_xyzw(s.rotation_xyzw), np.array(s.translation_m))
        smoothed = perturbation_between(smooth_T, shot.cam_T_grip)[:3]
    valid = record.verdict is Verdict.VALID
    return Row(scene, index, shot.judged, valid, error, smoothed, nees, far, time_ms)


def run_ours(sequences: Iterable[Sequence]) -> dict[str, Track]:
    """Both ways over all sequences, on the same frames."""
    rows: dict[str, list[Row]] = {way: [] for way in WAYS}
    for number, sequence in enumerate(sequences):
        runs = {way: OurRun(sequence, way, number) for way in WAYS}
        for index, shot in enumerate(sequence.shots()):
            for way, run in runs.items():
                rows[way].append(run.add(index, shot))
    return {way: Track.of(track) for way, track in rows.items()}
