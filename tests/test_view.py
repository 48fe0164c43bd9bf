"""Looking at a monitor that runs and at recordings: a viewer in another process, and what becomes of the file."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import threading
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import msgspec
import numpy as np
import psutil
import pytest
import rerun_cli
from rerun.chunk import RrdReader
from support import recorded
from support.configurations import shipped, with_sections
from support.gripmon_process import GRIPMON
from support.loopback import WAIT_S, free_port, wait_until
from support.network_daemon import ENVIRONMENT
from support.teach_page_browser import browser

from gripmon.cli import main
from gripmon.record.files import FileSeries
from gripmon.record.live import LiveStream
from gripmon.record.recorder import Picture, RecordingSettings, Row, ViewSettings
from gripmon.record.write import ProcessRecorder, open_recorder

VIEWER = Path(rerun_cli.__file__).parent / "rerun"
MAGENTA = (255, 0, 255)


def live_recorder(folder: Path, view: ViewSettings, settings: RecordingSettings) -> ProcessRecorder:
    opened = open_recorder(
        settings, robot="arm", camera_name="wrist", camera=recorded.CAMERA, gripper=recorded.GRIPPER,
        reference=recorded.REFERENCE, directory=folder, name="live", patience_s=30.0, view=view,
    )  # fmt: skip
    assert isinstance(opened, ProcessRecorder)
    return opened


@contextmanager
def receiver(view: ViewSettings, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """rerun's own program, that receives a stream and saves what it gets."""
    command = [str(VIEWER), view.stream_url, "--save", str(out), "--bind", "127.0.0.1", "--port", "auto"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def seqs_of(path: Path, entity: str = "record") -> set[int]:
    """The frames that a file holds, whether or not it is complete yet."""
    try:
        chunks = RrdReader(path).stream().filter(content=[f"/{entity}"], has_timeline="frame").to_chunks()
    except Exception:  # noqa: BLE001  just begun
        return set()
    return {seq for chunk in chunks for seq in chunk.to_record_batch().column("frame").to_pylist()}


def monitor_config(folder: Path, port: int, web_port: int, recording: str) -> Path:
    sections = {
        "publish": "{enabled: false}",
        "source": "{kind: simulator, scenario: static, duration_s: 600.0, fps: 15.0, realtime: true}",
        "recording": recording,
        "view": f"{{port: {port}, web_port: {web_port}}}",
    }
    path = folder / "monitor.yaml"
    path.write_text(with_sections(shipped(), **sections))
    return path


@pytest.mark.parametrize(
    "enabled", [True, pytest.param(False, marks=pytest.mark.slow("8 s: with files beside it is in the default run"))]
)
def test_another_process_sees_what_a_monitor_does(tmp_path: Path, enabled: bool):
    """With and without files beside it."""
    view = ViewSettings(port=free_port(), web_port=free_port())
    config = monitor_config(
        tmp_path, view.port, view.web_port, f"{{enabled: {str(enabled).lower()}, min_free_bytes: 0}}"
    )
    out = tmp_path / "out"
    command = [*GRIPMON, "run", str(config), "--out", str(out), "--view", "server"]
    with (tmp_path / "said.txt").open("wb") as said, subprocess.Popen(command, stderr=said, env=ENVIRONMENT) as process:
        try:
            wait_until(lambda: listens(view.port) or process.poll() is not None, "the stream")
            with receiver(view, tmp_path / "seen.rrd"):
                wait_until(lambda: len(seqs_of(tmp_path / "seen.rrd")) >= 30, "thirty frames in the other process")
                # Fewer images than measurements are sent, and a sparse one may be on its way.
                wait_until(lambda: seqs_of(tmp_path / "seen.rrd", "rig/camera/image"), "images, too")
            process.terminate()
            assert process.wait(WAIT_S) == 0, (tmp_path / "said.txt").read_text()
        finally:
            process.kill()
    lines = [json.loads(line) for line in (out / "estimates.jsonl").read_bytes().splitlines()]
    judged = {line["seq"] for line in lines}
    assert seqs_of(tmp_path / "seen.rrd") <= judged
    files = sorted(out.glob("*.rrd"))
    assert bool(files) is enabled
    if enabled:
        assert set().union(*map(seqs_of, files)) == judged, "the viewer's end was none of the file's"


def test_a_live_view_that_cannot_be_served_costs_nothing_else(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        view = ViewSettings(port=other.getsockname()[1], web_port=free_port())
        recorder = live_recorder(tmp_path, view, recorded.settings())
        for seq in range(20):
            recorder.frame(recorded.frame(seq), recorded.record(seq), lambda: None)
        wait_until(lambda: "the live view can't be served" in caplog.text, "it is said")
        wait_until(lambda: recorder.frames_written == 20, "all on disk")
        assert recorder.failure is None
        recorder.close(timeout_s=60.0)
    (file,) = tmp_path.glob("live-*.rrd")
    assert seqs_of(file) == set(range(20)) and recorder.dropped == 0


def test_a_viewer_that_stalls_holds_up_no_file(tmp_path: Path):
    """Its server waits for it; files are begun and ended in the same process, one after another."""
    view = ViewSettings(port=free_port(), web_port=free_port(), memory_limit_bytes=10_000_000)
    scene = recorded.scene(tmp_path, max_file_bytes=200_000)
    live, files = LiveStream(scene, view), FileSeries(scene)
    noise = np.random.default_rng(1).bytes(2_000_000)

    def row(seq: int, size: int) -> Row:
        picture = Picture(noise[:size], "image/png", 0.0, 0.0, 0.0, 0.0)
        return Row(recorded.record(seq), picture, None, None)

    def serve(seq: int, size: int) -> None:
        live.add_frames([row(seq, size)])
        live.write()

    def write() -> None:
        for seq in range(12):
            files.add_frames([row(seq, 90_000)])
            files.write()
        files.close()

    serve(0, 1000)
    with receiver(view, tmp_path / "seen.rrd") as viewer:
        wait_until(lambda: serve(1, 1000) or seqs_of(tmp_path / "seen.rrd"), "it is shown")
        viewer.send_signal(signal.SIGSTOP)
        for seq in range(2, 500):
            if live._stalled:
                break
            serve(seq, len(noise))
        assert live._stalled, "the server waits"
        writing = threading.Thread(target=write, daemon=True)
        writing.start()
        writing.join(10.0)  # without what the server holds up it takes a fraction of a second
        assert not writing.is_alive() and live._stalled
    live.close()
    assert (files.failure, files.frames_written) == (None, 12)
    written = sorted(tmp_path.glob("run-*.rrd"))
    assert len(written) > 3 and set().union(*map(seqs_of, written)) == set(range(12))


@pytest.fixture(scope="module")
def two_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in two files, its images magenta."""
    folder = tmp_path_factory.mktemp("run")
    settings = msgspec.structs.replace(recorded.settings(image_every=1, max_file_bytes=100_000), flush_period_s=0.05)
    opened = open_recorder(
        settings, robot="arm", camera_name="wrist", camera=recorded.CAMERA, gripper=recorded.GRIPPER,
        reference=recorded.REFERENCE, directory=folder, name="shift", patience_s=30.0,
    )  # fmt: skip
    assert isinstance(opened, ProcessRecorder)
    image = np.full((recorded.HEIGHT_PX, recorded.WIDTH_PX, 3), MAGENTA, np.uint8)
    seq = 0
    while len(list(folder.glob("*.rrd"))) < 2:
        opened.frame(recorded.frame(seq, image), recorded.record(seq), lambda: None)
        seq += 1
        wait_until(lambda count=seq: opened.frames_written >= count - 20, "it is written")
    opened.close(timeout_s=60.0)
    return folder


@contextmanager
def viewing(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``gripmon view`` on a folder, and the address that it printed."""
    command = [*GRIPMON, "view", str(folder), "--web"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        assert process.stdout is not None and process.stderr is not None
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:"), process.stderr.read()
        yield process, url
    finally:
        process.kill()
        process.communicate()


def ports_of(url: str) -> list[int]:
    return [int(port) for port in re.findall(r"127\.0\.0\.1:(\d+)", urllib.parse.unquote(url))]


def test_what_cannot_be_shown_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.rrd").write_text("no recording")
    (tmp_path / "right.rrd").write_bytes(b"RRF2 and more")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = str(other.getsockname()[1])
        for arguments, code, said in (
            (("none.rrd",), 2, f"{tmp_path}/none.rrd: there is no such file; recordings of gripmon run, or their"),
            (("empty",), 2, f"{tmp_path}/empty: no .rrd file in it; recordings of gripmon run, or their folder"),
            (("text.rrd",), 2, f"{tmp_path}/text.rrd: isn't a recording; an .rrd file of gripmon's"),
            (("right.rrd", "--native"), 3, "view: there is no display for a window; the web viewer needs none"),
            (("right.rrd", "--web", "--port", port), 2, f"--port {port}: is in use on 127.0.0.1; another port"),
        ):
            assert main(["view", str(tmp_path / arguments[0]), *arguments[1:]]) == code
            (line,) = capsys.readouterr().err.splitlines()
            assert line.startswith(said)


def test_view_serves_the_files_on_this_machine_alone_and_leaves_nothing_running(two_files: Path, tmp_path: Path):
    with viewing(two_files) as (process, url):
        with urllib.request.urlopen(url) as answer:
            assert b"rerun" in answer.read().lower()
        _, port = ports_of(url)
        with receiver(ViewSettings(port=port), tmp_path / "seen.rrd"):
            wait_until(lambda: seqs_of(tmp_path / "seen.rrd"), "frames")  # it saves the last ones when it ends
        assert seqs_of(tmp_path / "seen.rrd") <= set().union(*map(seqs_of, two_files.glob("*.rrd")))
        children = psutil.Process(process.pid).children(recursive=True)
        assert children, "the page is served by a process of its own"
        addresses = {c.laddr.ip for p in (psutil.Process(process.pid), *children) for c in p.net_connections("tcp")}
        assert addresses == {"127.0.0.1"}, "nobody else can see it"
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 130
        assert not [child for child in children if child.is_running()]
        assert not any(listens(port) for port in ports_of(url))


def test_a_view_that_is_killed_leaves_nothing_running_either(two_files: Path):
    with viewing(two_files) as (process, url):
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.wait()
        psutil.wait_procs(children, timeout=WAIT_S)
        assert not [child for child in children if child.is_running()]
        assert not any(listens(port) for port in ports_of(url))


def test_the_page_shows_the_recording_in_a_browser(two_files: Path):
    opened = browser("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")

    def shows_the_image() -> bool:
        picture = cv2.imdecode(np.frombuffer(opened.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR).astype(int)
        magenta = (picture[..., 0] > 180) & (picture[..., 1] < 90) & (picture[..., 2] > 180)
        return bool(magenta.mean() > 0.02)

    try:
        with viewing(two_files) as (_, url):
            opened.get(f"{url}&renderer=webgl")
            wait_until(shows_the_image, "the recorded image on the page")
    finally:
        opened.quit()
