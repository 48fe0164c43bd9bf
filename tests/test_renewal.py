"""What becomes of a measured reference: adopted, proposed or neither, and what an operator's word changes about it."""

from __future__ import annotations

import numpy as np
import pytest
from support.meters import box_gripper
from support.policy_runs import explained
from support.simulated import nominal_cam_T_grip
from support.watched import reference_of

from gripmon.judge.policy import Policy
from gripmon.judge.recalibrate import Proposal, Refusal
from gripmon.judge.recalibrate.recalibrator import RefusalReason
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Cause,
    Command,
    CommandName,
    Drift,
    Explanation,
    ReferenceInputs,
)
from gripmon.monitor import MonitorSettings
from gripmon.monitor.renewal import Renewal

K, RAISED, CLEARED, NOTED = AlertKind, AlertEvent.RAISED, AlertEvent.CLEARED, AlertEvent.NOTED
DRIFT = Drift(0.003, 0.0, (0.003, 0.0, 0.0))
INPUTS = ReferenceInputs(first_seq=1, last_seq=20, frames=20, corners=(), weighted_rms=1.0, step_m=0.003, step_rad=0.0)
REFUSED = Refusal(RefusalReason.RESIDUALS, "the corners contradict each other")


class Cell:
    """A renewal whose measurements are made up; its camera is ``at_mm`` from where the first reference has it."""

    def __init__(self) -> None:
        self.at_mm, self.now_s = 3.0, 0.0
        self.policy = Policy(MonitorSettings().policy)
        reference = reference_of(nominal_cam_T_grip())
        self.renewal = Renewal(
            MonitorSettings(), box_gripper(sharp=False), np.zeros((6, 6)), reference, self.policy, None, lambda _: ""
        )
        self.asks: str | None = None
        self.refusal: Refusal | None = None
        self.renewal._recalibrator.outcome = lambda _: self.refusal or self.measured()  # type: ignore[method-assign]

    @property
    def cam_T_grip(self) -> np.ndarray:
        pose = nominal_cam_T_grip()
        pose[0, 3] += 1e-3 * self.at_mm
        return pose

    def measured(self) -> Proposal:
        return Proposal(self.cam_T_grip, np.diag([1e-10] * 3 + [1e-8] * 3), INPUTS, self.asks)

    def still(self, explanation: Explanation | None = None) -> list[tuple[AlertKind, AlertEvent]]:
        """The camera has stood still for long enough, a third of a second after the last time."""
        self.now_s += 0.33
        stamp_ns = round(1e9 * self.now_s)
        told = explanation or Explanation()
        alerts = self.renewal.recalibrate(DRIFT, self.cam_T_grip, told, None, self.now_s, stamp_ns)
        return _told(alerts)

    def say(self, name: CommandName) -> list[tuple[AlertKind, AlertEvent]]:
        return _told(self.renewal.obey(Command(name), self.cam_T_grip, True, self.now_s, 7)[1])

    @property
    def revision(self) -> int:
        return self.renewal.book.current.revision


def _told(alerts: tuple[Alert, ...]) -> list[tuple[AlertKind, AlertEvent]]:
    return [(alert.kind, alert.event) for alert in alerts]


def test_a_proposal_right_after_a_refusal_is_told_nevertheless():
    cell = Cell()
    cell.refusal = REFUSED
    assert cell.still() == [(K.REFUSED, RAISED)]
    assert cell.still() == []
    cell.policy.alerts.acknowledge()
    cell.refusal, cell.asks = None, "a step of 30 mm"
    assert cell.still() == [(K.REFUSED, CLEARED), (K.PROPOSED, RAISED)]
    assert cell.still() == []


def test_another_proposal_is_another_alert():
    cell = Cell()
    cell.asks = "a step of 30 mm"
    assert cell.still() == [(K.PROPOSED, RAISED)]
    cell.at_mm += 1.0
    assert cell.still() == [(K.PROPOSED, CLEARED), (K.PROPOSED, RAISED)]
    told, proposal = cell.policy.alerts.about("renewal"), cell.renewal.book.proposal
    assert told is not None and proposal is not None and proposal.reference_id in told.text


def test_a_refusal_withdraws_a_proposal_of_another_place():
    cell = Cell()
    cell.asks = "a step of 30 mm"
    cell.still()
    cell.at_mm, cell.refusal = 4.0, REFUSED
    assert cell.still() == [(K.PROPOSED, CLEARED), (K.REFUSED, RAISED)]
    assert cell.renewal.book.proposal is None


def test_what_was_rejected_is_not_proposed_again_where_the_camera_stays():
    cell = Cell()
    cell.asks = "a step of 30 mm"
    cell.still()
    assert cell.say(CommandName.REJECT) == [(K.PROPOSED, CLEARED)]
    assert cell.still() == []
    cell.at_mm += 1.0
    assert cell.still() == [(K.PROPOSED, RAISED)]
    cell.say(CommandName.REJECT)
    cell.say(CommandName.RECALIBRATE)
    assert cell.still() == [(K.PROPOSED, RAISED)], "unless someone wants it"


@pytest.mark.parametrize("name", [CommandName.ACCEPT, CommandName.RESET, CommandName.UNDO])
def test_what_was_wanted_before_does_not_overrule_the_newest_word(name: CommandName):
    cell = Cell()
    assert cell.still() == [(K.RECALIBRATED, NOTED)]
    cell.at_mm, cell.asks = 6.0, "a step of 30 mm"
    cell.still()
    cell.say(CommandName.RECALIBRATE)
    cell.say(name)
    assert cell.revision == 3 and not cell.renewal.wanted


@pytest.mark.parametrize("cause", [Cause.FINGER_BENT, Cause.JAW_OPENING, Cause.LENS, Cause.CAMERA_REPLACED])
def test_a_wish_does_not_make_a_reference_of_what_is_not_the_camera(cause: Cause):
    cell = Cell()
    cell.say(CommandName.RECALIBRATE)
    assert cell.still(explained(cause)) == [(K.REFUSED, RAISED)]
    assert cell.revision == 1 and not cell.renewal.wanted
