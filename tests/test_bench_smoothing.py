"""``tools/bench smoothing`` in small: what it measures against what the streams themselves say, and its tables."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.slow("10 s: smoothing of known errors is in test_smoothing")
@pytest.mark.parametrize("regime", ["quiet", "working", "rough"])
def test_smoothing_keeps_its_word_in_every_regime(regime: str, monkeypatch: pytest.MonkeyPatch):
    """Better than the frames in quiet time, as honest as they are, and no worse from the second frame after a step."""
    from benchmarks import smoothing
    from benchmarks.noise_model import NoiseModel

    monkeypatch.setattr(smoothing, "_LEARNING_FRAMES", 1800)
    monkeypatch.setattr(smoothing, "_STEPS_MM", (0.1,))
    monkeypatch.setattr(smoothing, "_BUMPS_MM", (4.5,))
    monkeypatch.setattr(smoothing, "_CREEPS_MM_PER_MIN", (0.1,))
    done = []
    quiet, events = smoothing.measure(regime, 10, 3, lambda: done.append(1))
    assert len(done) == 10 * (1 + len(events)) and len(events) == 4
    # The raw errors are the streams' own, without the mount's motion.
    noise = NoiseModel.load(regime).streams(10, np.random.default_rng(3)).next(1980)
    np.testing.assert_allclose(quiet.raw, 1e6 * np.sqrt((noise.error[900:1800] ** 2).mean(axis=(0, 1))), rtol=1e-9)
    assert np.mean(np.array(quiet.smoothed) / quiet.raw) < 1.0
    assert quiet.smoothed_nees < 1.3 * quiet.raw_nees
    nothing = events[0]
    for event in events:
        # Few frames of few streams scatter, most where the mount vibrates: held against the same frames without event.
        assert (np.array(event.ratio[1:]) < 1.25 * np.maximum(nothing.ratio[1:], 1.0)).all(), (event, nothing)
        assert max(event.nees[1:]) < 15.0, event
    text = smoothing.markdown([quiet], events)
    assert f"| {regime}: step of 0.1 mm |" in text and "NaN" not in text and "nan" not in text
