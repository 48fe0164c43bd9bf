"""A disk without room for the state: what isn't on it is not in force, and no revision ever names two references."""

from __future__ import annotations

import pytest
from support.meters import box_gripper
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import frames_of, reference_of

from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.model.camera import make_camera
from gripmon.model.records import AlertEvent, AlertKind, Origin, ReferenceRecord
from gripmon.monitor import Monitor, MonitorSettings


def test_what_could_not_be_kept_is_proposed_once_and_gets_into_force_when_it_can_be(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gripmon.monitor.renewal.KEEP_AGAIN_S", 0.1)
    tried: list[ReferenceRecord] = []

    def keep(references: tuple[ReferenceRecord, ...]) -> str:
        tried.append(references[-1])
        return "no space left" if len(tried) < 3 else ""

    settings = MonitorSettings(recalibration=RecalibrationSettings(sure_sigma_m=1e-4))
    reference = reference_of(nominal_cam_T_grip())
    monitor = Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), settings, reference, keep=keep)
    records = [monitor.process(frame) for frame in frames_of("bump")[0]]
    told = [alert for record in records for alert in record.alerts if alert.kind is AlertKind.PROPOSED]
    assert [alert.event for alert in told] == [AlertEvent.RAISED, AlertEvent.CLEARED]
    assert "as a restart would lose it: no space left; it is tried again" in told[0].text
    assert len(tried) == 3 and monitor.reference is tried[2] and monitor.proposal is None
    (at,) = [i for i, record in enumerate(records) if record.source is Origin.RECALIBRATION]
    assert {record.revision for record in records[:at]} == {1} and {record.revision for record in records[at:]} == {2}
