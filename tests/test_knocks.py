"""How far knocks go: the sizes that are stated, by sampling."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.track.integrity import Knocks

AXIS_CAM = np.array([0.0, 0.6, 0.8])


def sampled_m(knocks: Knocks, count: int = 20_000) -> np.ndarray:
    """(count, 3) shifts by knocks."""
    rng = np.random.default_rng(7)
    kind = rng.choice(len(knocks.share), count, p=knocks.share)
    return np.stack([rng.multivariate_normal(np.zeros(6), knocks.covariance[k])[:3] for k in kind])


def test_a_knock_is_of_millimetres():
    length_m = np.linalg.norm(sampled_m(Knocks.of(AXIS_CAM)), axis=1)
    assert np.median(length_m) == pytest.approx(3e-3, rel=0.15)
    assert 0.75 < np.mean((length_m > 1e-3) & (length_m < 10e-3)) < 0.9


def test_one_in_three_goes_along_the_fingers():
    shift_m = sampled_m(Knocks.of(AXIS_CAM))
    across_m = np.linalg.norm(shift_m - np.outer(shift_m @ AXIS_CAM, AXIS_CAM), axis=1)
    assert np.mean(across_m < 1e-9) == pytest.approx(1.0 / 3.0, abs=0.02)


def test_fingers_without_a_direction_have_none_along_them():
    knocks = Knocks.of(np.zeros(3))
    assert not knocks.along.any() and knocks.share.sum() == pytest.approx(1.0)


def test_the_spread_is_that_of_what_is_sampled():
    knocks = Knocks.of(AXIS_CAM)
    covariance = np.cov(sampled_m(knocks).T)
    np.testing.assert_allclose(covariance, knocks.spread[:3, :3], atol=0.08 * knocks.spread[:3, :3].max())
