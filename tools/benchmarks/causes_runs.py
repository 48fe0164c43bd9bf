"""One trial of ``tools/bench causes``: a monitor sees its frames, and what its alerts name in the end is taken down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.causes_trials import Trial
from benchmarks.drawn import REFERENCE_SIGMA
from gripmon.judge.drift import DriftSettings
from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.model.camera import make_camera
from gripmon.model.geometry import to_record
from gripmon.model.records import Alert, AlertEvent, Cause, ReferenceRecord
from gripmon.monitor import Monitor, MonitorSettings


@dataclass(frozen=True)
class Told:
    """``last``: causes in the alerts open at the end, ``ever``: in any alert since it went wrong, each
    a cause and a finger.  ``text`` and ``causes`` (cause, finger, probability) of the alert that named one, or of the
    last.
    """

    last: frozenset[tuple[Cause, str | None]]
    ever: frozenset[tuple[Cause, str | None]]
    causes: tuple[tuple[str, str | None, float], ...]
    text: str


def run(trial: Trial) -> Told:
    """Show a trial to a monitor."""
    rig = trial.rig
    covariance = tuple(np.diag(REFERENCE_SIGMA**2).ravel().tolist())
    reference = ReferenceRecord("start", 1, 0, "configuration", to_record(rig.start_cam_T_grip), covariance)
    settings = MonitorSettings(
        jaw_sigma_m=rig.jaw_sigma_m,
        drift=DriftSettings(frames_per_s=rig.scenario.fps),
        recalibration=RecalibrationSettings(mode="off"),
    )
    monitor = Monitor(make_camera(rig.camera_settings), rig.gripper, settings, reference)
    newest: dict[str, Alert] = {}
    ever: set[tuple[Cause, str | None]] = set()
    for index, frame in enumerate(trial.frames()):
        record = monitor.process(frame)
        for alert in record.alerts:
            if alert.event in (AlertEvent.RAISED, AlertEvent.UPDATED) and index >= trial.well:
                ever.add((alert.cause, alert.part))
            newest[alert.alert_id or alert.kind] = alert
    # Also what was over by then: a clock that was set once is right again.
    alerts = [a for a in newest.values() if a.event is not AlertEvent.NOTED]
    named = [a for a in alerts if a.cause is not Cause.UNKNOWN]
    alert = (named or alerts or [None])[-1]
    return Told(
        frozenset((a.cause, a.part) for a in alerts),
        frozenset(ever),
        () if alert is None else tuple((c.cause.value, c.part, c.probability) for c in alert.causes),
        "" if alert is None else alert.text,
    )
