"""A live camera's thread around a driver that may block, break or hang: the newest frame wins, nobody waits long."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from support.loopback import wait_until

from gripmon.io.sources import READ_TIMEOUT_S, LiveCamera, LiveSettings, Waiting, live
from gripmon.model.records import Frame


class ScriptedDriver:
    """Gives what the test puts in (a grey level, False: it is gone, or an exception), and blocks meanwhile."""

    def __init__(self) -> None:
        self.items: list[int | bool | BaseException] = []
        self.changed = threading.Condition()
        self.asked = self.closed = False
        self.absent = False
        self.released_by: list[str] = []

    def put(self, *items: int | bool | BaseException) -> None:
        """Returns when the thread has taken all of them and asks for more."""
        with self.changed:
            self.items += items
            self.asked = False
            self.changed.notify_all()
            assert self.changed.wait_for(lambda: not self.items and self.asked, 60.0)

    def grab(self) -> bool:
        with self.changed:
            self.asked = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: bool(self.items) or self.closed)
            item = self.items.pop(0) if self.items else False
            self.asked = False
        if isinstance(item, BaseException):
            raise item
        self.level = item
        return item is not False

    def image(self) -> tuple[np.ndarray, None]:
        return np.full((4, 6, 3), self.level, np.uint8), None

    def release(self) -> None:
        self.released_by.append(threading.current_thread().name)

    def end(self) -> None:
        with self.changed:
            self.closed = True
            self.changed.notify_all()


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[ScriptedDriver]:
    scripted = ScriptedDriver()
    monkeypatch.setattr(live._VideoCapture, "open", lambda *_: None if scripted.absent else scripted)
    # Told by a clock, which tests of order have none of.
    monkeypatch.setattr(live.Backlog, "queued", lambda *_: False)
    yield scripted
    scripted.end()


def camera_of(_driver: ScriptedDriver, **how: float) -> LiveCamera:
    return LiveCamera(LiveSettings(device=0, retry_first_s=0.8), **how)


def end(driver: ScriptedDriver, camera: LiveCamera) -> None:
    driver.end()
    camera.close()


def test_newest_frame_wins_and_the_others_are_counted(driver: ScriptedDriver):
    camera = camera_of(driver)
    driver.put(0, 1, 2, 3, 4)
    first = camera.read()
    assert isinstance(first, Frame) and first.seq == 4 and first.image[0, 0, 0] == 4
    assert camera.dropped == 4 and camera.connected
    driver.put(5)
    second = camera.read()
    assert isinstance(second, Frame) and second.seq == 5
    assert camera.dropped == 4
    end(driver, camera)
    assert camera.read() is None and not camera.connected


def test_waiting_within_half_a_second_with_the_reason(driver: ScriptedDriver):
    driver.absent = True
    camera = camera_of(driver)
    before_s = time.monotonic()
    assert isinstance(waiting := camera.read(), Waiting)
    assert waiting.reason == "camera 0 can't be opened; next attempt after 0.8 s"
    assert time.monotonic() - before_s >= 0.9 * READ_TIMEOUT_S
    driver.absent = False
    driver.put(0)
    assert isinstance(camera.read(), Frame)
    assert camera.read() == Waiting("the camera is silent")
    end(driver, camera)


def test_a_frame_wakes_the_waiting_consumer(driver: ScriptedDriver):
    camera = camera_of(driver)
    got: list[object] = []
    consumer = threading.Thread(target=lambda: got.append(camera.read()))
    consumer.start()
    driver.put(3)
    consumer.join(60.0)
    assert isinstance(got[0], Frame)
    end(driver, camera)


def test_an_exception_in_the_driver_surfaces_after_its_last_frame(driver: ScriptedDriver):
    driver.items += [0, RuntimeError("driver broke")]
    camera = camera_of(driver)
    camera._thread.join(60.0)
    assert isinstance(camera.read(), Frame)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="driver broke"):
            camera.read()
    assert not camera.connected
    assert driver.released_by == ["gripmon-camera"]
    camera.close()
    assert camera.read() is None


def test_close_ends_the_thread_and_wakes_the_consumer(driver: ScriptedDriver):
    driver.absent = True
    camera = camera_of(driver)
    got: list[object] = []
    consumer = threading.Thread(target=lambda: got.append(camera.read()))
    consumer.start()
    camera.close()
    camera.close()
    consumer.join(60.0)
    assert got == [None] or isinstance(got[0], Waiting)
    assert not camera._thread.is_alive(), "a pause ends at once"


def test_close_does_not_wait_for_a_driver_that_hangs(driver: ScriptedDriver, caplog: pytest.LogCaptureFixture):
    camera = camera_of(driver, close_within_s=0.05)
    driver.put(1)
    camera.close()
    assert camera._thread.is_alive() and "left behind" in caplog.text
    driver.end()
    camera._thread.join(60.0)
    assert not camera._thread.is_alive()
    assert driver.released_by == ["gripmon-camera"], "the capture is released by the thread that used it"


def test_pauses_double_up_to_the_longest_and_start_again_after_success(
    driver: ScriptedDriver, monkeypatch: pytest.MonkeyPatch
):
    pauses_s: list[float] = []
    held = threading.Semaphore(0)

    def paused(timeout: float) -> bool:
        pauses_s.append(timeout)
        return held.acquire(timeout=60.0)

    camera = LiveCamera(LiveSettings(device=0, retry_first_s=0.5, retry_longest_s=10.0))
    monkeypatch.setattr(camera._stop, "wait", paused)
    driver.absent = True
    with driver.changed:
        driver.items += [False]
        driver.changed.notify_all()
    for _ in range(6):
        held.release()
    wait_until(lambda: len(pauses_s) == 7, "seven pauses")
    assert pauses_s == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    driver.absent = False
    held.release()
    driver.put(1)
    driver.items += [False]
    with driver.changed:
        driver.changed.notify_all()
    wait_until(lambda: len(pauses_s) == 8, "the next one")
    assert pauses_s[-1] == 0.5
    held.release()
    end(driver, camera)
