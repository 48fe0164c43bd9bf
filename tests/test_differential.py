"""Equation (17) against the printed form and central differences; the update against exact motion and by sampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from support.simulated import nominal_cam_T_grip

from gripmon.track.differential import DegenerateGeometry, differential_update, equation_17

FOCAL_PX = 962.0
# The four innermost corners, then one of the outer two: the paper's order of what stays visible.
CORNERS_GRIP_M = np.array(
    [
        [-0.017, -0.008, 0.0],
        [0.017, -0.008, 0.0],
        [0.017, 0.008, 0.0],
        [-0.017, 0.008, 0.0],
        [0.027, -0.008, 0.0],
    ]
)


def corners_cam_m(count: int = 5) -> np.ndarray:
    cam_T_grip = nominal_cam_T_grip()
    return CORNERS_GRIP_M[:count] @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]


def tcp_cam_m() -> np.ndarray:
    return nominal_cam_T_grip()[:3, 3]


def moved(points_cam_m: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Points after the TCP has moved by ``rho`` and everything has turned about it by ``omega``; by SciPy."""
    turn = Rotation.from_rotvec(xi[3:]).as_matrix()
    return (points_cam_m - tcp_cam_m()) @ turn.T + tcp_cam_m() + xi[:3]


def image(points_cam_m: np.ndarray) -> np.ndarray:
    return points_cam_m[:, :2] / points_cam_m[:, 2:]


def sigma_xy(count: int, sigma_px: float) -> np.ndarray:
    return np.tile(np.eye(2) * (sigma_px / FOCAL_PX) ** 2, (count, 1, 1))


def paper_rows(point: np.ndarray, image_px: np.ndarray, f: float) -> tuple[list[list[float]], list[float]]:
    """Equation (17) as it is printed, one corner, image coordinates in px from the principal point."""
    x, y, z = point
    X, Y = image_px
    rows = [[X * y, -(X * x + f * z), f * y, -f, 0.0, X], [Y * y + f * z, -Y * x, -f * x, 0.0, -f, Y]]
    return rows, [f * x - X * z, f * y - Y * z]


def test_rows_are_those_of_the_print():
    rng = np.random.default_rng(1)
    points = corners_cam_m() + rng.normal(scale=0.003, size=(5, 3))
    measured_px = FOCAL_PX * image(points) + rng.normal(scale=5.0, size=(5, 2))
    rows, sides = equation_17(points, measured_px / FOCAL_PX)
    for i in range(5):
        expected_rows, expected_sides = paper_rows(points[i], measured_px[i], FOCAL_PX)
        np.testing.assert_allclose(FOCAL_PX * rows[i], expected_rows, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(FOCAL_PX * sides[i], expected_sides, rtol=1e-9, atol=1e-12)


def test_rows_are_the_derivative_of_the_collinearity_of_ray_and_moved_corner():
    """``X z' - x'`` and ``Y z' - y'`` under an exact motion (exponential of the twist): central differences."""
    rng = np.random.default_rng(2)
    points, step = corners_cam_m(), 1e-6
    measured = image(points) + rng.normal(scale=0.01, size=(5, 2))

    def misfit(delta_and_d: np.ndarray) -> np.ndarray:
        twist = np.zeros((4, 4))
        (a, b, c), twist[:3, 3] = delta_and_d[:3], delta_and_d[3:]
        twist[:3, :3] = [[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]
        motion = expm(twist)
        after = points @ motion[:3, :3].T + motion[:3, 3]
        return measured * after[:, 2:] - after[:, :2]

    rows, sides = equation_17(points, measured)
    numeric = np.stack([(misfit(step * e) - misfit(-step * e)) / (2.0 * step) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(rows, numeric, atol=1e-9)
    np.testing.assert_allclose(sides, -misfit(np.zeros(6)), atol=1e-15)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_recovers_a_large_motion_exactly_once_linearised_often_enough(count: int):
    rng = np.random.default_rng(3)
    for _ in range(20):
        xi = np.concatenate([rng.uniform(-0.005, 0.005, 3), rng.uniform(-0.05, 0.05, 3)])
        points = corners_cam_m(count)
        update = differential_update(points, image(moved(points, xi)), sigma_xy(count, 0.1), tcp_cam_m(), iterations=9)
        np.testing.assert_allclose(update.xi, xi, atol=1e-12)


@pytest.mark.parametrize(("iterations", "order"), [(1, 2), (2, 4)])
def test_each_linearisation_doubles_the_order_of_the_error(iterations: int, order: int):
    """One linearisation leaves an error with the square of the motion, a second one with its fourth power."""
    points = corners_cam_m()
    xi = np.array([0.004, -0.003, 0.005, 0.04, -0.05, 0.06])
    errors = []
    for size in (1.0, 0.5):
        measured = image(moved(points, size * xi))
        update = differential_update(points, measured, sigma_xy(5, 0.1), tcp_cam_m(), iterations)
        errors.append(float(np.linalg.norm(update.xi[3:] - size * xi[3:])))
    assert errors[1] > 1e-12, "the error is above rounding"
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.45)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_covariance_is_the_spread_of_the_errors(count: int):
    """Sampling: errors over many noisy images have the claimed covariance, axis by axis and as a whole (NEES)."""
    rng = np.random.default_rng(5)
    points, samples = corners_cam_m(count), 2500
    xi = np.array([2e-4, -1e-4, 3e-4, 2e-3, -1e-3, 2e-3])
    exact = image(moved(points, xi))
    # Every corner with another covariance, some of them long and oblique.
    axes = rng.normal(size=(count, 2, 2)) * (0.02 / FOCAL_PX)
    covariance_xy = axes @ axes.transpose(0, 2, 1) + np.eye(2) * (0.005 / FOCAL_PX) ** 2
    factor = np.linalg.cholesky(covariance_xy)
    errors = np.empty((samples, 6))
    nees = np.empty(samples)
    for k in range(samples):
        noise = np.einsum("nij,nj->ni", factor, rng.normal(size=(count, 2)))
        update = differential_update(points, exact + noise, covariance_xy, tcp_cam_m())
        errors[k] = update.xi - xi
        nees[k] = errors[k] @ np.linalg.solve(update.covariance, errors[k])
    claimed = np.sqrt(np.diag(update.covariance))
    # A sampled standard deviation scatters by 1 / sqrt(2 n), the mean of chi-square with six degrees by sqrt(12 / n).
    np.testing.assert_allclose(errors.std(axis=0) / claimed, 1.0, atol=4.5 / np.sqrt(2.0 * samples))
    np.testing.assert_allclose(errors.mean(axis=0) / claimed, 0.0, atol=4.5 / np.sqrt(samples))
    assert nees.mean() == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / samples))


LINE = np.array([-0.02, 0.001, 0.11]) + np.linspace(0.0, 1.0, 5)[:, None] * np.array([0.03, 0.02, -0.01])
CLOSE = corners_cam_m()


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        CLOSE[:2],
        CLOSE[[0, 0, 0]],
        CLOSE[[0, 1, 0, 1]],
        LINE[:3],
        LINE,
        LINE * [0.0, 0.0, 1.0] + [0.0, 0.01, 0.0],
        LINE * [1.0, 0.0, 0.0] + [0.0, 0.0, 0.1],
        LINE + np.random.default_rng(6).normal(scale=2e-5, size=(5, 3)),
    ],
    ids=["none", "two", "one thrice", "two twice", "line of 3", "line of 5", "line along z", "line along x", "nearly"],
)
def test_corners_that_do_not_determine_the_motion_are_refused(points: np.ndarray):
    with pytest.raises(DegenerateGeometry):
        differential_update(points, image(points), sigma_xy(len(points), 0.1), tcp_cam_m())
