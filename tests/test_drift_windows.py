"""Means of windows of many lengths against plain sums over the whole series."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.judge.drift.statistics import LENGTHS, Windows


def fed(series: np.ndarray) -> tuple[Windows, np.ndarray, np.ndarray]:
    """And the means and differences after the last frame."""
    windows = Windows(series.shape[1])
    for values in series:
        mean, difference = windows.add(values)
    return windows, mean, difference


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 127, 128, 8191, 8192, 8193, 20_000])
def test_means_are_those_of_the_last_frames_also_when_the_ring_has_gone_round(frames: int):
    series = np.random.default_rng(1).normal(3.0, 1.0, (frames, 2, 6))
    windows, mean, difference = fed(series)
    before = mean - difference
    full, full_before = windows.full()
    for k, length in enumerate(LENGTHS):
        assert full[k].tolist() == [frames >= length] * 2
        assert full_before[k].tolist() == [frames >= 2 * length] * 2
        if frames >= length:
            np.testing.assert_allclose(mean[k], series[-length:].mean(axis=0), rtol=0.0, atol=1e-9)
        if frames >= 2 * length:
            np.testing.assert_allclose(before[k], series[-2 * length : -length].mean(axis=0), rtol=0.0, atol=1e-9)
    for length in {1, frames // 3, min(frames, LENGTHS[-1])} - {0}:
        np.testing.assert_allclose(windows.mean_of_last(length), series[-length:].mean(axis=0), rtol=0.0, atol=1e-9)


def test_what_is_forgotten_is_in_no_window_and_streams_forget_by_themselves():
    series = np.random.default_rng(2).normal(size=(300, 3, 6))
    windows, _, _ = fed(series[:200])
    windows.keep(np.array([True, False, True]), np.array([0, 0, 10]))
    assert windows.frames.tolist() == [0, 200, 10]
    windows.keep(np.array([False, False, True]), 30)
    assert windows.frames.tolist() == [0, 200, 10], "what is forgotten doesn't come back"
    for values in series[200:]:
        mean, _ = windows.add(values)
    full, full_before = windows.full()
    lengths = np.array(LENGTHS)
    for stream, frames in enumerate((100, 300, 110)):
        np.testing.assert_array_equal(full[:, stream], lengths <= frames)
        np.testing.assert_array_equal(full_before[:, stream], 2 * lengths <= frames)
    np.testing.assert_allclose(mean[6], series[-64:].mean(axis=0), atol=1e-12)


def test_sums_stay_exact_over_days():
    """Frames of a day lose no digit that matters: a shift of half a millimetre, to a nanometre."""
    windows = Windows(1)
    windows._ring += 60.0 * 86_400.0 * 5e-4  # as after a day of frames 0.5 mm away
    series = 5e-4 + np.random.default_rng(3).normal(0.0, 1e-6, (9000, 1, 6))
    for values in series:
        mean, difference = windows.add(values)
    before = mean - difference
    for k, length in enumerate(LENGTHS):
        np.testing.assert_allclose(mean[k], series[-length:].mean(axis=0), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(before[k], series[-2 * length : 9000 - length].mean(axis=0), rtol=0.0, atol=1e-9)
