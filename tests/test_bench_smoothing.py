"""``tools/bench smoothing`` in small: what it measures against what the streams themselves say, and its tables."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


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


def test_the_ways_are_those_of_the_simulator():
    """The perturbation of a small shift of the TCP along camera y by a turn about the bracket, against a rotation."""
    from benchmarks import smoothing
    from benchmarks.scene import config_for

    from gripmon.model.geometry import from_record
    from gripmon.simulate.scenario import Scenario

    ways = smoothing._ways()
    step = ways["step of 0.05 mm"][0]
    tcp_m = from_record(config_for((768, 576)).reference.cam_T_grip)[:3, 3]
    lever_m = tcp_m - np.array(Scenario().pivot_cam_m)
    np.testing.assert_allclose(step[:3], np.cross(step[3:], lever_m), atol=2e-9)
    assert step[1] == pytest.approx(5e-5, rel=1e-3)
    ring = ways["knock of 4.5 mm, rings down"][:, 1]
    assert ring[0] == pytest.approx(0.7 * 4.5e-3, rel=1e-3) and ring[-1] == pytest.approx(4.5e-3, rel=1e-3)
    creep = ways["creep of 1 mm/min"]
    assert creep[60, 1] == pytest.approx(1e-3 / 60.0, rel=1e-3)
