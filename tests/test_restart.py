"""A restart: the monitor goes on from what was kept, and looks before it says valid.

In one process on the core, and as users meet it: ``gripmon run`` killed and started again, ``gripmon send``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from support.kept_states import configuration, keep, make_pictures
from support.loopback import ask, free_endpoint, plain_session, wait_until
from support.simulated import nominal_cam_T_grip
from support.watched import frames_of, new_monitor, pose_of, reference_of, restarted

from gripmon.cli import main
from gripmon.judge.references import ReferenceBook
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    Command,
    CommandName,
    FrameRecord,
    MonitorState,
    ReferenceRecord,
    Severity,
    Verdict,
)

HERE = Path(__file__).resolve().parent
ROBOT = "gripmon/demo/wrist"


# --- the core ---


def with_reference(shift_m: tuple[float, float, float]) -> MonitorState:
    """After the configured reference one that was measured later, its TCP shifted."""
    book = ReferenceBook(reference_of(nominal_cam_T_grip()))
    pose = nominal_cam_T_grip()
    pose[:3, 3] += shift_m
    book.adopt(book.draft(pose, np.diag([4e-12] * 3 + [1e-8] * 3), 77))
    return MonitorState(book.history)


def test_without_a_state_nothing_is_said_of_a_restart():
    frames, _ = frames_of("static")
    monitor = new_monitor()
    assert not [alert for frame in frames for alert in monitor.process(frame).alerts]
    assert monitor.state().references == (monitor.reference,)


def test_what_a_monitor_tells_of_itself_another_one_goes_on_from():
    frames, truths = frames_of("static")
    first = new_monitor()
    for frame in frames[:20]:
        first.process(frame)
    assert first.state().cam_T_grip is not None
    undisturbed = restarted(first.state())
    assert undisturbed.state().references == first.state().references
    records = [undisturbed.process(frame) for frame in frames[20:]]
    told = [(i, alert) for i, record in enumerate(records) for alert in record.alerts]
    [(at, alert)] = told
    assert alert.kind is AlertKind.RESTARTED and "factory-1, revision 1" in alert.text
    assert Verdict.VALID not in [record.verdict for record in records[:at]] and at < 5
    assert Verdict.VALID in [record.verdict for record in records]
    errors = [
        np.linalg.norm(pose_of(r.cam_T_grip)[:3, 3] - t.cam_T_grip[:3, 3])
        for r, t in zip(records, truths[20:], strict=True)
    ]
    assert max(errors) < 1e-4


@pytest.mark.parametrize(
    ("shift_m", "fits"), [((0.0, 0.0, 0.0), True), ((2e-5, 0.0, 0.0), True), ((0.0, 0.0015, 0.0), False)]
)
def test_it_says_whether_the_picture_fits_the_reference_that_was_kept(shift_m: tuple[float, float, float], fits: bool):
    monitor = restarted(with_reference(shift_m))
    frames, _ = frames_of("static")
    records = [monitor.process(frame) for frame in frames]
    first = next(i for i, record in enumerate(records) if AlertKind.RESTARTED in [a.kind for a in record.alerts])
    assert all(record.verdict is not Verdict.VALID for record in records[:first])
    assert {(record.reference_id, record.revision) for record in records[: first + 1]} == {
        (with_reference(shift_m).references[-1].reference_id, 2)
    }
    [alert] = [a for record in records for a in record.alerts if a.kind is AlertKind.RESTARTED]
    assert (alert.severity is Severity.INFO) == fits
    assert "revision 2" in alert.text


def test_an_open_alert_goes_on_under_its_name_and_is_not_raised_again():
    frames, _ = frames_of("creep")
    first = new_monitor()
    raised = []
    at = 0
    while not raised:
        raised = [a for a in first.process(frames[at]).alerts if a.event is AlertEvent.RAISED]
        at += 1
    for frame in frames[at : at + 10]:
        first.process(frame)
    second = restarted(first.state())
    assert [kept.alert.alert_id for kept in second.state().alerts] == [raised[0].alert_id]
    told = [a for frame in frames[at + 10 :] for a in second.process(frame).alerts]
    assert AlertEvent.RAISED not in [alert.event for alert in told]
    assert {alert.alert_id for alert in told if alert.kind is not AlertKind.RESTARTED} <= {raised[0].alert_id}
    [alert] = [alert for alert in told if alert.kind is AlertKind.RESTARTED]
    assert alert.severity is Severity.WARNING, "the camera is still where the reference doesn't have it"
    assert [kept.alert.alert_id for kept in second.state().alerts] == [raised[0].alert_id]
    reply = second.command(Command(CommandName.ACKNOWLEDGE, raised[0].alert_id), 5)
    assert reply.done and second.state().alerts[0].alert.acknowledged
    third = restarted(second.state())
    assert not third.command(Command(CommandName.ACKNOWLEDGE), 5).done, "acknowledged before the restart"


def test_a_gripper_that_is_not_seen_after_a_restart_is_never_valid():
    monitor = restarted(with_reference((0.0, 0.0, 0.0)))
    frames, _ = frames_of("static")
    for frame in frames[:10]:
        blank = np.full_like(frame.image, 120)
        blank += np.random.default_rng(frame.seq).integers(0, 9, blank.shape, dtype=np.uint8)
        record = monitor.process(type(frame)(frame.seq, frame.stamp_ns, blank, frame.jaw_opening_m))
        assert record.verdict is Verdict.UNKNOWN and record.revision == 2
        assert AlertKind.RESTARTED not in [alert.kind for alert in record.alerts]


def test_where_the_gripper_was_is_not_forgotten_by_a_restart_that_sees_nothing():
    frames, _ = frames_of("static")
    first = new_monitor()
    first.process(frames[0])
    kept = first.state().cam_T_grip
    again = restarted(restarted(first.state()).state()).state().cam_T_grip
    assert kept is not None and again is not None
    np.testing.assert_allclose(pose_of(again), pose_of(kept), atol=1e-12)


def test_the_state_revision_grows_with_every_change_and_only_then():
    frames, _ = frames_of("static")
    monitor = restarted(with_reference((2e-5, 0.0, 0.0)))
    for frame in frames[:10]:
        monitor.process(frame)
    before, kept = monitor.state_revision, monitor.state()
    for refused in (CommandName.ACCEPT, CommandName.REJECT):
        assert not monitor.command(Command(refused), 5).done
    assert monitor.state_revision == before and monitor.state().references == kept.references
    reply = monitor.command(Command(CommandName.UNDO), 123)
    assert reply.done and (reply.reference_id, reply.revision) == (monitor.reference.reference_id, 3)
    assert monitor.state_revision > before
    assert monitor.reference.cam_T_grip == kept.references[0].cam_T_grip and monitor.reference.stamp_ns == 123
    record = monitor.process(frames[10])
    assert record.revision == 3 and AlertKind.RESTORED in [alert.kind for alert in record.alerts]
    assert np.linalg.norm(record.drift.tcp_shift_m) < 5e-5
    assert "first reference" in monitor.command(Command(CommandName.UNDO), 5).text
    told = monitor.command(Command(CommandName.STATE), 5)
    assert told.done and told.monitor is not None and told.monitor.references == monitor.state().references


# --- as users meet it ---


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_pictures(tmp_path_factory.mktemp("restart") / "pictures", 6000)


class Cell:
    """A router with ears, a configuration, and monitors that are started on it."""

    def __init__(self, folder: Path, pictures: Path, session: zenoh.Session, endpoint: str) -> None:
        self.folder, self.session, self.endpoint = folder, session, endpoint
        self.config = configuration(folder, pictures, endpoint)
        self.kept = folder / "kept.json"
        self.transforms: list[FrameRecord] = []
        self.alerts: list[dict[str, object]] = []
        self._subscribers = [
            session.declare_subscriber(
                f"{ROBOT}/transform",
                lambda sample: self.transforms.append(msgspec.json.decode(sample.payload.to_bytes(), type=FrameRecord)),
            ),
            session.declare_subscriber(
                f"{ROBOT}/alert", lambda sample: self.alerts.append(json.loads(sample.payload.to_bytes()))
            ),
        ]

    @contextmanager
    def monitor(self, *options: str) -> Iterator[subprocess.Popen[str]]:
        """``gripmon run`` until its end, which is kill -9."""
        self.transforms.clear()
        self.alerts.clear()
        process = subprocess.Popen(
            [sys.executable, "-m", "gripmon", "run", str(self.config), *options],
            stderr=subprocess.PIPE, text=True, cwd=HERE.parent,
        )  # fmt: skip
        try:
            yield process
        finally:
            process.kill()
            process.communicate()

    def run(self, *options: str) -> subprocess.CompletedProcess[str]:
        return gripmon("run", str(self.config), *options)

    def send(self, *arguments: str, robot: str = "demo") -> subprocess.CompletedProcess[str]:
        return gripmon("send", *arguments, "--robot", robot, "--connect", self.endpoint)

    def wait(self, condition: Callable[[FrameRecord], bool], what: str) -> FrameRecord:
        """The first transform that fits."""
        wait_until(lambda: any(condition(record) for record in list(self.transforms)), what, 60.0)
        return next(record for record in self.transforms if condition(record))

    def wait_valid(self) -> FrameRecord:
        return self.wait(lambda record: record.verdict is Verdict.VALID, "a valid transform")

    def reference(self) -> ReferenceRecord:
        (said,) = ask(self.session, f"{ROBOT}/reference")
        return msgspec.convert(said, ReferenceRecord)


def gripmon(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gripmon", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60.0, cwd=HERE.parent)


@pytest.fixture
def cell(tmp_path: Path, pictures: Path) -> Iterator[Cell]:
    endpoint = free_endpoint()
    with plain_session(listen=endpoint, mode="router") as session:
        yield Cell(tmp_path, pictures, session, endpoint)


def test_a_damaged_file_is_set_aside_and_said_on_the_network(cell: Cell):
    keep(cell.config, 2e-5)
    cell.kept.write_bytes(cell.kept.read_bytes()[:-100])
    with cell.monitor():
        assert cell.wait_valid().reference_id == "demo-calibration"
        wait_until(lambda: cell.alerts, "the alert")
    text = str(cell.alerts[0]["text"])
    assert cell.alerts[0]["kind"] == "restarted" and "is damaged" in text and "kept.json.damaged-1" in text
    assert (cell.folder / "kept.json.damaged-1").is_file()


def test_a_changed_calibration_and_a_fresh_start_begin_anew_with_the_next_revision(cell: Cell):
    keep(cell.config, 2e-5)
    with cell.monitor("--fresh-state"):
        record = cell.wait_valid()
        assert (record.reference_id, record.revision) == ("demo-calibration", 2)
    text = cell.config.read_text()
    assert text.count("fx_px: 962.0") == 1
    cell.config.write_text(text.replace("fx_px: 962.0", "fx_px: 962.5"))
    with cell.monitor():
        assert cell.wait_valid().revision == 3
        wait_until(lambda: cell.alerts, "the alert")
    assert "the camera model changed since" in str(cell.alerts[0]["text"])
    assert sorted(path.name for path in cell.folder.glob("kept.json.r*")) == [
        "kept.json.replaced-1",
        "kept.json.replaced-2",
    ]


def test_a_command_to_nobody_is_one_line_and_exit_code_3(cell: Cell):
    begun_s = time.monotonic()
    done = cell.send("undo", "--timeout", "0.5")
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.startswith("send: no monitor demo/* is seen; none at all at tcp/127")
    assert done.stderr.count("\n") == 1
    assert time.monotonic() - begun_s < 30.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["state", "x-1"], "send: state takes no ID, but x-1 is given; leave it out\n"),
        (["undo", "--zenoh-config", "x.json5"], "send: --connect has no effect beside --zenoh-config; one of them\n"),
    ],
)
def test_wrong_usage_of_send_is_one_line_and_exit_code_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["send", *arguments, "--robot", "demo", "--connect", free_endpoint()]) == 2
    assert capsys.readouterr() == ("", said)


@pytest.mark.parametrize("robot", ["two words", "a/b", ""])
def test_a_name_that_can_not_be_is_wrong_usage(robot: str, capsys: pytest.CaptureFixture[str]):
    assert main(["send", "undo", "--robot", robot, "--connect", free_endpoint()]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "can't be part of a Zenoh key" in said
