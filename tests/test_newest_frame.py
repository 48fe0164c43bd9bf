"""Newest frame wins: a reader in its own thread, and a consumer that never waits for long."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from gripmon.io.sources import (
    READ_TIMEOUT_S,
    NewestFrame,
    Waiting,
)
from gripmon.model.records import Frame


class ScriptedReader:
    """Gives what the test puts in, and blocks while there is nothing."""

    def __init__(self) -> None:
        self.items: list[Frame | Waiting | BaseException | None] = []
        self.changed = threading.Condition()
        self.taken = 0
        self.closed_by: str | None = None
        self.interrupted = False
        self.connected = True

    def put(self, *items: Frame | Waiting | BaseException | None) -> None:
        """Returns when the thread has taken all of them and asks for more."""
        with self.changed:
            self.items += items
            self.changed.notify_all()
            assert self.changed.wait_for(lambda: not self.items and self.taken > 0, 5.0)

    def read(self) -> Frame | Waiting | None:
        with self.changed:
            self.taken += 1
            self.changed.notify_all()
            self.changed.wait_for(lambda: bool(self.items) or self.interrupted)
            if not self.items:
                return None
            item = self.items.pop(0)
            self.taken = 0
        if isinstance(item, BaseException):
            raise item
        return item

    def interrupt(self) -> None:
        with self.changed:
            self.interrupted = True
            self.changed.notify_all()

    def close(self) -> None:
        self.closed_by = threading.current_thread().name


def frame_of(seq: int) -> Frame:
    return Frame(seq, seq, np.full((4, 6), seq, np.uint8))


def test_newest_frame_wins_and_the_others_are_counted():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    reader.put(*(frame_of(i) for i in range(5)))
    first = newest.read()
    assert isinstance(first, Frame) and first.seq == 4
    assert newest.dropped == 4
    reader.put(frame_of(5))
    second = newest.read()
    assert isinstance(second, Frame) and second.seq == 5
    assert newest.dropped == 4
    newest.close()
    assert newest.read() is None


def test_waiting_within_half_a_second_with_the_readers_reason():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    reader.put(Waiting("no cable"))
    before_s = time.monotonic()
    assert newest.read() == Waiting("no cable")
    assert time.monotonic() - before_s >= 0.9 * READ_TIMEOUT_S
    reader.put(frame_of(0))
    assert isinstance(newest.read(), Frame)
    silent = newest.read()
    assert isinstance(silent, Waiting) and "silent" in silent.reason
    newest.close()


def test_a_frame_wakes_the_waiting_consumer():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    got: list[object] = []
    consumer = threading.Thread(target=lambda: got.append(newest.read()))
    consumer.start()
    reader.put(frame_of(3))
    consumer.join(60.0)
    assert isinstance(got[0], Frame)
    newest.close()


def test_an_exception_in_the_reader_surfaces_after_its_last_frame():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    with reader.changed:
        reader.items += [frame_of(0), RuntimeError("driver broke")]
        reader.changed.notify_all()
    newest._thread.join(60.0)
    assert isinstance(newest.read(), Frame)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="driver broke"):
            newest.read()
    assert not newest.connected
    assert reader.closed_by == "gripmon-frames"
    newest.close()
    assert newest.read() is None


def test_the_readers_end_comes_after_its_last_frame():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    with reader.changed:
        reader.items += [frame_of(0), None]
        reader.changed.notify_all()
    newest._thread.join(60.0)
    assert isinstance(newest.read(), Frame)
    assert newest.read() is None and newest.read() is None
    newest.close()


def test_close_ends_the_thread_and_wakes_the_consumer():
    reader = ScriptedReader()
    newest = NewestFrame(reader)
    got: list[object] = []
    consumer = threading.Thread(target=lambda: got.append(newest.read()))
    consumer.start()
    newest.close()
    newest.close()
    consumer.join(60.0)
    assert got == [None]
    assert not newest._thread.is_alive()
    assert reader.closed_by == "gripmon-frames", "the capture is released by the thread that used it"


def test_close_does_not_wait_for_a_driver_that_hangs(caplog: pytest.LogCaptureFixture):
    hanging = threading.Event()

    class Hanging(ScriptedReader):
        def read(self) -> None:
            hanging.wait()

    newest = NewestFrame(Hanging(), close_within_s=0.05)
    newest.close()
    assert newest._thread.is_alive() and "left behind" in caplog.text
    hanging.set()
    newest._thread.join(60.0)
    assert not newest._thread.is_alive()
