"""The Plane Coincidence Constraint against points made by its own formulas, written down a second time."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, chi2
from support.plate_views import CORNERS_M, EXACT, LENS, NAMES, Trial, seen_by, solved, transform, trial

from gripmon.calibrate import plane
from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.plane import FingerCorners
from gripmon.calibrate.plane_equations import back_project, coincide_linear, stand
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import make_camera
from gripmon.model.geometry import perturbation_between

TRIALS = 100


def seeded(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def ideal(points_cam_m: np.ndarray) -> np.ndarray:
    return points_cam_m[:, :2] / points_cam_m[:, 2:]


def test_equation_8_refuses_lines_of_sight_along_and_away_from_the_plate():
    cam_T_plate = transform([np.pi / 3.0, 0.0, 0.0], [0.0, 0.0, 0.1])
    along = cam_T_plate[:3, 1]
    with pytest.raises(CalibrationError, match="runs along the plate"):
        back_project(cam_T_plate, ideal(along[None]), np.zeros(1))
    beyond = along + np.array([0.0, 0.2, 0.0])
    with pytest.raises(CalibrationError, match="beyond the plate's horizon"):
        back_project(cam_T_plate, ideal(beyond[None]), np.zeros(1))


def test_equation_7_holds_for_corners_that_are_too_far_apart_and_centres_coincide():
    q, shift = coincide_linear(CORNERS_M, 1.05 * CORNERS_M[:, :2] + [0.01, 0.02])
    assert np.hypot(*q) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(
        CORNERS_M[:, :2].mean(axis=0) + shift, 1.05 * CORNERS_M[:, :2].mean(axis=0) + [0.01, 0.02]
    )


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_without_noise_it_is_exact(known: bool, seed: int):
    made = trial(seeded(seed))
    found = solved(made, CORNERS_M if known else None)
    np.testing.assert_allclose(found.cam_T_grip, made.cam_T_grip, atol=1e-9)
    np.testing.assert_allclose(found.corners_m, CORNERS_M, atol=1e-9)
    assert np.abs(found.residuals_m).max() < 1e-9 and np.abs(found.residuals_px).max() < 1e-5
    if known:
        assert found.tilt_rad is not None and found.gap_m is not None
        assert np.abs(found.tilt_rad).max() < 1e-7 and abs(found.gap_m) < 1e-9


def test_corners_above_the_plate_and_a_tcp_behind_the_fingertips():
    """Corners count at their own heights, and what stands on the plate needn't be z = 0."""
    corners_m = CORNERS_M + np.array([0.0, 0.0, 0.012])
    corners_m[4:, 2] -= 0.006
    made = trial(seeded(4), corners_m=corners_m, contact_m=0.012)
    found = solved(made, corners_m, 0.012)
    np.testing.assert_allclose(found.cam_T_grip, made.cam_T_grip, atol=1e-9)
    with pytest.raises(CalibrationError, match="don't fit the gripper"):
        solved(made, corners_m, 0.0)


@lru_cache(maxsize=8)
def errors(known: bool, print_m: float, trials: int = TRIALS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (n, 6), their squares by the stated covariance (n,), and the residuals' probabilities (n,)."""
    out, sizes, p_values = [], [], []
    for seed in range(trials):
        made = trial(seeded(1000 + seed), noise_px=0.05, corner_px=0.05, print_m=print_m)
        found = solved(made, CORNERS_M if known else None)
        error = perturbation_between(found.cam_T_grip, made.cam_T_grip)
        out.append(error)
        sizes.append(error @ np.linalg.solve(found.covariance, error))
        p_values.append(found.p_value)
    return np.array(out), np.array(sizes), np.array(p_values)


@pytest.mark.parametrize(
    ("known", "print_m"),
    [
        pytest.param(True, 0.0, marks=pytest.mark.slow("9 s: sampled; with an uneven print it is in the default run")),
        (False, 5e-5),
    ],
)
def test_errors_have_the_spread_that_the_covariance_states(known: bool, print_m: float):
    _, sizes, p_values = errors(known, print_m)
    # Mean and coverage of a chi-square with six degrees of freedom; limits that chance passes once in ten thousand.
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * TRIALS) / TRIALS
    assert low < sizes.mean() < high
    inside = int(np.count_nonzero(sizes < chi2.ppf(0.95, 6)))
    assert binom.ppf(5e-5, TRIALS, 0.95) <= inside
    assert np.count_nonzero(p_values < 0.05) <= binom.ppf(1.0 - 5e-5, TRIALS, 0.05)
    assert np.count_nonzero(p_values < 0.5) == pytest.approx(0.5 * TRIALS, abs=4.0 * np.sqrt(0.25 * TRIALS))


@pytest.mark.parametrize("known", [True, False])
def test_a_perfect_plate_gives_the_tcp_to_hundredths_of_a_millimetre(known: bool):
    away, _, _ = errors(known, 0.0, 40)
    worst = np.quantile(np.abs(away[:, :3]), 0.95, axis=0)
    assert (worst < [2e-5, 2e-5, 5e-5]).all()


@pytest.mark.slow("16 s: sampled; the spread for a known camera is in the default run")
@pytest.mark.parametrize("known", [True, False])
def test_an_uncertain_camera_counts(known: bool):
    """Cameras drawn from the stated covariance, the image made by the true one."""
    parameters = ("fx_px", "cx_px", "cy_px", "kappa_per_px2")
    sigma = np.array([2.0, 1.5, 1.5, 4e-9])
    sizes, alone = [], []
    for seed in range(60):
        rng = seeded(2000 + seed)
        made = trial(rng, noise_px=0.05, corner_px=0.05)
        f, cx, cy, kappa = rng.normal(0.0, sigma)
        lens = type(LENS)(
            width_px=768, height_px=576, fx_px=962.0 + f, fy_px=962.0 + f, cx_px=383.5 + cx, cy_px=287.5 + cy,
            kappa_per_px2=1.9e-7 + kappa,
        )  # fmt: skip
        found = solved(made, CORNERS_M if known else None, camera=GivenCamera(lens, parameters, np.diag(sigma**2)))
        error = perturbation_between(found.cam_T_grip, made.cam_T_grip)
        sizes.append(error @ np.linalg.solve(found.covariance, error))
        alone.append(error @ np.linalg.solve(found.own[:6] @ found.own[:6].T, error))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * 60) / 60
    assert low < np.mean(sizes) < high
    assert np.mean(alone) > 3.0 * high, "the camera's part can't be left out"


def test_corners_that_err_together_count_as_such():
    """Noise that all corners share moves the gripper by all of it; taken apart it would average out."""
    made = trial(seeded(5), noise_px=0.01)
    shared = np.kron(np.ones((6, 6)), np.eye(2)) * 0.2**2 + np.eye(12) * 0.02**2
    together = solved(Trial(made.cam_T_grip, made.sighting, FingerCorners(NAMES, made.corners.uv_px, shared)))
    each = np.tile(np.eye(2) * (0.2**2 + 0.02**2), (6, 1, 1))
    apart = solved(Trial(made.cam_T_grip, made.sighting, FingerCorners.independent(NAMES, made.corners.uv_px, each)))
    ratio = np.sqrt(together.covariance[0, 0] / apart.covariance[0, 0])
    assert ratio == pytest.approx(np.sqrt(6.0), rel=0.15)


def test_wrong_points_of_the_plate_are_left_out():
    clean = trial(seeded(6), noise_px=0.05, corner_px=0.01)
    spoilt = trial(seeded(6), noise_px=0.05, corner_px=0.01, outliers=6)
    found = solved(spoilt)
    assert np.count_nonzero(~found.plate.used[0]) >= 6
    error = perturbation_between(found.cam_T_grip, spoilt.cam_T_grip)
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.9999, 6)
    assert np.abs(error[:3]).max() < 1e-4
    assert len(clean.sighting) == len(spoilt.sighting)


def test_no_wrong_pose_of_the_plate_wins_by_leaving_no_point_out():
    """A plane has two poses that look alike; at the wrong one all points are off, and none is an outlier."""
    for seed in range(60):
        made = trial(seeded(seed), noise_px=0.02, outliers=3)
        assert plate_pose(LENS, made.sighting)[2].rms_px < 0.05, seed


def test_a_plate_that_doesnt_fit_the_camera_is_refused():
    made = trial(seeded(12))
    squeezed = replace(made.sighting, plate_m=made.sighting.plate_m * [1.0, 0.6, 1.0])
    with pytest.raises(CalibrationError, match="the plate doesn't fit the camera: residuals of"):
        solved(replace(made, sighting=squeezed))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilt_of_a_tenth_of_a_degree_is_noticed(axis: int):
    tilt = np.zeros(2)
    tilt[axis] = np.radians(0.1)
    made = trial(seeded(7), tilt_rad=(tilt[0], tilt[1]), noise_px=0.01, corner_px=0.01)
    found = solved(made)
    assert found.tilt_rad is not None and found.apart_sigma is not None and found.apart_p is not None
    np.testing.assert_allclose(found.tilt_rad, tilt, atol=4.0 * found.apart_sigma[:2].max())
    assert found.apart_p < 1e-6


@pytest.mark.parametrize("gap_m", [1e-4, -1e-4])
def test_a_gap_of_a_tenth_of_a_millimetre_is_noticed(gap_m: float):
    found = solved(trial(seeded(8), gap_m=gap_m, noise_px=0.03, corner_px=0.03))
    assert found.gap_m is not None and found.apart_sigma is not None and found.apart_p is not None
    assert found.gap_m == pytest.approx(gap_m, abs=4.0 * found.apart_sigma[2])
    assert found.apart_p < 1e-6


def test_standing_on_the_plate_is_seldom_doubted():
    p_values = [solved(trial(seeded(3000 + s), noise_px=0.05, corner_px=0.05)).apart_p for s in range(60)]
    doubted = np.count_nonzero(np.array(p_values, dtype=float) < 0.05)
    assert doubted <= binom.ppf(1.0 - 1e-4, 60, 0.05)


def test_another_jaw_opening_enlarges_the_uncertainty():
    opened_m = CORNERS_M + np.sign(CORNERS_M[:, :1]) * np.array([0.0005, 0.0, 0.0])
    made = trial(seeded(9), corners_m=opened_m, noise_px=0.02, corner_px=0.02)
    found, true = solved(made, CORNERS_M), solved(made, opened_m)
    assert found.p_value < 1e-6 < 1e-3 < true.p_value
    assert found.enlarged > 5.0 and true.enlarged == 1.0
    assert found.covariance[0, 0] > 20.0 * true.covariance[0, 0]


MIRRORED = CORNERS_M * np.array([1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("corners_m", "known_m", "reason"),
    [
        (CORNERS_M[:1], CORNERS_M[:1], r"1 corner \(left_inner_near\) of the gripper; at least 2"),
        (CORNERS_M[:3], None, r"3 corner\(s\) of a gripper that isn't known; the 4 innermost"),
        (MIRRORED, CORNERS_M, "the corners are mirrored; an image that isn't flipped"),
        (MIRRORED, None, "the innermost corners are mirrored"),
        (CORNERS_M[[0, 3, 2, 1]], CORNERS_M[:4], "the corners don't fit the gripper: they lie"),
        (CORNERS_M[[0, 2, 1, 3]], None, "the innermost corners are mirrored"),
        (CORNERS_M[[0, 3, 2, 1]], None, "have each other's names"),
        (CORNERS_M[:4] * [1.0, 0.0, 1.0], None, "coincide"),
        (CORNERS_M[[0, 0]], CORNERS_M[:2], "coincide"),
        (CORNERS_M[:4] + np.eye(4)[:, 3:] * [0.012, 0.004, 0.0], None, "aren't a rectangle"),
    ],
)  # fmt: skip
def test_what_is_no_gripper_is_refused(corners_m: np.ndarray, known_m: np.ndarray | None, reason: str):
    with pytest.raises(CalibrationError, match=reason):
        solved(trial(seeded(10), corners_m=corners_m), known_m)


def test_a_corner_beyond_the_lens_is_refused():
    made = trial(seeded(11))
    lens = type(LENS)(
        width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=-1e-6
    )
    uv_px = made.corners.uv_px.copy()
    uv_px[0] = -400.0, -400.0
    with pytest.raises(CalibrationError, match="outside of what the lens maps"):
        stand(make_camera(lens), made.cam_T_grip, uv_px, made.corners.each_px2, CORNERS_M)


def test_the_projection_of_these_tests_is_the_papers():
    """Equation (4) forward: distorted to ideal."""
    points = np.array([[0.02, 0.01, 0.1], [-0.03, 0.02, 0.11]])
    distorted = seen_by(points) - [LENS.cx_px, LENS.cy_px]
    radius = np.sum(np.square(distorted), axis=1, keepdims=True)
    np.testing.assert_allclose(
        distorted * (1.0 + LENS.kappa_per_px2 * radius), LENS.fx_px * points[:, :2] / points[:, 2:], atol=1e-9
    )
    assert EXACT.covariance is None


@pytest.mark.parametrize(("rms_share", "fits"), [(0.0045, True), (0.0055, False)])
def test_a_plate_fits_the_camera_up_to_residuals_of_half_a_per_cent_of_the_width(
    rms_share: float, fits: bool, monkeypatch: pytest.MonkeyPatch
):
    bundle = SimpleNamespace(rms_px=rms_share * LENS.width_px, scale=1.0)
    monkeypatch.setattr(plane, "plate_pose", lambda *_: (np.eye(4), np.eye(6), bundle))
    with nullcontext() if fits else pytest.raises(CalibrationError, match="the plate doesn't fit the camera"):
        plane._plate(LENS, SimpleNamespace(disc_radius_m=0.002))
