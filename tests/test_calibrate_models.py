"""Camera models with derivatives, and the fit of them: against differences, against OpenCV, against the truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from support.sightings import CAMERAS, poses, seen

from gripmon.calibrate.intrinsics import calibrate
from gripmon.calibrate.lens_models import MODELS, LensModel, ModelName, lens_vector, parameter_names
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import log_rotation


def model_of(name: str) -> LensModel:
    return LensModel(name, 768, 576)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_are_those_of_central_differences(name: ModelName):
    rng, model, parameters = np.random.default_rng(4), model_of(name), lens_vector(CAMERAS[name])
    points = np.concatenate([rng.uniform(-0.08, 0.08, (40, 2)), rng.uniform(0.2, 0.3, (40, 1))], axis=1)
    uv, by_parameters, by_point = model.project(parameters, points)
    np.testing.assert_allclose(uv, make_camera(CAMERAS[name]).project(points), atol=1e-9)
    for k, value in enumerate(parameters):
        step = 1e-5 * (abs(value) if name == "paper" else max(abs(value), 0.1))
        change = np.zeros(len(parameters))
        change[k] = step
        numeric = (model.project(parameters + change, points)[0] - model.project(parameters - change, points)[0]) / (
            2.0 * step
        )
        np.testing.assert_allclose(by_parameters[:, :, k], numeric, atol=2e-6 * np.abs(numeric).max(), err_msg=str(k))
    for k in range(3):
        change = 1e-7 * np.eye(3)[k]
        numeric = (model.project(parameters, points + change)[0] - model.project(parameters, points - change)[0]) / 2e-7
        np.testing.assert_allclose(by_point[:, :, k], numeric, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize(
    "name",
    [
        MODELS[0],
        *(
            pytest.param(n, marks=pytest.mark.slow("3 s each: sampled; the first model is in the default run"))
            for n in MODELS[-1:]
        ),
    ],
)
def test_the_stated_covariance_holds(name: ModelName):
    """Normalised squared errors follow the chi-square distribution that the covariance claims, gross errors and all."""
    rng, truth, squares, gross = np.random.default_rng(7), lens_vector(CAMERAS[name]), [], 0
    # A fisheye's highest terms show only where the plate fills the view.
    trials, distance_m = 16, 0.11 if name == "fisheye" else 0.2
    for _ in range(trials):
        views = seen(CAMERAS[name], poses(rng, 8, distance_m), rng, gross=0.02)
        result = calibrate(views, name)
        assert result.parameters == parameter_names(name)
        error = lens_vector(result.camera) - truth
        squares.append(float(error @ np.linalg.solve(result.covariance, error)))
        gross += sum(int((~u).sum()) for u in result.used)
        assert 0.09 < result.rms_px < 0.11
    low, high = chi2.ppf([0.001, 0.999], trials * len(truth)) / trials
    assert low < np.mean(squares) < high
    assert gross > 0.01 * trials * 8 * 40


@pytest.mark.parametrize("name", ["brown_conrady", "brown_conrady_5"])
def test_the_optimum_is_opencvs(name: ModelName):
    rng = np.random.default_rng(11)
    views = seen(CAMERAS[name], poses(rng, 8), rng)
    result = calibrate(views, name)
    assert all(u.all() for u in result.used)
    flags = cv2.CALIB_FIX_K3 if name == "brown_conrady" else 0
    rms, K, lens, _, _ = cv2.calibrateCamera(
        [v.plate_m.astype(np.float32) for v in views],
        [v.uv_px.astype(np.float32) for v in views],
        (768, 576), None, None, flags=flags,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12),
    )  # fmt: skip
    sigma = np.sqrt(result.covariance.diagonal())
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[: len(sigma) - 4]])
    # Theirs are 32 bit points; and at the minimum a difference of a twentieth of sigma costs nothing.
    assert np.abs((lens_vector(result.camera) - theirs) / sigma).max() < 0.05
    assert result.rms_px == pytest.approx(rms / np.sqrt(2.0), rel=1e-4)


def test_the_optimum_is_opencvs_for_a_fisheye():
    rng = np.random.default_rng(12)
    views = seen(CAMERAS["fisheye"], poses(rng, 8, 0.12), rng)
    result = calibrate(views, "fisheye")
    assert all(u.all() for u in result.used)
    K, lens = np.array([[400.0, 0.0, 383.0], [0.0, 400.0, 288.0], [0.0, 0.0, 1.0]]), np.zeros((4, 1))
    rms, K, lens, _, _ = cv2.fisheye.calibrate(
        [v.plate_m[None] for v in views], [v.uv_px[None] for v in views], (768, 576), K, lens,
        flags=cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12),
    )  # fmt: skip
    sigma = np.sqrt(result.covariance.diagonal())
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()])
    assert np.abs((lens_vector(result.camera) - theirs) / sigma).max() < 0.05
    assert result.rms_px == pytest.approx(rms / np.sqrt(2.0), rel=1e-3)


@pytest.mark.parametrize("name", ["paper", "fisheye"])
def test_a_plates_pose_has_an_honest_covariance(name: str):
    settings: LensSettings = CAMERAS[name]
    rng, squares = np.random.default_rng(3), []
    for T in poses(rng, 30):
        for view in seen(settings, [T], rng):
            pose, covariance, _ = plate_pose(settings, view)
            error = np.concatenate([T[:3, 3] - pose[:3, 3], log_rotation(T[:3, :3] @ pose[:3, :3].T)])
            squares.append(float(error @ np.linalg.solve(covariance, error)))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squares)) / len(squares)
    assert len(squares) > 20 and low < np.mean(squares) < high


def test_a_model_can_project_what_it_cannot_reach():
    """Behind the camera and beyond the lens there is no pixel, and no derivative: NaN, not a wrong number."""
    model = model_of("fisheye")
    points = np.array([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]])
    uv, by_parameters, by_point = model.project(lens_vector(CAMERAS["fisheye"]), points)
    assert np.isnan(uv[0]).all() and np.isnan(by_point[0]).all() and np.isfinite(uv[1]).all()
    assert np.isfinite(by_parameters[1]).all()
