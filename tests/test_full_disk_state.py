"""A disk without room for the state: what isn't on it is not in force, and no revision ever names two references."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.gripmon_process import GRIPMON, ROOT
from support.kept_states import configuration, make_pictures
from support.loopback import ask, free_endpoint, plain_session, wait_until
from support.meters import box_gripper
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.small_disks import fill, small_disk
from support.watched import frames_of, reference_of
from test_killed import PREFIX, Witness

from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.model.camera import make_camera
from gripmon.model.records import AlertEvent, AlertKind, CommandReply, Origin, ReferenceRecord, from_json
from gripmon.monitor import Monitor, MonitorSettings

KNOCKED = {
    "policy": {"limit_m": 0.001, "settle_frames": 4, "confirm_frames": 1},
    "recalibration": {"frames": 4, "sure_sigma_m": 0.001, "largest_sigma_m": 0.001},
}
"""Settings by which a camera that is knocked to and fro is calibrated again each time."""


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 1_000_000) as place:
        yield place


@contextmanager
def killed_at_the_end(config: Path) -> Iterator[None]:
    log = config.parent / "log.txt"
    with log.open("a") as file:
        process = subprocess.Popen([*GRIPMON, "run", str(config)], stderr=file, cwd=ROOT)
    try:
        yield
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow("17 s: a daemon on a full disk; the same without one is in the default run")
def test_on_a_full_disk_nothing_gets_into_force_and_no_revision_is_used_twice(tmp_path: Path, disk: Path):
    endpoint = free_endpoint()
    pictures = make_pictures(tmp_path / "pictures", 4000, knocked_every=40)
    config = configuration(tmp_path, pictures, endpoint, monitor=KNOCKED, state={"file": str(disk / "state.json")})
    kept = disk / "state.json"
    alerts: list[str] = []
    with plain_session(listen=endpoint, mode="router") as session:
        witness = Witness(session)
        subscriber = session.declare_subscriber(
            f"{PREFIX}/alert", lambda sample: alerts.append(json.loads(sample.payload.to_bytes())["text"])
        )
        with killed_at_the_end(config):
            wait_until(lambda: witness.newest >= 1, "a recalibration", 60.0)
            filled = fill(disk)
            wait_until(lambda: any("a restart would lose it" in text for text in alerts), "the alert", 60.0)
            in_force = witness.newest
            for command in ("reset", "accept"):
                (said,) = session.get(f"{PREFIX}/cmd/{command}", timeout=60.0)
                reply = from_json(said.ok.payload.to_bytes(), CommandReply)
                assert not reply.done and reply.revision == in_force and "No space left" in reply.text
            (told,) = ask(session, f"{PREFIX}/cmd/state")
            assert told["monitor"]["proposal"]["revision"] == in_force + 1 and not told["durable"]
            time.sleep(1.0)
            assert witness.compare(kept).references[-1].revision == witness.newest == in_force
        with killed_at_the_end(config):
            before = witness.transforms
            wait_until(lambda: witness.transforms > before + 60, "transforms of the next start", 60.0)
            assert witness.newest == in_force, "still nothing else"
            filled.unlink()
            # What the restart can't explain, a person accepts; then it goes on by itself.
            wait_until(lambda: (witness.accept(), witness.newest > in_force + 1)[1], "recalibrations with room", 60.0)
        witness.compare(kept)
        subscriber.undeclare()
    assert "Traceback" not in (tmp_path / "log.txt").read_text()


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
