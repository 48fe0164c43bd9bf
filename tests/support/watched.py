"""Whole sequences: rendered once a run, watched by a monitor, held beside their truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.model.camera import make_camera
from gripmon.model.records import (
    AlertKind,
    Frame,
    FrameRecord,
    MonitorState,
    Origin,
    ReferenceRecord,
    Transform,
    Verdict,
)
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import FrameTruth, Scenario, make_scenario, paper_rig
from gripmon.simulate.scenario import Background, Cover, Creep
from support.kept import kept
from support.meters import box_gripper, difference
from support.simulated import PAPER_LENS, nominal_cam_T_grip

FPS = 30.0
SCENES = {
    "static": make_scenario("static", duration_s=1.5, fps=FPS),
    "clutter": make_scenario("clutter", duration_s=1.5, fps=FPS),
    "creep": Scenario(
        name="creep",
        duration_s=3.2,
        fps=FPS,
        mount=(Creep(start_s=1.2, time_s=0.75, tcp_shift_m=(0.0015, 0.0003)),),
        background=Background(kind="speckle"),
    ),
    "bump": make_scenario("bump", duration_s=3.0, fps=FPS),
    "lighting": make_scenario("lighting", duration_s=4.0, fps=FPS),
    "bent_finger": make_scenario("bent_finger", duration_s=3.0, fps=FPS),
    "hand": Scenario(name="hand", duration_s=4.0, fps=15.0, covers=(Cover(start_s=0.7, end_s=3.2, move_s=0.3),)),
}


def pose_of(transform: Transform) -> np.ndarray:
    """(4, 4) by SciPy, whose quaternions are x, y, z, w."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(transform.rotation_xyzw).as_matrix()
    pose[:3, 3] = transform.translation_m
    return pose


def reference_of(cam_T_grip: np.ndarray) -> ReferenceRecord:
    """A calibration good to 2 micrometres and 0.1 mrad."""
    transform = Transform(
        tuple(cam_T_grip[:3, 3].tolist()), tuple(Rotation.from_matrix(cam_T_grip[:3, :3]).as_quat().tolist())
    )
    covariance = np.diag(np.square([2e-6] * 3 + [1e-4] * 3))
    return ReferenceRecord("factory-1", 1, 0, "test", transform, tuple(covariance.ravel().tolist()))


def new_monitor(settings: MonitorSettings | None = None, cam_T_grip: np.ndarray | None = None) -> Monitor:
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    return Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), settings or MonitorSettings(), reference_of(pose))


def restarted(state: MonitorState) -> Monitor:
    """A new monitor that goes on from a state, as it comes back from its file."""
    back = msgspec.json.decode(msgspec.json.encode(state), type=MonitorState)
    reference = reference_of(nominal_cam_T_grip())
    return Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), MonitorSettings(), reference, state=back)


@lru_cache(maxsize=16)
def frames_of(scene: str) -> tuple[tuple[Frame, ...], tuple[FrameTruth, ...]]:
    return rendered(SCENES[scene])


def rendered(scenario: Scenario) -> tuple[tuple[Frame, ...], tuple[FrameTruth, ...]]:
    frames, truths = _rendered(scenario)
    for frame in frames:
        assert frame.image is not None
        frame.image.flags.writeable = False
    return frames, truths


@kept
def _rendered(scenario: Scenario) -> tuple[tuple[Frame, ...], tuple[FrameTruth, ...]]:
    simulator = paper_rig(box_gripper(sharp=False)).simulator(scenario, 1)
    frames = tuple(simulator.frame(i) for i in range(simulator.frame_count))
    return frames, tuple(simulator.truth(i) for i in range(len(frames)))


@dataclass(frozen=True)
class Watched:
    """What a monitor made of a scene."""

    records: tuple[FrameRecord, ...]
    truths: tuple[FrameTruth, ...]
    references: tuple[ReferenceRecord, ...]

    def errors(self) -> np.ndarray:
        """(n, 6) from the published transform to the truth; NaN where there is none or it is held."""
        out = np.full((len(self.records), 6), np.nan)
        for i, (record, truth) in enumerate(zip(self.records, self.truths, strict=True)):
            if record.cam_T_grip is not None and record.source is not Origin.HELD:
                out[i] = difference(pose_of(record.cam_T_grip), truth.cam_T_grip)
        return out

    def nees(self) -> np.ndarray:
        """(n,) squared errors in units of the published covariance; NaN where there is no transform at all."""
        out = np.full(len(self.records), np.nan)
        for i, (record, truth) in enumerate(zip(self.records, self.truths, strict=True)):
            if record.cam_T_grip is not None:
                error = difference(pose_of(record.cam_T_grip), truth.cam_T_grip)
                out[i] = error @ np.linalg.solve(np.reshape(record.covariance, (6, 6)), error)
        return out

    def alerts(self) -> list[tuple[int, AlertKind]]:
        return [(record.seq, alert.kind) for record in self.records for alert in record.alerts]

    def verdicts(self) -> list[Verdict]:
        return [record.verdict for record in self.records]


def watch(frames: tuple[Frame, ...], truths: tuple[FrameTruth, ...], monitor: Monitor) -> Watched:
    records, references = [], []
    for frame in frames:
        records.append(monitor.process(frame))
        references.append(monitor.reference)
    return Watched(tuple(records), truths, tuple(references))


@lru_cache(maxsize=16)
def watched(scene: str, measurement: str = "edges") -> Watched:
    # A few corners are less certain than the edges: what counts as sure has to be less, too.
    sure = RecalibrationSettings(**({"sure_sigma_m": 1e-4} if measurement == "corners" else {}))
    settings = MonitorSettings(measurement=measurement, recalibration=sure)  # type: ignore[arg-type]
    return watch(*frames_of(scene), new_monitor(settings))


def replaced(frame: Frame, **values: object) -> Frame:
    return Frame(**{name: values.get(name, getattr(frame, name)) for name in Frame.__slots__})  # type: ignore[arg-type]


def without_latency(record: FrameRecord) -> FrameRecord:
    return msgspec.structs.replace(record, latency_ns=0)
