"""The source that listens on the network: what it takes for a frame, with which stamp, and what it says otherwise."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import zenoh
from support.loopback import WAIT_S, free_endpoint, plain_session, wait_until
from support.sent_frames import HEIGHT, WIDTH, colour, grey, note, raw_note

from gripmon.io.publish.feeding import FramePublisher, raw_encoding
from gripmon.io.sources import (
    READ_TIMEOUT_S,
    LiveSettings,
    NetworkCamera,
    NetworkSettings,
    SourceError,
    SourceSettings,
    Waiting,
    open_source,
)
from gripmon.io.sources.lateness import clock_fault
from gripmon.io.wire import Keys, Link, PublishSettings, malformed
from gripmon.model.records import Frame, Refusal

KEY = "cell/camera"


class Driver:
    """A camera's driver in a plain session, the source that hears it, and the link between them."""

    def __init__(self, session: zenoh.Session, link: Link) -> None:
        self.session = session
        self._link = link
        self.camera = self.opened(NetworkSettings(key=KEY, silent_after_s=1.0))
        self._publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: self._publisher.matching_status.matching, "the source to listen")

    def opened(self, settings: NetworkSettings) -> NetworkCamera:
        return NetworkCamera(settings, self._link, "image", (WIDTH, HEIGHT))

    def put(self, image: np.ndarray | bytes, attachment: bytes | None = None) -> None:
        """Returns when it has arrived."""
        data = image if isinstance(image, bytes) else image.tobytes()
        before = self.camera._last_arrival_s
        self._publisher.put(data, attachment=raw_note() if attachment is None else attachment)
        wait_until(lambda: self.camera._last_arrival_s != before, "the sample to arrive")


@pytest.fixture
def driver() -> Iterator[Driver]:
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,)))
    try:
        with plain_session(connect=endpoint) as session:
            made = Driver(session, link)
            yield made
            made.camera.close()
    finally:
        link.close()


def frame_of(camera: NetworkCamera) -> Frame:
    item = camera.read()
    assert isinstance(item, Frame), item
    return item


def test_the_newest_frame_wins_and_the_others_are_counted(driver: Driver):
    for seed in range(4):
        driver.put(grey(seed), raw_note(stamp_ns=seed, jaw_opening_m=0.01 * seed))
    first = frame_of(driver.camera)
    np.testing.assert_array_equal(first.image, grey(3))
    assert (first.seq, first.stamp_ns, first.jaw_opening_m, first.name) == (3, 3, 0.03, KEY)
    assert driver.camera.dropped == 3
    driver.put(grey(4), raw_note(stamp_ns=4))
    second = frame_of(driver.camera)
    assert (second.seq, second.stamp_ns, second.jaw_opening_m) == (4, 4, None)
    assert driver.camera.dropped == 3 and driver.camera.malformed == 0


def test_a_frame_wakes_the_reader_and_so_does_closing(driver: Driver):
    # Waits of half a second each; what is right comes after some of them at the latest.
    got: list[object] = []

    def read_to_the_end() -> None:
        while (item := driver.camera.read()) is not None:
            got.append(item)
        got.append(None)

    reader = threading.Thread(target=read_to_the_end)
    reader.start()
    driver.put(grey(), raw_note(stamp_ns=9))
    wait_until(lambda: any(isinstance(item, Frame) for item in got), "the frame")
    driver.camera.close()
    driver.camera.close()
    reader.join(WAIT_S)
    assert got[-1] is None and driver.camera.read() is None
    assert not driver.camera.connected


def test_a_stamp_is_the_drivers_or_zenohs_or_that_of_the_arrival(driver: Driver):
    before_ns = time.time_ns()
    driver.put(grey())
    arrived = frame_of(driver.camera).stamp_ns
    assert before_ns <= arrived <= time.time_ns()
    stamp = zenoh.Timestamp.parse_rfc3339("2024-07-01T13:51:12.129693000Z/33")
    received = driver.camera._last_arrival_s
    driver.session.put(KEY, grey().tobytes(), attachment=raw_note(), timestamp=stamp)
    wait_until(lambda: driver.camera._last_arrival_s != received, "the sample to arrive")
    # 2024-07-01T13:51:12 UTC by the calendar
    assert abs(frame_of(driver.camera).stamp_ns - 1_719_841_872_129_693_000) < 1000


def test_malformed_payloads_are_passed_over_as_long_as_good_ones_come(driver: Driver, caplog: pytest.LogCaptureFixture):
    camera = driver.camera
    seqs = []
    for seed in range(3):
        driver.put(b"rubbish")
        reader: list[Frame | Waiting | None] = []
        thread = threading.Thread(target=lambda out=reader: out.append(camera.read()))
        thread.start()
        wait_until(lambda before=seed: camera.malformed == before + 1, "the rubbish to be counted")
        driver.put(grey(seed), raw_note(stamp_ns=seed))
        thread.join(WAIT_S)
        frame = reader[0] if isinstance(reader[0], Frame) and reader[0].image is not None else frame_of(camera)
        np.testing.assert_array_equal(frame.image, grey(seed))
        seqs.append(frame.seq)
    assert camera.malformed == 3 and camera.dropped == 0
    assert seqs == sorted(seqs)
    assert camera.fault().startswith(f"some malformed frames on {KEY}: ")
    assert camera.fault().endswith(f"; stamps on {KEY} are a day or more behind this machine's clock")
    assert len([r for r in caplog.records if "malformed frame" in r.message]) == 1, "said once"


def test_an_image_of_another_size_is_refused_as_that(driver: Driver):
    other = np.zeros((HEIGHT, WIDTH // 2), np.uint8)
    driver.put(other, note(width=WIDTH // 2, height=HEIGHT, encoding="mono8"))
    bad = frame_of(driver.camera)
    assert bad.image is None and bad.refusal is Refusal.WRONG_SIZE
    assert bad.fault == "20x30 pixels; 40x30 as the camera's calibration says"
    driver.put(b"rubbish")
    assert frame_of(driver.camera).refusal is Refusal.NOT_AN_IMAGE


def test_good_frames_end_what_is_said_of_bad_ones(driver: Driver, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(malformed, "CALM_S", 0.0)
    driver.put(b"rubbish")
    assert frame_of(driver.camera).image is None
    assert driver.camera.fault().startswith("1 malformed frame on ")
    driver.put(grey(), raw_note(stamp_ns=time.time_ns()))
    assert frame_of(driver.camera).image is not None
    assert driver.camera.fault() == "" and driver.camera.malformed == 1


def test_rubbish_alone_is_a_camera_that_delivers_rubbish(driver: Driver):
    driver.put(grey(), raw_note(stamp_ns=10**18))
    good = frame_of(driver.camera)
    for _ in range(3):
        driver.put(b"rubbish")
    began_s = time.monotonic()
    bad = frame_of(driver.camera)
    assert time.monotonic() - began_s >= 0.9 * READ_TIMEOUT_S, "however much comes, it is one frame in that time"
    assert bad.image is None and bad.fault == "7 bytes; 1200 (30 rows of 40)"
    assert bad.seq > good.seq
    assert 0.4e9 < bad.stamp_ns - good.stamp_ns < 60e9, "on the camera's clock, which isn't ours"


def test_a_decoder_that_breaks_does_not_end_the_monitor(driver: Driver, monkeypatch: pytest.MonkeyPatch):
    def broken(*_: object) -> None:
        raise RuntimeError("out of order")

    with monkeypatch.context() as patched:
        patched.setattr(driver.camera._decoder, "decode", broken)
        driver.put(grey())
        assert frame_of(driver.camera).fault == "out of order"
    driver.put(grey())
    assert frame_of(driver.camera).fault is None


def test_an_attachment_beyond_its_bounds_is_not_looked_at(driver: Driver):
    driver.put(grey(), raw_note() + b" " * 100_000)
    fault = frame_of(driver.camera).fault
    assert fault is not None and fault.startswith("an attachment of 100")


@pytest.mark.parametrize(
    ("late_s", "said"),
    [
        (0.0, ""),
        (2.9, ""),
        (-2.9, ""),
        (3.1, "some seconds or more behind"),
        (-600.0, "a minute or more ahead of"),
        (4_000.0, "an hour or more behind"),
        (1.7e9, "a day or more behind"),
    ],
)
def test_a_clock_that_is_not_ours_is_said(late_s: float, said: str):
    unix_ns = 1_700_000_000_000_000_000
    text = clock_fault(KEY, unix_ns - round(1e9 * late_s), unix_ns)
    assert text == (f"stamps on {KEY} are {said} this machine's clock" if said else "")


def test_silence_is_said_with_its_reason(driver: Driver):
    camera = driver.camera
    assert camera.read() == Waiting(f"nothing on {KEY} yet")
    assert not camera.connected
    driver.put(grey())
    assert camera.connected
    frame_of(camera)
    wait_until(lambda: not camera.connected, "the camera to be missed")
    assert camera.read() == Waiting(f"{KEY} is silent")
    driver.put(grey())
    assert camera.connected


def test_a_sample_that_deletes_is_no_frame(driver: Driver):
    driver.session.delete(KEY)
    driver.put(grey(), raw_note(stamp_ns=1))
    frame_of(driver.camera)
    assert driver.camera.malformed == 0 and driver.camera.dropped == 0


def test_closing_after_the_session_was_closed_does_no_harm():
    link = Link(PublishSettings(listen=(free_endpoint(),)))
    camera = NetworkCamera(NetworkSettings(), link, KEY, (WIDTH, HEIGHT))
    link.close()
    camera.close()
    assert camera.read() is None


def test_without_a_router_the_reason_names_the_network():
    link = Link(PublishSettings(mode="client", connect=(free_endpoint(),)))
    camera = NetworkCamera(NetworkSettings(), link, KEY, (WIDTH, HEIGHT))
    try:
        waiting = camera.read()
        assert isinstance(waiting, Waiting)
        assert waiting.reason.startswith(f"nothing on {KEY} yet (no ")
    finally:
        camera.close()
        link.close()


@pytest.mark.parametrize("frame_format", ["raw", "jpeg", "png"])
def test_what_our_own_driver_sends_is_understood(driver: Driver, frame_format: str):
    publisher = FramePublisher(driver.session, KEY, frame_format)  # type: ignore[arg-type]
    image = cv2.GaussianBlur(grey() if frame_format == "jpeg" else colour(), (0, 0), 3.0)
    before = driver.camera._last_arrival_s
    publisher.put(image, stamp_ns=12, jaw_opening_m=0.025)
    wait_until(lambda: driver.camera._last_arrival_s != before, "the frame")
    frame = frame_of(driver.camera)
    assert (frame.stamp_ns, frame.jaw_opening_m) == (12, 0.025)
    tolerance = 12 if frame_format == "jpeg" else 0
    assert frame.image is not None and np.abs(frame.image.astype(int) - image).max() <= tolerance


@pytest.mark.parametrize(
    "image",
    [np.zeros(4, np.uint8), np.zeros((4, 4, 2), np.uint8), np.zeros((4, 4), np.float64), np.zeros((4, 4, 4), np.uint8)],
)
def test_our_own_driver_refuses_what_is_no_image(image: np.ndarray):
    with pytest.raises(ValueError, match="no image"):
        raw_encoding(image)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"key": "a/*/b"}, "key"),
        ({"key": "a//b"}, "key"),
        ({"key": "/a"}, "key"),
        ({"key": ""}, "key"),
        ({"format": "bmp"}, "format"),
        ({"domain_id": 233}, "domain_id"),
        ({"silent_after_s": 0}, "silent_after_s"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], said: str):
    with pytest.raises(msgspec.ValidationError, match=said):
        msgspec.convert({"kind": "zenoh", **settings}, SourceSettings)


def test_without_a_session_there_is_no_network():
    with pytest.raises(SourceError, match=r"kind: zenoh has no session here; publish.enabled: true"):
        open_source(NetworkSettings(), Path(), keys=Keys("arm", "wrist"))
    assert isinstance(msgspec.convert({"kind": "live", "device": 0}, SourceSettings), LiveSettings)
