"""What the drift test is said to notice against what it does notice."""

from __future__ import annotations

import numpy as np
import pytest
from support.drift_noise import COVARIANCE

from gripmon.judge.drift import CORRELATION_FRAMES, DriftSettings, SequentialTest, foresee
from gripmon.judge.drift.foresight import _variance_of_means

SETTINGS = DriftSettings()


def noise(rng: np.random.Generator, frames: int, streams: int) -> np.ndarray:
    """(n, s, 6) first-order autoregression of the assumed correlation time, with COVARIANCE."""
    phi = np.exp(-1.0 / CORRELATION_FRAMES)
    root = np.linalg.cholesky(COVARIANCE)
    out = np.empty((frames, streams, 6))
    value = rng.normal(size=(streams, 6))
    for k in range(frames):
        value = phi * value + np.sqrt(1.0 - phi**2) * rng.normal(size=(streams, 6))
        out[k] = value @ root.T
    return out


@pytest.mark.parametrize("length", [1, 2, 3, 17, 100])
def test_the_variance_of_means_is_the_double_sum(length: int):
    phi = np.exp(-1.0 / CORRELATION_FRAMES)
    lag = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    assert _variance_of_means(np.array([float(length)]))[0] == pytest.approx((phi**lag).mean(), rel=1e-9)


def test_larger_steps_are_noticed_sooner_and_tiny_ones_never():
    foresight = foresee(COVARIANCE, SETTINGS)
    smallest = float(foresight.smallest[0])
    delays = [foresight.delay_frames(factor * smallest, 0) for factor in (0.9, 1.0, 2.0, 5.0, 100.0)]
    assert delays[0] is None
    assert all(d is not None for d in delays[1:])
    assert delays[1:] == sorted(delays[1:], reverse=True)
    assert delays[-1] == 2, "one frame late, and no sooner: no single frame decides"


def test_fewer_false_alarms_and_larger_errors_cost_sensitivity():
    usual = foresee(COVARIANCE, SETTINGS).smallest
    assert (foresee(COVARIANCE, DriftSettings(false_alarms_per_day=0.01)).smallest > usual).all()
    tolerated = np.array([SETTINGS.tolerated_m] * 3 + [SETTINGS.tolerated_rad] * 3)
    np.testing.assert_allclose(foresee(4.0 * COVARIANCE, SETTINGS).smallest - tolerated, 2.0 * (usual - tolerated))


def test_the_test_does_what_is_foreseen():
    """Steps twice as large as foreseen for nine frames are noticed by then, ones of a seventh are not.

    The noise here has normal tails, so that the test becomes more sensitive than what is foreseen for heavy ones.
    """
    rng, streams = np.random.default_rng(11), 32
    test = SequentialTest(SETTINGS, streams)
    claimed = np.broadcast_to(COVARIANCE, (streams, 6, 6))
    for shift in noise(rng, 9000, streams):
        test.add(shift, claimed)
    foresight = foresee(COVARIANCE, SETTINGS)
    size = float(foresight.sizes[foresight.frames.index(9), 1])
    shares = []
    for factor in (2.0, 0.15):
        step = np.array([0.0, factor * size, 0.0, 0.0, 0.0, 0.0])
        test.restart(np.full(streams, True))
        for shift in noise(rng, 200, streams):
            test.add(shift, claimed)
        noticed = np.zeros(streams, dtype=bool)
        for shift in noise(rng, 9, streams):
            noticed |= test.add(shift + step, claimed).moved
        shares.append(noticed.mean())
    assert shares[0] > 0.7
    assert shares[1] < 0.3
