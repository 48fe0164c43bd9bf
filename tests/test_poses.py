"""The compiled pose arithmetic against the plain one, which has tests of its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gripmon.model import geometry, poses

ANGLES_RAD = [0.0, 1e-12, 1e-8, 1e-5, 0.1, 1.0, 3.0, np.pi - 1e-9]


def pose(rng: np.random.Generator) -> np.ndarray:
    return geometry.make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
@pytest.mark.parametrize("seed", range(5))
def test_perturbations_are_the_plain_ones(angle_rad: float, seed: int):
    rng = np.random.default_rng(seed)
    here, axis = pose(rng), rng.normal(size=3)
    xi = np.concatenate([rng.normal(size=3), angle_rad * axis / np.linalg.norm(axis)])
    there = geometry.perturb(here, xi)
    np.testing.assert_allclose(poses.perturb(here, xi), there, rtol=0.0, atol=1e-14)
    way = geometry.perturbation_between(here, there)
    found = poses.perturbation_between(here, there)
    np.testing.assert_allclose(found, way, rtol=0.0, atol=1e-13 if angle_rad < 3.1 else 1e-6)
    length_m, turned_rad = poses.motion_between(here, there)
    motion = there @ np.linalg.inv(here)
    assert length_m == pytest.approx(np.linalg.norm(motion[:3, 3]), abs=1e-13)
    assert turned_rad == pytest.approx(angle_rad, abs=1e-7 if angle_rad > 3.1 else 1e-13)


def test_quaternions_are_the_plain_ones_for_every_largest_component():
    rng = np.random.default_rng(1)
    for _ in range(200):
        here = pose(rng)
        np.testing.assert_allclose(poses.quaternion_of(here), geometry.quaternion_xyzw(here[:3, :3]), atol=1e-15)
