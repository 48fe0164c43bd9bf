"""One trial of ``tools/bench causes``: a monitor sees its frames, and in the end a cause is told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.causes_trials import START_SIGMA, Trial
from gripmon.camera import make_camera
from gripmon.causes import CauseJudge, CauseSettings
from gripmon.drift import DriftSettings
from gripmon.geometry import to_record
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.recalibrate import RecalibrationSettings
from gripmon.records import Array, Cause, Frame, FrameRecord, ReferenceRecord
from gripmon.stream import StreamWatch

LAST = 6
"""Newest frames of which most decide whether images are refused."""


@dataclass(frozen=True)
class Told:
    """What was told in the end: ``cause`` UNKNOWN also where nothing seems wrong, ``part`` the finger, ``causes`` as
    in an alert, in words.
    """

    cause: Cause
    part: str | None
    causes: tuple[tuple[str, str | None, float], ...]
    text: str


def run(trial: Trial) -> Told:
    """Show a trial to a monitor with a judge and a stream watch beside it."""
    rig = trial.rig
    camera = make_camera(rig.camera_settings)
    reference = ReferenceRecord(
        "start", 1, 0, "configuration", to_record(rig.start_cam_T_grip), tuple(np.diag(START_SIGMA**2).ravel().tolist())
    )
    settings = MonitorSettings(
        jaw_sigma_m=rig.jaw_sigma_m,
        drift=DriftSettings(frames_per_s=rig.scenario.fps),
        recalibration=RecalibrationSettings(mode="off"),
    )
    monitor = Monitor(camera, rig.gripper, settings, reference)
    judge = CauseJudge(
        camera, rig.gripper, CauseSettings(), START_SIGMA, settings.jaw_sigma_m, settings.jaw_offset_sigma_m
    )
    stream = StreamWatch()
    records: list[FrameRecord] = []
    faults = []
    for index, frame in enumerate(trial.frames()):
        for fault in stream.add(frame):
            # What happened at some time counts, also when it is over.
            if fault.kind == "gap":
                judge.interrupted()
            else:
                faults.append(fault)
        records.append(monitor.process(frame))
        _judge(monitor, judge, rig.start_cam_T_grip, frame, index < trial.well)
    if faults:
        return Told(faults[0].cause, None, (), faults[0].text)
    return _told(judge, rig.start_cam_T_grip, records[-LAST:])


def _judge(monitor: Monitor, judge: CauseJudge, ref_cam_T_grip: Array, frame: Frame, well: bool) -> None:
    measurement = monitor._newest
    if measurement is None or (well and not (measurement.trusted and judge.wants_baseline)):
        return
    evidence = monitor._tracker.evidence(frame, measurement, ref_cam_T_grip)
    (judge.well if well else judge.add)(evidence)


def _told(judge: CauseJudge, ref_cam_T_grip: Array, newest: list[FrameRecord]) -> Told:
    refused = [r for r in newest if r.reason is not None and ": " in r.reason]
    if 2 * len(refused) > len(newest):
        return Told(Cause.IMAGE_BAD, None, (), refused[-1].reason or "")
    explanation = judge.explanation(ref_cam_T_grip)
    weights = tuple((c.cause.value, c.part, c.probability) for c in explanation.causes)
    return Told(explanation.probable.cause, explanation.probable.part, weights, explanation.text)
