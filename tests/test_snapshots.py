"""Snapshots: the image of the very frame that the record is of, made beside the loop, through a real session."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import router_process
from support.daemon_bench import NEVER
from support.loopback import WAIT_S, free_endpoint, wait_until
from support.published import Published
from support.stand_ins import Listener, ScriptedMonitor, ScriptedSource
from test_security import own_files

import gripmon.daemon.snapshots as snapshots
from gripmon.cli import main
from gripmon.client import Client, NotCarriedOut, TransformClient
from gripmon.daemon.neighbours import Reports
from gripmon.daemon.running import run
from gripmon.daemon.watch import DaemonSettings
from gripmon.io.sources import FolderSettings, FolderSource, Waiting
from gripmon.io.wire import PublishSettings
from gripmon.model.records import CommandFault, CommandName, CommandReply, Frame, MonitorState, from_json, largest_bytes


def picture(seq: int) -> np.ndarray:
    """No two frames have the same."""
    return np.random.default_rng(seq).integers(0, 256, (48, 64, 3), dtype=np.uint8)


class Monitor(ScriptedMonitor):
    """With the answer that the real one gives to questions."""

    def command(self, command, stamp_ns):  # type: ignore[no-untyped-def]
        state = MonitorState((self.reference,))
        return CommandReply(command.name, True, "", self.reference.reference_id, self.reference.revision, state)


class Running:
    """A daemon in a thread, with a real publisher; ``frames`` gives what its source gives."""

    def __init__(self, settings: PublishSettings, frames: Callable[[int], object]) -> None:
        self.publisher = Published(settings, "arm", "wrist")
        self.ended = threading.Event()
        self.recording = Listener()
        self._stop = threading.Event()
        self._frames = frames
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        items = (self._frames(i) for i in itertools.takewhile(lambda _: not self._stop.wait(0.005), itertools.count()))
        run(
            Monitor(), source=ScriptedSource(items, live=True), outputs=(self.publisher,), recorder=self.recording,
            settings=DaemonSettings(state_period_s=NEVER), robot="arm", camera="wrist",
            commands=self.publisher.commands, reports=Reports(alert_limit_m=1e-3, alert_limit_rad=0.03),
            outlines=lambda cam_T_grip, _: () if cam_T_grip is None else ((tuple(cam_T_grip[:2, 3].tolist()),),),
        )  # fmt: skip
        self.ended.set()

    @property
    def frames(self) -> int:
        return len(self.recording.offered)

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


@contextmanager
def running(where: str | PublishSettings, frames: Callable[[int], object]) -> Iterator[Running]:
    made = Running(PublishSettings(listen=(where,)) if isinstance(where, str) else where, frames)
    try:
        yield made
    finally:
        made.end()


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def test_the_image_is_that_of_the_frame_that_the_record_is_of(endpoint: str):
    with running(endpoint, lambda i: Frame(i, 1_000 + i, picture(i), 0.02)) as daemon:
        wait_until(lambda: daemon.frames > 5, "some frames")
        with Client("arm", connect=[endpoint]) as client:
            taken = [client.snapshot(WAIT_S) for _ in range(3)]
    seqs = []
    for reply, data in taken:
        assert reply.done and reply.snapshot is not None and data is not None
        record, image = reply.snapshot.record, reply.snapshot.image
        seqs.append(record.seq)
        assert (record.stamp_ns, reply.snapshot.jaw_reported_m) == (1_000 + record.seq, 0.02)
        assert image is not None
        assert (image.encoding, image.width_px, image.height_px, image.pixels) == ("png", 64, 48, "bgr8")
        assert image.size_bytes == len(data)
        np.testing.assert_array_equal(
            cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), picture(record.seq)
        )
        assert reply.monitor == MonitorState((Monitor().reference,))
        assert reply.snapshot.age_s >= 0.0
        said = f"frame {record.seq}, {reply.snapshot.age_s:.2f} s old, tracking, transform valid: 64 x 48 px, png, "
        assert reply.text.startswith(said)
    assert seqs == sorted(set(seqs)), "each time a newer one"


def test_it_says_how_the_camera_stands_until_the_camera_is_silent(endpoint: str):
    """And a snapshot has the outline where the gripper would be seen at the reference."""

    def frames(seq: int) -> object:
        return Waiting("unplugged") if seq > 50 else Frame(seq, 1_000 + seq, picture(seq))

    with running(endpoint, frames) as daemon, TransformClient("arm", connect=[endpoint]) as client:
        wait_until(lambda: daemon.frames > 2, "some frames")
        reply, _ = client.snapshot(WAIT_S)
        reference = Monitor().reference
        assert reply.mount is not None and reply.snapshot is not None and reply.snapshot.record.cam_T_grip is not None
        assert reply.mount.reference_id == reference.reference_id and reply.mount.shift_m is not None
        assert reply.snapshot.outlines_px != reply.snapshot.reference_px
        (((u, v),),) = reply.snapshot.reference_px  # type: ignore[misc]
        assert (u, v) == pytest.approx(reference.cam_T_grip.translation_m[:2])

        def silent() -> bool:
            mount = client.send(CommandName.STATE).mount
            return mount is not None and mount.reason == "no frame comes" and mount.shift_m is None

        wait_until(silent, "the camera to be known to be silent")


def test_frames_go_on_while_a_file_is_made(endpoint: str, monkeypatch: pytest.MonkeyPatch):
    """The encoder is held up until later frames were handled: in the loop itself it would never be let go."""
    begun, go_on, encode = threading.Event(), threading.Event(), snapshots.encode

    def held_up(image: object) -> object:
        begun.set()
        assert go_on.wait(WAIT_S)
        return encode(image)

    monkeypatch.setattr(snapshots, "encode", held_up)
    with running(endpoint, lambda i: Frame(i, i, picture(i))) as daemon, Client("arm", connect=[endpoint]) as client:
        wait_until(lambda: daemon.frames, "a frame")
        got: list[CommandReply] = []
        asker = threading.Thread(target=lambda: got.append(client.snapshot(WAIT_S)[0]))
        asker.start()
        assert begun.wait(WAIT_S)
        before = daemon.frames
        wait_until(lambda: daemon.frames > before + 20, "later frames")
        go_on.set()
        asker.join()
    assert got[0].snapshot is not None and got[0].snapshot.record.seq <= before


def test_too_many_at_once_are_told_so_and_a_stop_completes_the_others(endpoint: str, monkeypatch: pytest.MonkeyPatch):
    go_on = threading.Event()
    monkeypatch.setattr(snapshots, "encode", lambda image: go_on.wait(WAIT_S) and None)
    answers: list[object] = []

    def ask() -> None:
        with Client("arm", connect=[endpoint]) as client:
            try:
                answers.append(client.snapshot(WAIT_S)[0])
            except NotCarriedOut as error:
                answers.append(error.fault)

    with running(endpoint, lambda i: Frame(i, i, picture(i))) as daemon:
        wait_until(lambda: daemon.frames, "a frame")
        askers = [threading.Thread(target=ask) for _ in range(6)]
        for asker in askers:
            asker.start()
        wait_until(lambda: CommandFault.BUSY in answers, "one that is turned away")
        wait_until(lambda: len(answers) >= 3, "all that are turned away, or time out")
        go_on.set()
        for asker in askers:
            asker.join()
    assert len(answers) == 6 and answers.count(CommandFault.BUSY) >= 3, "one in hand and two wait"
    faults = {answer for answer in answers if isinstance(answer, CommandFault)}
    assert faults <= {CommandFault.BUSY, CommandFault.TIMEOUT}


@pytest.mark.parametrize(
    ("image", "fault", "said"),
    [
        (None, "file is cut off", "no image (file is cut off)"),
        (np.zeros((4, 4, 7), np.uint8), None, "no image (not one that can be kept)"),
        (np.zeros((0, 4), np.uint8), None, "no image (not one that can be kept)"),
        (np.zeros((4, 4), np.int32), None, "no image (not one that can be kept)"),
        ("picture", None, "no image (not one that can be kept)"),
    ],
)
def test_a_frame_without_an_image_has_a_snapshot_too(endpoint: str, image: object, fault: str | None, said: str):
    frame = Frame(0, 5, image, fault=fault)  # type: ignore[arg-type]
    with (
        running(endpoint, lambda _: frame) as daemon,
        Client("arm", connect=[endpoint]) as client,
    ):
        wait_until(lambda: daemon.frames, "a frame")
        reply, data = client.snapshot(WAIT_S)
    assert reply.done and reply.snapshot is not None and reply.snapshot.image is None and data is None
    assert reply.text.endswith(said)


def test_a_camera_that_is_gone_is_told_by_the_age(endpoint: str):
    with (
        running(endpoint, lambda i: Frame(0, 5, picture(0)) if i == 0 else Waiting("gone")) as daemon,
        Client("arm", connect=[endpoint]) as client,
    ):
        wait_until(lambda: daemon.frames, "the frame")
        ages_s = []
        for _ in range(2):
            reply, _ = client.snapshot(WAIT_S)
            assert reply.snapshot is not None and reply.snapshot.record.seq == 0
            ages_s.append(reply.snapshot.age_s)
            time.sleep(0.05)
    assert ages_s[1] > ages_s[0] + 0.05


def test_before_the_first_frame_it_is_refused(endpoint: str):
    with (
        running(endpoint, lambda _: Waiting("the camera is silent")),
        Client("arm", connect=[endpoint]) as client,
    ):
        reply, data = client.snapshot(WAIT_S)
    assert (reply.done, reply.text, reply.snapshot, data) == (False, "no frame has come yet", None, None)


@pytest.mark.parametrize(
    ("image", "pixels"),
    [
        (np.arange(48, dtype=np.uint8).reshape(6, 8), "mono8"),
        (np.arange(48, dtype=np.uint16).reshape(6, 8) * 1365, "mono16"),
        (np.arange(144, dtype=np.uint16).reshape(6, 8, 3) * 455, "bgr16"),
        (np.asfortranarray(picture(1)[::2, ::-1]), "bgr8"),
    ],
)
def test_a_png_loses_nothing(image: np.ndarray, pixels: str):
    about, data = snapshots.encode(image)  # type: ignore[misc]
    assert (about.encoding, about.pixels) == ("png", pixels)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), image)


def test_a_float_image_is_rounded_to_16_bits():
    image = np.linspace(-0.1, 1.1, 48, dtype=np.float32).reshape(6, 8)
    image[0, 0] = np.nan
    about, data = snapshots.encode(image)  # type: ignore[misc]
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert about.pixels == "mono16" and read.dtype == np.uint16
    np.testing.assert_allclose(read / 65535.0, np.clip(np.nan_to_num(image), 0.0, 1.0), atol=0.51 / 65535.0)


def test_a_huge_image_becomes_a_jpeg_that_a_reply_can_carry():
    image = np.zeros((4200, 4200), np.uint16)
    image[:2100] = 40_000
    assert image.nbytes > snapshots.LARGEST_EXACT_BYTES
    about, data = snapshots.encode(image)  # type: ignore[misc]
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (about.encoding, about.pixels, read.shape) == ("jpeg", "mono8", image.shape)
    assert abs(int(read[100, 100]) - (40_000 >> 8)) <= 2 and read[4000, 100] <= 2
    assert len(data) < largest_bytes(CommandReply)


def test_send_writes_images_and_records_one_after_the_other(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "now"
    arguments = ["send", "snapshot", "--robot", "arm", "--connect", endpoint, "--out", str(out)]
    with running(endpoint, lambda i: Frame(i, i, picture(i), 0.02)) as daemon:
        wait_until(lambda: daemon.frames, "a frame")
        assert main(arguments) == 0
        said = capsys.readouterr().out.splitlines()
        assert main([*arguments, "--json"]) == 0
    assert said[1:] == [str(out / name) for name in ("snapshot-1.png", "snapshot-1.json", "timestamps.csv")]
    first, second = (from_json((out / f"snapshot-{i}.json").read_bytes(), CommandReply).snapshot for i in (1, 2))
    assert from_json(capsys.readouterr().out.encode(), CommandReply).snapshot == second
    assert first is not None and second is not None and second.record.seq > first.record.seq
    source = FolderSource(FolderSettings(path=str(out)), Path())
    for kept in (first, second):
        frame = source.read()
        assert frame is not None and frame.stamp_ns == kept.record.stamp_ns
        assert frame.jaw_opening_m == kept.jaw_reported_m
        np.testing.assert_array_equal(frame.image, picture(kept.record.seq))
    assert source.read() is None


def test_a_frame_without_an_image_leaves_a_record_alone(endpoint: str, tmp_path: Path):
    (tmp_path / "snapshot-8.jpg").write_bytes(b"of yesterday")
    with running(endpoint, lambda i: Frame(i, i, None)) as daemon:
        wait_until(lambda: daemon.frames, "a frame")
        assert main(["send", "snapshot", "--robot", "arm", "--connect", endpoint, "--out", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["snapshot-8.jpg", "snapshot-9.json"]


@pytest.mark.parametrize(
    ("table", "said"), [("file,stamp_ns\n", "has no column jaw_opening_m; another folder"), ("?", "line 1 is '?'; ")]
)
def test_somebody_elses_table_is_left_alone(table: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "timestamps.csv").write_text(table)
    assert main(["send", "snapshot", "--robot", "arm", "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err
    assert (tmp_path / "timestamps.csv").read_text() == table


def patient_snapshot(operator: Client, times: int = 10) -> tuple[CommandReply, bytes | None]:
    """A busy machine may take longer than the monitor's 2 s for five megabytes of noise; a person would ask again."""
    for _ in range(times - 1):
        try:
            return operator.snapshot(5.0 * WAIT_S)
        except NotCarriedOut as refused:
            if refused.fault is not CommandFault.TIMEOUT:
                raise
    return operator.snapshot(5.0 * WAIT_S)


def test_a_large_one_comes_through_the_secure_router_to_the_operator(tmp_path: Path):
    """Five megabytes, with the files that are shipped: no limit on the way is smaller than what is sent."""
    router = free_endpoint()
    own_files(tmp_path, router)
    noise = np.random.default_rng(1).integers(0, 256, (1200, 1500, 3), dtype=np.uint8)  # a PNG of it is no smaller

    def paced(i: int) -> Frame:  # a loop that never rests keeps the encoder from its 2 s
        time.sleep(0.05)
        return Frame(i, i, noise)

    with (
        router_process.running(tmp_path / "router.json5", router),
        running(PublishSettings(zenoh_config=str(tmp_path / "monitor.json5")), paced) as daemon,
    ):
        wait_until(lambda: daemon.publisher.connected and daemon.frames, "a frame of a monitor on the network")
        with Client("arm", "wrist", zenoh_config_file=str(tmp_path / "operator.json5")) as operator:
            reply, data = patient_snapshot(operator)
    assert reply.snapshot is not None and data is not None and len(data) > 5_000_000
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), noise)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["snapshot"], "send: snapshot needs a folder; --out DIR"),
        (["state", "--out", "x"], "send: state writes nothing; leave --out out"),
        (["state", "--request", "x"], "send: state changes nothing"),
        (["snapshot", "r-1", "--out", "x"], "send: snapshot takes no ID"),
        (["snapshot", "--out", __file__], f"--out {__file__}: can't be made"),
    ],
)
def test_wrong_usage_is_said_before_anybody_is_asked(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["send", *arguments, "--robot", "arm"]) == 2
    assert capsys.readouterr().err.startswith(said)
