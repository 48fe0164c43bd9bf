"""What makes the judge worth asking: a blur, a finger, residuals or jaws otherwise than usually."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.shown_edges import OPENING_M

from gripmon.judge.causes import BlurWatch, FingerWatch, JawWatch, ResidualWatch


def test_a_blur_that_stays_as_it_is_is_no_news_and_another_one_is():
    rng = np.random.default_rng(3)
    watch = BlurWatch()
    assert not any(watch.add(0.7 + rng.normal(0.0, 0.05)) for _ in range(500))
    assert not any(watch.add(blur_px) for blur_px in (2.0, 2.1, None))  # two frames decide nothing
    assert not any(watch.add(0.7) for _ in range(5))
    assert [watch.add(1.2) for _ in range(5)] == [False, False, True, True, True]
    assert not [watch.add(0.75) for _ in range(5)][-1]
    assert [watch.add(0.3) for _ in range(5)][-1]


def test_a_finger_of_which_fewer_profiles_agree_is_worth_asking_about():
    rng = np.random.default_rng(4)
    watch = FingerWatch(2)
    assert not any(watch.add([0.8 + rng.normal(0.0, 0.04), 0.5 + rng.normal(0.0, 0.04)]) for _ in range(300))
    assert not any(watch.add([0.1, 0.5]) for _ in range(2))  # two frames decide nothing
    assert not any(watch.add([0.8, 0.5]) for _ in range(5))
    assert [watch.add([0.8, 0.3]) for _ in range(5)] == [False, False, True, True, True]


def test_edges_that_contradict_the_fit_otherwise_than_usually_are_worth_asking_about():
    rng = np.random.default_rng(5)
    bias_px = np.array([0.3, -0.2, 0.0, 0.1, np.nan])
    watch = ResidualWatch()

    def frame(shift_px: Any = 0.0) -> np.ndarray:
        return bias_px + shift_px + rng.normal(0.0, 0.02, 5)

    assert not any(watch.add(frame()) for _ in range(300))
    assert not any(watch.add(frame([0.3, 0.0, 0.0, 0.0, 0.0])) for _ in range(10))  # one edge: the background's
    assert not any(watch.add(frame()) for _ in range(5))
    asked = [watch.add(frame([0.2, 0.0, -0.2, 0.0, 0.0])) for _ in range(5)]
    assert not asked[0] and asked[-1]  # one frame decides nothing


def test_jaws_seen_elsewhere_than_usually_are_worth_asking_about():
    rng = np.random.default_rng(6)
    watch = JawWatch()

    def reported_m() -> float:
        return OPENING_M + rng.normal(0.0, 3e-5)

    assert not any(watch.add(reported_m(), OPENING_M + 2e-4) for _ in range(500))  # an offset that was always there
    assert not any(watch.add(OPENING_M - 1e-3, OPENING_M + 2e-4) for _ in range(2))  # two frames decide nothing
    assert not any(watch.add(None, OPENING_M) for _ in range(20))
    assert not any(watch.add(reported_m(), OPENING_M + 2e-4) for _ in range(5))
    assert [watch.add(reported_m() - 3e-4, OPENING_M + 2e-4) for _ in range(5)] == [False, False, True, True, True]


@pytest.mark.parametrize(
    ("scatter_m", "off_m", "asks"),
    [
        (1e-4, 2.8e-4, False),
        (1e-4, 3.2e-4, True),
        (0.0, 4.8e-5, False),
        (0.0, 5.2e-5, True),
    ],
)
def test_jaws_are_elsewhere_from_three_standard_deviations_and_fifty_micrometres_on(
    scatter_m: float, off_m: float, asks: bool
):
    watch = JawWatch()
    for index in range(20):
        watch.add(OPENING_M, OPENING_M + (scatter_m if index % 2 else -scatter_m))
    usual_m = OPENING_M  # the middle of two values as far above as below
    assert [watch.add(OPENING_M, usual_m + off_m) for _ in range(5)][-1] is asks


@pytest.mark.parametrize(
    ("usual_px", "now_px", "asks"), [(0.6, 0.84, False), (0.6, 0.86, True), (2.0, 2.55, False), (2.0, 2.65, True)]
)
def test_a_blur_is_another_from_a_quarter_of_a_pixel_and_three_tenths_on(usual_px: float, now_px: float, asks: bool):
    watch = BlurWatch()
    for _ in range(20):
        watch.add(usual_px)
    assert [watch.add(now_px) for _ in range(5)][-1] is asks


def test_what_is_usual_is_known_after_twenty_frames():
    watch = BlurWatch()
    assert not any(watch.add(blur_px) for blur_px in [0.7] * 15 + [2.0] * 4)
    assert watch.add(2.0)


@pytest.mark.parametrize(
    ("scatter_px", "off_px", "asks"),
    [(0.0, 0.048, False), (0.0, 0.052, True), (0.02, 0.078, False), (0.02, 0.082, True)],
)
def test_edges_contradict_from_a_twentieth_of_a_pixel_and_four_standard_deviations_on(
    scatter_px: float, off_px: float, asks: bool
):
    watch = ResidualWatch()
    for index in range(20):
        watch.add(np.full(3, scatter_px if index % 2 else -scatter_px))
    assert [watch.add(np.array([off_px, -off_px, 0.0])) for _ in range(5)][-1] is asks
