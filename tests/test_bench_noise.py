"""The noise of ``tools/bench drift``: statistics against series whose answers are known, streams against their model
and against what was measured on simulated images.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

REGIMES = ("quiet", "working", "rough")

pytestmark = pytest.mark.usefixtures("tools_importable")


def own_statistics(model, scenes: int = 200):
    """Of the model's streams, each of one scene only, as the measured series are."""
    import msgspec
    from benchmarks.noise_statistics import statistics

    single = msgspec.structs.replace(model, scene_frames=1e12)
    noise = single.streams(scenes, np.random.default_rng(5)).next(model.provenance["frames_per_scene"])
    z = np.linalg.solve(noise.factor, noise.error[..., None])[..., 0]
    return statistics(np.swapaxes(z, 0, 1))


@pytest.mark.slow("5 s: the noise of a benchmark, no part of what is installed")
@pytest.mark.parametrize("regime", REGIMES)
def test_streams_are_nowhere_milder_than_what_was_measured(regime: str):
    """All axes together: few scenes were measured, so that a single axis scatters."""
    from benchmarks.noise_model import NoiseModel
    from benchmarks.noise_statistics import Statistics

    model = NoiseModel.load(regime)
    measured, own = Statistics.from_dict(model.measured), own_statistics(model)
    for name, mildest, wildest in (
        ("structure", 0.94, 1.3),
        ("mean_variance", 0.94, 1.3),
        ("step_variance", 0.94, 1.5),
    ):
        ratio = np.mean(getattr(own, name) / getattr(measured, name), axis=1)
        assert (ratio > mildest).all() and (ratio < wildest).all(), (name, ratio)
    tails = own.tails / measured.tails
    # Sizes that one step in ten, a hundred, a thousand exceeds, in units of their root mean square: with heavier tails
    # the first is smaller.  Of the longer windows a thousandth is a handful.
    assert (tails[:6] > 0.85).all() and (tails < 1.5).all(), tails
    assert (tails[:7, 1:].mean(axis=0) > 0.97).all() and (tails[:, 1:].mean(axis=0) > 0.93).all(), tails


def test_statistics_of_autoregressions_and_levels_are_what_their_equations_say():
    from benchmarks.noise_statistics import LAGS, statistics

    rng = np.random.default_rng(1)
    factor, level_sd = 0.9, 2.0
    noise = lfilter([np.sqrt(1.0 - factor**2)], [1.0, -factor], rng.normal(size=(400, 1700, 6)), axis=1)[:, 100:]
    found = statistics(noise + level_sd * rng.normal(size=(400, 1, 6)))
    lags = LAGS[: len(found.structure)]
    np.testing.assert_allclose(found.structure.mean(axis=1), 1.0 - factor**lags, rtol=0.02)
    for k, n in enumerate(found.windows):
        # The covariance of all pairs of a window, summed one by one.
        apart = np.abs(np.subtract.outer(np.arange(2 * n), np.arange(2 * n)))
        pairs = factor**apart
        mean = pairs[:n, :n].mean()
        assert found.mean_variance[k].mean() == pytest.approx(mean + level_sd**2, rel=0.05)
        if k < len(found.step_variance):
            assert found.step_variance[k].mean() == pytest.approx(mean - pairs[:n, n:].mean(), rel=0.05)
            assert found.kurtosis[k] == pytest.approx(3.0, abs=0.3)
    np.testing.assert_allclose(found.tails[0], [1.645, 2.576, 3.291], rtol=0.02)


def test_frames_without_an_error_are_left_out():
    from benchmarks.noise_statistics import statistics

    z = np.random.default_rng(2).normal(size=(20, 600, 6))
    z[3, 100:180] = np.nan
    found = statistics(z)
    np.testing.assert_allclose(found.mean_variance[0], np.nanmean(z**2, axis=(0, 1)), rtol=1e-12)
    assert np.isfinite(found.step_variance).all() and np.isfinite(found.tails).all()


@pytest.mark.slow("5 s: the noise of a benchmark, no part of what is installed")
def test_the_fit_gives_back_the_model_that_made_the_series():
    """Two parts and a level with known variances, as measured series of it."""
    from benchmarks import noise_fit
    from benchmarks.noise_measured import Series

    rng = np.random.default_rng(3)
    slow = lfilter([np.sqrt(1.0 - 0.98**2)], [1.0, -0.98], rng.normal(size=(64, 2000, 6)), axis=1)[:, 500:]
    z = 0.6 * rng.normal(size=slow.shape) + 0.5 * slow + 0.8 * rng.normal(size=(64, 1, 6))
    factor = np.tril(rng.normal(size=(6, 6))) + 4.0 * np.eye(6)
    covariance = np.broadcast_to(factor @ factor.T, (*z.shape, 6))
    series = Series(z @ factor.T, np.zeros_like(z), covariance, np.ones(z.shape[:2]))
    model = noise_fit.fit("working", series, 200.0, {"frames_per_scene": 1500}, tail_scenes=8)
    np.testing.assert_allclose(model.scenes[0].factor, factor[np.tril_indices(6)], rtol=1e-3)
    assert model.burst_log_sd < 0.1
    assert np.mean(model.level_variance) == pytest.approx(0.64, rel=0.2)
    fast = sum(np.array(part.variance) for part in model.parts if part.frames <= 3.0)
    late = sum(np.array(part.variance) for part in model.parts if part.frames > 10.0)
    assert np.mean(fast) == pytest.approx(0.36, rel=0.05)
    assert np.mean(late) == pytest.approx(0.25, rel=0.15)


def test_streams_go_on_where_they_ended_and_repeat_for_the_same_seed():
    from benchmarks.noise_model import NoiseModel

    model = NoiseModel.load("rough")
    whole = model.streams(3, np.random.default_rng(7)).next(50)
    again = model.streams(3, np.random.default_rng(7)).next(50)
    np.testing.assert_array_equal(whole.shift, again.shift)
    assert whole.error.shape == (50, 3, 6) and whole.covariance.shape == (50, 3, 6, 6)
    np.testing.assert_allclose(whole.sigma**2, np.einsum("...ii->...i", whole.covariance), rtol=1e-12)
    streams = model.streams(40, np.random.default_rng(8))
    first, second = streams.next(200), streams.next(200)
    # The seam is a step like any other: of the slow parts, and of the vibration.
    for name in ("error", "motion"):
        values = np.concatenate([getattr(first, name), getattr(second, name)])
        steps = np.square(np.diff(values, axis=0)).mean(axis=1)
        assert (steps[199] < 2.0 * steps.mean(axis=0)).all(), name


def test_vibration_has_the_drawn_frequencies_and_amplitudes():
    """The spectrum of the simulated TCP has its two highest lines inside the band."""
    from benchmarks.noise_model import NoiseModel

    model = NoiseModel.load("rough")
    noise = model.streams(200, np.random.default_rng(9)).next(1024)
    assert noise.motion is not None
    spectrum = np.abs(np.fft.rfft(noise.motion[..., 0] * np.hanning(1024)[:, None], axis=0)) ** 2
    frequency_hz = np.fft.rfftfreq(1024, 1.0 / model.frames_per_s)
    low, high = model.vibration.frequency_hz
    inside = (frequency_hz > low - 0.3) & (frequency_hz < high + 0.3)
    assert spectrum[inside].sum() > 0.999 * spectrum.sum()
    # Mean square of a sine is half its amplitude's square; evenly over the logarithm and over directions.
    small, large = model.vibration.amplitude_m
    square = 0.5 * 0.5 * model.vibration.count * (large**2 - small**2) / (2.0 * np.log(large / small))
    assert np.mean(noise.motion[..., 0] ** 2) == pytest.approx(square, rel=0.2)
    assert (NoiseModel.load("quiet").streams(2, np.random.default_rng(1)).next(3).motion) is None
