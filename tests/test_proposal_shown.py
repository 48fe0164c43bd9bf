"""A new reference that waits for an operator: who looks anywhere sees it, with the command to type."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import pytest
from support.daemon_bench import Bench
from support.loopback import reference_record, state_record
from support.stand_ins import ScriptedMonitor

from gripmon.cli import fleet_table
from gripmon.client import MonitorName, MonitorStatus
from gripmon.model.records import Alert, AlertEvent, AlertKind, Cause, MonitorState, Severity, StandingAlert

ROOT = Path(__file__).resolve().parent.parent
COMMAND = "gripmon send accept recalibration-4-1f0c9a2b --robot arm --camera wrist"


class Proposing(ScriptedMonitor):
    """From frame 2 on a reference waits, from frame 4 on none does."""

    def process(self, frame):  # type: ignore[no-untyped-def]
        record = super().process(frame)
        self.state_revision += frame.seq in (2, 4)
        return record

    def state(self) -> MonitorState:
        draft = msgspec.structs.replace(reference_record(4), reference_id="recalibration-4-1f0c9a2b")
        waits = bool(self.frames) and 2 <= self.frames[-1].seq < 4
        return MonitorState((self.reference,), proposal=draft if waits else None)


def test_the_state_and_the_log_say_what_to_type(caplog: pytest.LogCaptureFixture):
    bench = Bench(range(6), Proposing())
    with caplog.at_level(logging.INFO, logger="gripmon"):
        bench.run()
    waiting = [(state.proposal_id, COMMAND in state.message) for state in bench.network.states]
    assert set(waiting) == {("", False), ("recalibration-4-1f0c9a2b", True)}
    assert waiting[-1] == ("", False)
    said = [record.getMessage() for record in caplog.records if COMMAND in record.getMessage()]
    assert said == [f"a new reference waits for an operator: {COMMAND} (or reject)"]


def test_its_alert_says_what_to_type_until_it_is_cleared():
    """The monitor writes the text, and doesn't know the robot's name."""
    about = Alert(
        AlertKind.PROPOSED, Cause.CAMERA_MOUNT, Severity.WARNING, "it waits to be accepted", AlertEvent.RAISED
    )
    over = msgspec.structs.replace(about, event=AlertEvent.CLEARED, text="the proposal was rejected")
    other = msgspec.structs.replace(about, kind=AlertKind.DRIFT, text="a drift")
    alerts = {2: (about, other), 4: (over,)}
    bench = Bench(range(6), Proposing(lambda seq: {"alerts": alerts.get(seq, ())}))
    bench.run()
    texts = [alert.text for alert in bench.network.alerts]
    assert texts == [f"{about.text}; to accept it: {COMMAND}", other.text, over.text]
    assert bench.network.transforms[2].alerts == (about, other), "the monitor's own, as a replay has it"


def status(**changes: object) -> MonitorStatus:
    state = msgspec.structs.replace(state_record(), proposal_id="recalibration-4-1f0c9a2b", **changes)
    return MonitorStatus(name=MonitorName("arm", "wrist"), state=state, state_age_s=0.1)


def test_watch_begins_with_the_command_and_explains_its_marks():
    alerts = (StandingAlert("1-a", AlertKind.STEP, Severity.ERROR, "a step", since_ns=5, acknowledged=False),)
    shown = fleet_table.plain([status(open_alerts=alerts)], "")
    assert f"waits: {COMMAND}; !!1 a step" in shown
    assert shown.splitlines()[-1] == fleet_table.LEGEND
    assert f"waits: {COMMAND}" in fleet_table.line(status())
    assert fleet_table.LEGEND not in fleet_table.plain([status()], "")
