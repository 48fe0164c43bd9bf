"""Which frames show a pulse: by stamps, in seconds of a made-up clock."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.laser.matching import Matcher, PulseSettings, ReportedPulse, Shown, mean_image
from gripmon.model.records import Frame, PulseFault

POSE = np.eye(4)
SETTINGS = PulseSettings(margin_s=0.05, history_s=2.0, most_frames=3, wait_s=1.0)


def ns(seconds: float) -> int:
    return round(1e9 * seconds)


class Bench:
    """Frames are numbered by their hundredths of a second."""

    def __init__(self, settings: PulseSettings = SETTINGS) -> None:
        self.matcher = Matcher(settings)
        self.shown: list[Shown] = []

    def frames(self, *seconds: float, good: bool = True) -> Bench:
        for at in seconds:
            image = np.full((4, 4), 9, np.uint8) if good else None
            self.shown += self.matcher.frame(Frame(round(100 * at), ns(at), image, fault=None if good else "torn"))
        return self

    def pulse(self, begin: float, end: float, x_m: float = 0.0, now_s: float = 0.0) -> Bench:
        pose = POSE.copy()
        pose[0, 3] = x_m
        self.shown += self.matcher.pulse(ReportedPulse(ns(begin), ns(end), pose), now_s)
        return self

    def table(self, *spans: tuple[float, float]) -> Bench:
        self.matcher.load([ReportedPulse(ns(begin), ns(end), POSE) for begin, end in spans])
        return self

    def said(self) -> list[tuple[float, list[int], int | None, str]]:
        return [
            (
                each.pulse.stamp_ns / 1e9,
                [frame.seq for frame in each.lit],
                None if each.dark is None else each.dark.seq,
                "" if each.fault is None else each.fault.value,
            )
            for each in self.shown
        ]


def test_frames_within_and_the_last_one_before():
    bench = Bench().frames(0.9, 0.97).pulse(1.0, 1.3).frames(1.02, 1.1, 1.2, 1.24, 1.27)
    assert not bench.shown, "its last frame may still come"
    assert bench.frames(1.31).said() == [(1.0, [110, 120, 124], 90, "")]


def test_the_same_when_it_is_told_afterwards():
    bench = Bench().frames(0.9, 0.97, 1.02, 1.1, 1.2, 1.24, 1.27, 1.31)
    assert bench.pulse(1.0, 1.3).said() == [(1.0, [110, 120, 124], 90, "")]


def test_the_newest_of_many_are_averaged():
    assert Bench().frames(1.1, 1.12, 1.14, 1.16, 1.18, 1.4).pulse(1.0, 1.3).said()[0][1] == [114, 116, 118]


def test_a_frame_that_another_pulse_lit_is_no_background():
    bench = Bench().frames(0.5, 1.1, 1.27, 1.5).pulse(1.0, 1.25).pulse(1.4, 1.6).frames(1.7)
    assert bench.said() == [(1.0, [110], 50, ""), (1.4, [150], 50, "")]


def test_a_pulse_told_twice_counts_once_before_and_after_it_is_judged():
    bench = Bench().frames(0.9).pulse(1.0, 1.3).pulse(1.0, 1.3).frames(1.1, 1.4).pulse(1.0, 1.3)
    assert [said[3] for said in bench.said()] == [""]
    assert bench.shown[0].pulse.number == 0


def test_pulses_that_overlap_contradict_each_other():
    bench = Bench().frames(0.9).pulse(1.0, 1.3).pulse(1.2, 1.5, x_m=0.1).frames(1.1, 1.4, 1.6).pulse(2.0, 2.3)
    assert [said[3] for said in bench.frames(2.1, 2.4).said()] == ["overlap", "overlap", ""]
    assert "two places" in bench.shown[0].reason


def test_the_same_time_with_another_pose_is_an_overlap_too():
    bench = Bench().frames(0.9).pulse(1.0, 1.3).pulse(1.0, 1.3, x_m=0.1).frames(1.1, 1.4)
    assert [said[3] for said in bench.said()] == ["overlap", "overlap"]


def test_after_one_was_judged_neither_an_overlapping_nor_an_earlier_one_counts():
    bench = Bench().frames(0.3, 0.5, 0.9, 1.1, 1.4).pulse(1.0, 1.3).pulse(1.25, 1.35, x_m=0.1).pulse(0.4, 0.6)
    assert [said[3] for said in bench.said()] == ["", "overlap", "out_of_order"]
    assert "out of order" in bench.shown[2].reason


@pytest.mark.parametrize(
    ("frames", "pulse", "fault", "words"),
    [
        ((0.9, 1.5), (1.0, 1.3), PulseFault.NO_FRAME, "nearest one is 0.1 s before its beginning"),
        ((0.9, 1.02, 1.27, 1.5), (1.0, 1.3), PulseFault.NO_FRAME, "no frame within its 0.3 s"),
        ((0.9, 1.03, 1.2), (1.0, 1.08), PulseFault.NO_FRAME, "lasts 0.08 s, of which margin_s, 0.05 s, is left out"),
        ((1.0, 1.2, 2.0, 3.5, 4.0), (1.1, 1.4), PulseFault.TOO_LATE, "was reported 2.6 s after its end"),
    ],
)
def test_why_no_frame_shows_it(
    frames: tuple[float, ...], pulse: tuple[float, float], fault: PulseFault, words: str
) -> None:
    (shown,) = Bench().frames(*frames).pulse(*pulse).shown
    assert shown.fault is fault and words in shown.reason and not shown.lit


def test_frames_that_are_no_images_show_nothing_and_are_no_background():
    bench = Bench().frames(0.5).frames(0.9, good=False).frames(1.1).frames(1.2, good=False).frames(1.4).pulse(1.0, 1.3)
    assert bench.said() == [(1.0, [110], 50, "")]
    bench.pulse(2.0, 2.3).frames(2.1, good=False).frames(2.4)
    assert (bench.shown[1].fault, bench.shown[1].reason) == (
        PulseFault.IMAGE, "none of its 1 frames can be used: torn"
    )  # fmt: skip


def test_a_pulse_of_another_clock_is_given_up_after_a_while():
    bench = Bench().frames(0.9).pulse(3600.0, 3600.3, now_s=50.0)
    bench.shown += bench.matcher.tick(51.2)
    assert not bench.shown, "its own length and a second more"
    bench.shown += bench.matcher.tick(51.4)
    assert bench.said() == [(3600.0, [], None, "no_frame")]
    assert "newest is 3.6e+03 s older" in bench.shown[0].reason


def test_a_table_waits_for_its_frames_for_ever_and_ends_with_them():
    bench = Bench().table((1.0, 1.3), (5.0, 5.3)).frames(0.9)
    assert bench.matcher.tick(1e9) == []
    bench.frames(1.1, 1.2)
    bench.shown += bench.matcher.finish()
    assert bench.said() == [(1.0, [110, 120], 90, ""), (5.0, [], None, "no_frame")]
    assert bench.matcher.finish() == []


def test_memory_is_bounded_by_bytes_and_by_time():
    bench = Bench(PulseSettings(history_s=2.0, history_bytes=1_000_000))
    for k in range(200):
        bench.matcher.frame(Frame(k, ns(0.01 * k), np.zeros((300, 300), np.uint8)))
    assert len(bench.matcher._kept.frames) == 11
    small = Bench(PulseSettings(history_s=0.1))
    small.frames(*(0.01 * k for k in range(100)))
    assert len(small.matcher._kept.frames) == 11


def test_frames_of_a_pulse_that_is_under_way_outlast_the_history():
    bench = Bench(PulseSettings(history_s=0.5, most_frames=1000)).frames(0.9).pulse(1.0, 8.0)
    bench.frames(*(1.1 + 0.1 * k for k in range(68)), 8.1)
    assert len(bench.shown[0].lit) == 68 and bench.shown[0].dark is not None


def test_a_clock_that_was_set_back_begins_anew():
    bench = Bench().frames(100.0, 100.9).pulse(101.0, 101.3).frames(101.1, 101.4)
    bench.frames(0.9).pulse(1.0, 1.3).frames(1.1, 1.4)
    assert bench.said() == [(101.0, [10110], 10090, ""), (1.0, [110], 90, "")]
    assert len(bench.frames(1.35).matcher._kept.frames) == 3, "a stamp that doesn't rise tells nothing new"


def test_strangers_cannot_fill_the_memory_with_pulses():
    bench = Bench().frames(0.9)
    for k in range(500):
        bench.pulse(1000.0 + k, 1000.5 + k, now_s=0.0)
    assert len(bench.shown) == 436 and "wait for their frames already" in bench.shown[0].reason
    assert bench.matcher.waiting == 64
    assert len(bench.matcher.tick(100.0)) == 64 and bench.matcher.waiting == 0


def test_a_long_table_is_matched_whole():
    """Ten thousand pulses: only the next ones are looked at with a frame, or this would take minutes."""
    bench = Bench().table(*((1.0 + k, 1.3 + k) for k in range(10_000)))
    for k in range(10_000):
        bench.frames(0.9 + k, 1.1 + k)
    bench.shown += bench.matcher.finish()
    assert [len(each.lit) for each in bench.shown] == [1] * 10_000
    assert all(each.dark is not None for each in bench.shown)


def test_the_mean_of_images_is_rounded_and_keeps_their_type():
    images = [np.full((2, 2), value, np.uint8) for value in (10, 11, 11)]
    mean = mean_image(tuple(Frame(k, k, image) for k, image in enumerate(images)))
    assert mean.dtype == np.uint8 and (mean == 11).all()
    assert mean_image((Frame(0, 0, images[0]),)) is images[0]
