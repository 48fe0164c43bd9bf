"""SE(3) group laws over many transforms, near identity and near pi, against SciPy's Rotation and RigidTransform."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import RigidTransform, Rotation

from gripmon.model import geometry
from gripmon.model.records import Array

ANGLES_RAD = [0.0, 1e-300, 1e-17, 1e-12, 9e-9, 1.1e-8, 1e-6, 1e-3, 0.5, 2.0, 3.0]
NEAR_PI_RAD = [np.pi - gap for gap in (0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-4, 1e-2)]
EVERY_ANGLE = ANGLES_RAD + NEAR_PI_RAD


def axes() -> Array:
    """Coordinate axes, diagonals and random directions, both signs, (n, 3) of length 1."""
    rng = np.random.default_rng(7)
    principal = [v for v in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(v)]
    directions = np.vstack((principal, rng.normal(size=(20, 3)), [[1.0, 1e-9, 0.0], [1e-9, -1.0, 1e-12]]))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def rotation_vectors(angles_rad: list[float] = EVERY_ANGLE) -> Array:
    return np.vstack([axes() * angle for angle in angles_rad])


def random_transforms(count: int, seed: int) -> list[Array]:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, rng=rng)
    return list(RigidTransform.from_components(rng.normal(scale=0.3, size=(count, 3)), rotations).as_matrix())


def assert_is_rotation(rotation: Array) -> None:
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=5e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)


def angle_between(first: Array, second: Array) -> float:
    """Angle between two rotations, rad, exact also where it is tiny."""
    return float(Rotation.from_matrix(first.T @ second).magnitude())


def test_skew_is_the_cross_product_over_batches():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose((geometry.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)
    assert geometry.skew(np.empty((0, 3))).shape == (0, 3, 3)


def test_exponential_agrees_with_scipy_and_the_matrix_exponential():
    for omega in rotation_vectors():
        rotation = geometry.exp_rotation(omega)
        assert_is_rotation(rotation)
        np.testing.assert_allclose(rotation, Rotation.from_rotvec(omega).as_matrix(), atol=3e-15)
        np.testing.assert_allclose(rotation, expm(geometry.skew(omega)), atol=1e-14)


@pytest.mark.parametrize("angle", [1e-12, 9e-9, 1.1e-8, 1e-6])
def test_small_rotations_keep_their_first_order_exactly(angle: float):
    for omega in axes() * angle:
        rotation = geometry.exp_rotation(omega)
        antisymmetric = np.array(
            [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
        )
        np.testing.assert_allclose(antisymmetric / 2.0, omega * np.sinc(angle / np.pi), rtol=1e-9, atol=1e-19)


def test_logarithm_inverts_the_exponential_below_pi():
    for omega in rotation_vectors(ANGLES_RAD):
        np.testing.assert_allclose(geometry.log_rotation(geometry.exp_rotation(omega)), omega, atol=1e-15, rtol=1e-13)


def test_logarithm_near_pi_gives_the_same_rotation():
    for omega in rotation_vectors(NEAR_PI_RAD):
        rotation = geometry.exp_rotation(omega)
        logarithm = geometry.log_rotation(rotation)
        assert np.linalg.norm(logarithm) <= np.pi + 1e-14
        # at pi itself either sign of the axis is right
        assert angle_between(geometry.exp_rotation(logarithm), rotation) < 5e-15
        assert np.linalg.norm(logarithm) == pytest.approx(np.linalg.norm(omega), abs=1e-14)


def test_rotation_angle_over_the_whole_range():
    for angle in EVERY_ANGLE:
        for omega in axes() * angle:
            assert geometry.rotation_angle(geometry.exp_rotation(omega)) == pytest.approx(angle, abs=2e-15, rel=1e-9)


def test_quaternions_agree_with_scipy_with_w_not_negative():
    for omega in rotation_vectors():
        rotation = geometry.exp_rotation(omega)
        quaternion = np.array(geometry.quaternion_xyzw(rotation))
        assert quaternion[3] >= 0.0
        assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
        expected = Rotation.from_rotvec(omega).as_quat(canonical=False)
        assert abs(float(expected @ quaternion)) == pytest.approx(1.0, abs=1e-15)
        assert angle_between(geometry.rotation_from_xyzw(tuple(quaternion)), rotation) < 5e-15


def test_quaternion_order_is_x_y_z_w():
    quarter_turn_about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(geometry.quaternion_xyzw(quarter_turn_about_z), (0.0, 0.0, half, half), atol=1e-16)
    np.testing.assert_allclose(geometry.rotation_from_xyzw((0.0, 0.0, 3.0, 3.0)), quarter_turn_about_z, atol=1e-15)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)])
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion: tuple[float, float, float, float]):
    with pytest.raises(ValueError, match="not a rotation"):
        geometry.rotation_from_xyzw(quaternion)


def test_inverse_agrees_with_scipy_and_undoes():
    for a_T_b in random_transforms(100, seed=5):
        b_T_a = geometry.invert(a_T_b)
        np.testing.assert_allclose(b_T_a, RigidTransform.from_matrix(a_T_b).inv().as_matrix(), atol=2e-15)
        np.testing.assert_allclose(a_T_b @ b_T_a, np.eye(4), atol=2e-15)
        np.testing.assert_allclose(geometry.invert(b_T_a), a_T_b, atol=2e-15)


def test_perturbation_is_that_of_the_published_covariance():
    """t_true = t + rho, R_true = exp(omega) R, both in axes of frame a."""
    rng = np.random.default_rng(8)
    for a_T_b in random_transforms(50, seed=9):
        xi = rng.normal(scale=0.4, size=6)
        moved = geometry.perturb(a_T_b, xi)
        np.testing.assert_allclose(moved[:3, 3], a_T_b[:3, 3] + xi[:3], atol=1e-16)
        np.testing.assert_allclose(moved[:3, :3], Rotation.from_rotvec(xi[3:]).as_matrix() @ a_T_b[:3, :3], atol=3e-15)
        np.testing.assert_array_equal(moved[3], [0.0, 0.0, 0.0, 1.0])


def test_perturbation_between_undoes_perturb():
    rng = np.random.default_rng(10)
    directions = rng.normal(size=(len(EVERY_ANGLE), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for start in random_transforms(20, seed=11):
        for direction, angle in zip(directions, EVERY_ANGLE, strict=True):
            xi = np.concatenate((rng.normal(size=3), direction * angle))
            end = geometry.perturb(start, xi)
            between = geometry.perturbation_between(start, end)
            np.testing.assert_allclose(between[:3], xi[:3], atol=1e-15)
            if angle < 3.1:
                np.testing.assert_allclose(between[3:], xi[3:], atol=5e-15)
            again = geometry.perturb(start, between)
            assert angle_between(again[:3, :3], end[:3, :3]) < 1e-14


def test_rounding_does_not_pile_up():
    rng = np.random.default_rng(12)
    transform = random_transforms(1, seed=13)[0]
    for _ in range(20_000):
        transform = geometry.perturb(transform, rng.normal(scale=1e-3, size=6))
    assert_is_rotation(transform[:3, :3])


def test_records_hold_the_transform():
    for a_T_b in random_transforms(50, seed=15):
        record = geometry.to_record(a_T_b)
        np.testing.assert_allclose(geometry.from_record(record), a_T_b, atol=2e-15)
        expected = Rotation.from_matrix(a_T_b[:3, :3]).as_quat(canonical=True)
        np.testing.assert_allclose(record.rotation_xyzw, expected, atol=1e-15)
        assert all(type(v) is float for v in (*record.translation_m, *record.rotation_xyzw))
