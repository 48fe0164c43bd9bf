"""How far knocks go: the sizes that are stated, by sampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from gripmon.track.integrity.knocks import ANY_SHARE, ANY_SIGMA_M, kinds_of, least_known, log_likely

AXIS_CAM = np.array([0.0, 0.6, 0.8])


def sampled_m(axis_cam: np.ndarray, count: int = 20_000) -> np.ndarray:
    """(count, 3) shifts by knocks."""
    rng, (share, covariance, *_) = np.random.default_rng(7), kinds_of(axis_cam)
    kind = rng.choice(len(share), count, p=share)
    return np.stack([rng.multivariate_normal(np.zeros(6), covariance[k])[:3] for k in kind])


def test_a_knock_is_of_millimetres():
    length_m = np.linalg.norm(sampled_m(AXIS_CAM), axis=1)
    assert np.median(length_m) == pytest.approx(3e-3, rel=0.15)
    assert 0.75 < np.mean((length_m > 1e-3) & (length_m < 10e-3)) < 0.9


def test_one_in_three_goes_along_the_fingers():
    shift_m = sampled_m(AXIS_CAM)
    across_m = np.linalg.norm(shift_m - np.outer(shift_m @ AXIS_CAM, AXIS_CAM), axis=1)
    assert np.mean(across_m < 1e-9) == pytest.approx(1.0 / 3.0, abs=0.02)


def test_the_direction_that_a_fit_knows_least_is_numpys_unless_it_points_elsewhere():
    rng = np.random.default_rng(4)
    for _ in range(50):
        root = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-6.0, -2.0, size=(6, 1))
        covariance, axis = root @ root.T, rng.normal(size=3)
        largest = np.linalg.eigh(covariance[:3, :3])[1][:, 2]
        found = least_known(covariance, axis, 0.0)
        np.testing.assert_allclose(np.outer(found, found), np.outer(largest, largest), atol=1e-12)
        cosine = abs(largest @ axis) / np.linalg.norm(axis)
        assert least_known(covariance, axis, 1.001 * cosine) is axis
        assert least_known(covariance, axis, 0.999 * cosine) is not axis
    assert not least_known(np.eye(6), np.zeros(3), 0.9).any(), "fingers without a direction"


def test_how_likely_a_shift_is_follows_the_density_of_what_is_sampled():
    shift_m = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 3e-3, 4e-3], [1.2e-2, 0.0, 5e-3]])
    kinds = zip(ANY_SHARE, ANY_SIGMA_M, strict=True)
    density = sum(share * multivariate_normal(np.zeros(3), sigma_m**2).pdf(shift_m) for share, sigma_m in kinds)
    np.testing.assert_allclose(log_likely(shift_m), np.log(density / density[0]), atol=1e-9)


def test_fingers_without_a_direction_have_none_along_them():
    share, _, along, _ = kinds_of(np.zeros(3))
    assert not along.any() and share.sum() == pytest.approx(1.0)


def test_the_spread_is_that_of_what_is_sampled():
    *_, spread = kinds_of(AXIS_CAM)
    covariance = np.cov(sampled_m(AXIS_CAM).T)
    np.testing.assert_allclose(covariance, spread[:3, :3], atol=0.08 * spread[:3, :3].max())


def test_two_knocks_in_three_turn_the_camera_by_a_degree_about_each_axis():
    variance = kinds_of(AXIS_CAM)[3][3:, 3:]
    np.testing.assert_allclose(variance, 2.0 / 3.0 * 0.02**2 * np.eye(3), atol=1e-12)
