"""The live camera against a real MJPEG server on loopback, which comes, hangs, goes and comes again."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from gripmon.io.sources import LiveCamera, LiveSettings, SourceError, Waiting, open_source
from gripmon.io.sources.live import Backlog, shown_name
from gripmon.model.records import Frame

PERIOD_S = 0.02


class MjpegServer:
    """Serves grey frames whose brightness is their number; can fall silent with the connection open, and hold frames
    back to send them all at once.  ``made_s``: when each was made, by the monotonic clock.
    """

    def __init__(self, port: int = 0) -> None:
        self.stopping, self.silent, self.held = threading.Event(), threading.Event(), threading.Event()
        self.made_s: list[float] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    outer.stream(self.wfile.write)
                except OSError:
                    return  # the client went away

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,))
        self._thread.start()

    def stream(self, send: Callable[[bytes], object]) -> None:
        count, waiting = 0, b""
        self.made_s.clear()
        while not self.stopping.wait(PERIOD_S):
            if self.silent.is_set():
                continue
            jpeg = cv2.imencode(".jpg", np.full((96, 128, 3), count % 250, np.uint8))[1].tobytes()
            head = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
            self.made_s.append(time.monotonic())
            waiting += head + jpeg + b"\r\n"
            count += 1
            if not self.held.is_set():
                send(waiting)
                waiting = b""

    def stop(self) -> None:
        self.stopping.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def servers() -> Iterator[list[MjpegServer]]:
    running: list[MjpegServer] = []
    yield running
    for server in running:
        server.stop()


def camera_at(port: int, **settings) -> LiveCamera:
    source = open_source(
        LiveSettings(
            device=f"http://127.0.0.1:{port}/video",
            retry_first_s=0.05,
            retry_longest_s=0.2,
            open_timeout_s=1.0,
            **settings,
        )
    )
    assert isinstance(source, LiveCamera)
    return source


def next_frame(camera: LiveCamera, within_s: float = 20.0) -> Frame:
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        if isinstance(item := camera.read(), Frame):
            return item
    raise AssertionError(f"no frame within {within_s} s")


def next_waiting(camera: LiveCamera, what: str, within_s: float = 20.0) -> Waiting:
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        if isinstance(item := camera.read(), Waiting) and what in item.reason:
            return item
    raise AssertionError(f"never waiting because of '{what}' within {within_s} s")


def test_frames_arrive_with_unix_stamps_and_the_newest_wins(servers: list[MjpegServer]):
    servers.append(MjpegServer())
    before_ns = time.time_ns()
    camera = camera_at(servers[0].port)
    try:
        first = next_frame(camera)
        assert camera.live and camera.connected
        assert first.image is not None and first.image.shape == (96, 128, 3)
        assert before_ns < first.stamp_ns < time.time_ns()
        time.sleep(20 * PERIOD_S)
        later = next_frame(camera)
        # Some more may have come, and been replaced, since the later one was taken: a busy machine takes a while.
        assert 3 < later.seq - first.seq - 1 <= camera.dropped <= later.seq - first.seq + 4
        assert later.stamp_ns > first.stamp_ns
        assert later.image is not None
        # the server counts in brightness what it sent: nothing is lost but what was counted as dropped
        assert float(later.image.mean() - first.image.mean()) == pytest.approx(later.seq - first.seq, abs=2.0)
    finally:
        camera.close()
    assert camera.read() is None and not camera.connected


def test_the_camera_comes_back_after_its_server_was_gone(servers: list[MjpegServer]):
    servers.append(MjpegServer())
    port = servers[0].port
    camera = camera_at(port)
    try:
        last = next_frame(camera)
        servers.pop().stop()
        waiting = next_waiting(camera, "next attempt")
        assert str(port) in waiting.reason
        assert not camera.connected
        servers.append(MjpegServer(port))
        back = next_frame(camera)
        assert camera.connected and back.seq > last.seq and back.stamp_ns > last.stamp_ns
    finally:
        camera.close()


def test_frames_that_queued_up_while_the_network_stood_still_are_dropped(servers: list[MjpegServer]):
    """Frames are no older than they say: those of the first 1.5 s are sent all at once."""
    servers.append(MjpegServer())
    server, shown = servers[0], []
    camera = camera_at(server.port)
    try:
        for _ in range(40):
            next_frame(camera)
        server.held.set()
        time.sleep(1.5)
        server.held.clear()
        while len(shown) < 20:
            if (frame := next_frame(camera)).arrived_ns > 1e9 * server.made_s[-1] - 1e9:
                shown.append((round(float(frame.image.mean())), 1e-9 * frame.arrived_ns))
        dropped = camera.dropped
    finally:
        camera.close()
    old = [number for number, arrived_s in shown if arrived_s - server.made_s[number] > 0.5]
    assert old == [] and dropped > 30


def queued_of(taken_s: np.ndarray, read_s: np.ndarray) -> tuple[int, np.ndarray]:
    """How many frames are taken for queued, and the ages (s) of the others."""
    backlog = Backlog()
    kept = np.array([not backlog.queued(at_s) for at_s in read_s.tolist()])
    return int((~kept).sum()), (read_s - taken_s)[kept]


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.parametrize("decoding_s", [0.001, 0.02, 0.028])
def test_queued_frames_are_told_by_their_pace(decoding_s: float, jitter: float):
    """Twenty-five a second; for two seconds nothing can be read, then as fast as frames can be decoded."""
    taken_s = np.arange(1000) / 25.0 + 0.04 * jitter * (np.arange(1000) % 2)
    read_s, free_s = [], 0.0
    for at_s in taken_s.tolist():
        free_s = max(at_s if not 4.0 < at_s < 6.0 else 6.0, free_s + decoding_s)
        read_s.append(free_s)
    queued, ages_s = queued_of(taken_s, np.array(read_s))
    assert ages_s.max() < 0.1 and queued <= 2.1 / (0.04 - decoding_s)


@pytest.mark.parametrize("later_fps", [5.0, 25.0, 60.0])
def test_after_a_silence_in_which_nothing_queued_up_frames_go_on(later_fps: float):
    """Frames that were lost, or a camera that paused, perhaps to go on at another rate."""
    taken_s = np.concatenate([np.arange(100) / 25.0, 6.0 + np.arange(300) / later_fps])
    queued, ages_s = queued_of(taken_s, taken_s)
    assert queued <= {5.0: 12, 25.0: 3, 60.0: 90}[later_fps] and len(ages_s) > 300


def test_a_stream_that_falls_silent_is_opened_again(servers: list[MjpegServer]):
    servers.append(MjpegServer())
    camera = camera_at(servers[0].port, read_timeout_s=0.3)
    try:
        last = next_frame(camera)
        servers[0].silent.set()
        next_waiting(camera, "next attempt")
        assert not camera.connected
        servers[0].silent.clear()
        back = next_frame(camera)
        assert camera.connected and back.seq > last.seq and back.stamp_ns > last.stamp_ns
    finally:
        camera.close()


def test_without_a_camera_it_keeps_trying_and_says_so():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound, but it doesn't listen: connections are refused
        camera = camera_at(unused.getsockname()[1])
        try:
            assert "can't be opened; next attempt after 0.2 s" in next_waiting(camera, "0.2 s").reason
            assert not camera.connected and camera.dropped == 0
        finally:
            camera.close()


def test_a_missing_v4l2_device_is_no_error_at_the_start():
    camera = open_source(LiveSettings(device="/dev/video_that_is_not_there", retry_first_s=0.05))
    try:
        assert isinstance(camera, LiveCamera)
        next_waiting(camera, "can't be opened")
    finally:
        camera.close()


def test_a_process_ends_at_once_while_the_camera_hangs_in_the_driver():
    """A server that accepts and never answers: open() blocks for longer than the process may take to stop."""
    code = (
        "import sys, time\n"
        "from gripmon.io.sources import LiveSettings, Waiting, open_source\n"
        "camera = open_source(LiveSettings(device=sys.argv[1], open_timeout_s=60.0, read_timeout_s=60.0))\n"
        "assert isinstance(camera.read(), Waiting)\n"
        "time.sleep(0.3)\n"
        "camera.close()\n"
        "assert camera.read() is None\n"
        "print('closed', flush=True)\n"
    )
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        url = f"http://127.0.0.1:{mute.getsockname()[1]}/video"
        done = subprocess.run(
            [sys.executable, "-c", code, url],
            capture_output=True,
            text=True,
            timeout=30.0,  # far below the driver's 60 s
            cwd=Path(__file__).parent.parent,
        )
    assert (done.returncode, done.stdout) == (0, "closed\n"), done.stderr


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (LiveSettings(device="video.mp4"), "has no known form"),
        (LiveSettings(device=-1), "not an index"),
        (LiveSettings(device="0"), "without quotes"),
        (LiveSettings(device=""), "has no known form"),
    ],
)
def test_devices_of_no_known_form_are_refused(settings: LiveSettings, complaint: str):
    with pytest.raises(SourceError, match=rf"^device: .*{complaint}"):
        open_source(settings)


@pytest.mark.skipif(cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), reason="this OpenCV has GStreamer")
def test_a_pipeline_without_gstreamer_is_refused_with_the_reason():
    with pytest.raises(SourceError, match=r"^device: needs the gstreamer backend.*; a build of OpenCV with it"):
        open_source(LiveSettings(device="videotestsrc ! appsink"))


def test_a_password_is_not_shown():
    assert shown_name("rtsp://user:secret@10.0.0.3:554/s?x=1@2") == "rtsp://10.0.0.3:554/s?x=1@2"
    assert shown_name("rtspsrc location=rtsp://u:p@host/a ! decodebin ! appsink").count("u:p") == 0
    assert shown_name(0) == "camera 0"
    assert shown_name("/dev/video0") == "/dev/video0"
