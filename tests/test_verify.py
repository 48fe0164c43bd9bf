"""Are two calibrations the same: differences against known ones, and probabilities that are what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest, ncx2

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.interchange import fit_brown_conrady
from gripmon.calibrate.lens_models import LensModel, parameter_names
from gripmon.calibrate.sighting import CalibrationError
from gripmon.calibrate.verify import agreeing, compare_cameras, compare_hand_eye, mean_of_one_scene
from gripmon.model.camera import FisheyeLens, PaperLens, make_camera
from gripmon.model.geometry import perturb

NOMINAL = np.eye(4)
NOMINAL[:3, :3] = Rotation.from_rotvec([0.5, 0.1, -0.2]).as_matrix()
NOMINAL[:3, 3] = 0.001, 0.002, 0.12


def covariance(rng: np.random.Generator, sigmas: np.ndarray) -> np.ndarray:
    """With correlations of every kind."""
    root = rng.normal(size=(len(sigmas), 2 * len(sigmas)))
    full = root @ root.T
    scale = sigmas / np.sqrt(full.diagonal())
    return full * np.outer(scale, scale)


SIGMAS = np.array([2e-5, 3e-5, 8e-5, 4e-4, 3e-4, 2e-4])
RNG = np.random.default_rng(8)
A, B = covariance(RNG, SIGMAS), covariance(RNG, 0.7 * SIGMAS)


def hand_eye_draws(rng: np.random.Generator, count: int, shift: np.ndarray) -> list:
    root_a, root_b = np.linalg.cholesky(A), np.linalg.cholesky(B)
    out = []
    for _ in range(count):
        a = perturb(NOMINAL, root_a @ rng.standard_normal(6))
        b = perturb(perturb(NOMINAL, shift), root_b @ rng.standard_normal(6))
        out.append(compare_hand_eye(a, A, b, B))
    return out


def test_equal_hand_eyes_have_evenly_spread_probabilities():
    found = hand_eye_draws(np.random.default_rng(1), 1500, np.zeros(6))
    for key in ("p_value", "position_p_value", "rotation_p_value"):
        assert kstest([getattr(d, key) for d in found], "uniform").pvalue > 1e-3, key
    z = np.array(
        [np.concatenate([d.position_m / d.position_sigma_m, d.rotation_rad / d.rotation_sigma_rad]) for d in found]
    )
    assert np.abs(z.std(axis=0) - 1.0).max() < 0.08


def test_a_moved_camera_is_found_as_often_as_theory_says():
    shift = np.array([0.0, 0.0, 2.2e-4, 9e-4, 0.0, 0.0])
    found = hand_eye_draws(np.random.default_rng(2), 800, shift)
    rate = np.mean([d.p_value < 0.01 for d in found])
    expected = ncx2.sf(chi2.isf(0.01, 6), 6, shift @ np.linalg.solve(A + B, shift))
    assert 0.2 < expected < 0.95
    assert abs(rate - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / len(found))


def test_the_difference_is_the_second_less_the_first_in_camera_axes():
    moved = NOMINAL.copy()
    moved[:3, 3] += [1e-3, -2e-3, 3e-3]
    moved[:3, :3] = Rotation.from_rotvec([0.0, 0.02, 0.0]).as_matrix() @ moved[:3, :3]
    found = compare_hand_eye(NOMINAL, A, moved, B)
    assert np.allclose(found.position_m, [1e-3, -2e-3, 3e-3], atol=1e-15)
    assert np.allclose(found.rotation_rad, [0.0, 0.02, 0.0], atol=1e-12)
    assert np.allclose(found.position_sigma_m, np.sqrt((A + B).diagonal()[:3]))
    xi = np.array([1e-3, -2e-3, 3e-3, 0.0, 0.02, 0.0])
    assert found.chi2 == pytest.approx(xi @ np.linalg.inv(A + B) @ xi, rel=1e-6)
    assert found.p_value < 1e-12


@pytest.mark.parametrize(
    ("a", "b", "said"),
    [
        (np.zeros((6, 6)), np.zeros((6, 6)), "uncertainties are zero"),
        (np.outer(SIGMAS, SIGMAS), np.outer(SIGMAS, SIGMAS), "a direction exactly known"),
        (np.triu(A), B, "first covariance isn't symmetric"),
        (A, B * np.nan, "second covariance isn't symmetric"),
    ],
)
def test_covariances_that_tell_nothing_are_refused(a: np.ndarray, b: np.ndarray, said: str):
    with pytest.raises(CalibrationError, match=said):
        compare_hand_eye(NOMINAL, a, NOMINAL, b)


def test_images_of_one_scene_average_without_growing_certain():
    rng = np.random.default_rng(3)
    poses = [perturb(NOMINAL, rng.normal(0.0, SIGMAS)) for _ in range(400)]
    mean, spread = mean_of_one_scene(poses, [A] * len(poses))
    away = compare_hand_eye(NOMINAL, A, mean, B)
    assert np.all(np.abs(np.concatenate([away.position_m, away.rotation_rad])) < 4.0 * SIGMAS / 20.0)
    assert np.allclose(spread, A)


def test_measurements_that_contradict_the_others_are_told_apart():
    """Ten that scatter as they say about one pose, and wrong ones that are each somewhere else."""
    rng = np.random.default_rng(8)
    true = [perturb(NOMINAL, np.linalg.cholesky(A) @ rng.standard_normal(6)) for _ in range(10)]
    wrong = [perturb(NOMINAL, 30.0 * k * SIGMAS * rng.choice([-1.0, 1.0], 6)) for k in range(1, 8)]
    order = rng.permutation(17)
    agree = agreeing([(true + wrong)[k] for k in order], [A] * 17)
    assert (agree == (order < 10)).all()
    assert agreeing([NOMINAL], [A]).tolist() == [True]
    # A wrong one that is as uncertain as it is wrong contradicts no one.
    assert agreeing([NOMINAL, NOMINAL, perturb(NOMINAL, 30.0 * SIGMAS)], [A, A, 900.0 * A]).all()


BROWN = LensModel("brown_conrady", 640, 480)
PARAMETERS = np.array([600.0, 602.0, 318.0, 241.0, -0.1, 0.05, 1e-3, -5e-4])
CAMERA_SIGMAS = np.array([0.3, 0.3, 0.4, 0.4, 2e-3, 8e-3, 2e-4, 2e-4])
CAMERA_COVARIANCE = covariance(RNG, CAMERA_SIGMAS)
NAMES = parameter_names("brown_conrady")


def camera_draw(rng: np.random.Generator, shift: np.ndarray | float = 0.0) -> GivenCamera:
    errors = np.linalg.cholesky(CAMERA_COVARIANCE) @ rng.standard_normal(8)
    return GivenCamera(BROWN.settings(PARAMETERS + shift + errors), NAMES, CAMERA_COVARIANCE)


def test_equal_cameras_have_evenly_spread_probabilities():
    rng = np.random.default_rng(4)
    found = [compare_cameras(camera_draw(rng), camera_draw(rng)) for _ in range(120)]
    assert kstest([d.p_value for d in found], "uniform").pvalue > 1e-3
    assert np.mean([d.largest_px / d.largest_sigma_px for d in found]) < 3.0


def test_a_camera_with_another_focal_length_is_found():
    rng = np.random.default_rng(5)
    shift = np.zeros(8)
    shift[:2] = 4.0
    found = [compare_cameras(camera_draw(rng), camera_draw(rng, shift)) for _ in range(15)]
    assert np.mean([d.p_value < 0.01 for d in found]) > 0.9


def test_the_largest_difference_is_where_the_projections_say():
    a = GivenCamera(BROWN.settings(PARAMETERS))
    b = GivenCamera(BROWN.settings(PARAMETERS * [1.01, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]))
    found = compare_cameras(a, b)
    # Only u is stretched, about the principal point: most at the image's left edge or its right.
    assert found.largest_px == pytest.approx(0.01 * (639.0 - 318.0), rel=1e-6)
    assert found.at_px[0] == 639.0 and found.p_value is None and found.largest_sigma_px is None
    assert found.compared == 1.0


def test_what_a_turn_of_the_camera_explains_is_told_apart():
    """A principal point that is 1 px off is a camera turned by 1 px over the focal length, all but the corners."""
    lens = PaperLens(width_px=640, height_px=480, fx_px=3000.0, fy_px=3000.0, cx_px=320.0, cy_px=240.0)
    shifted = PaperLens(width_px=640, height_px=480, fx_px=3000.0, fy_px=3000.0, cx_px=321.0, cy_px=240.0)
    found = compare_cameras(GivenCamera(lens), GivenCamera(shifted))
    assert found.largest_px == pytest.approx(1.0) and found.largest_turned_px < 0.02
    assert np.allclose(found.turn_rad, [0.0, 1.0 / 3000.0, 0.0], atol=3e-6)


def test_models_may_differ_where_the_images_do_not():
    paper = PaperLens(
        width_px=640, height_px=480, fx_px=700.0, fy_px=700.0, cx_px=321.0, cy_px=243.0, kappa_per_px2=2e-7
    )
    fitted = fit_brown_conrady(paper, (5,))
    alike = compare_cameras(
        GivenCamera(paper, ("fx_px", "kappa_per_px2"), np.diag([0.04, 1e-16])), GivenCamera(fitted.camera)
    )
    assert alike.largest_px <= 1.01 * fitted.largest_px < 0.01 and alike.p_value > 0.9


def test_what_was_held_fixed_counts_by_what_it_shows():
    """Focal length alone was estimated: a principal point that differs by 0.1 px is no chance."""
    covariances = np.diag([0.25])
    a = GivenCamera(BROWN.settings(PARAMETERS), ("fx_px",), covariances)
    b = GivenCamera(BROWN.settings(PARAMETERS + np.array([0, 0, 0.1, 0, 0, 0, 0, 0])), ("fx_px",), covariances)
    assert compare_cameras(a, b).p_value < 1e-3
    longer = PARAMETERS * np.array([1.001, 1.001, 1, 1, 1, 1, 1, 1])  # with the aspect held both focal lengths
    c = GivenCamera(BROWN.settings(longer), ("fx_px",), covariances)
    tied = compare_cameras(a, c)
    assert 0.2 < tied.p_value < 0.6 and tied.largest_sigma_px > 0.1


def test_cameras_that_cannot_be_compared_are_refused():
    small = PaperLens(width_px=320, height_px=240, fx_px=300.0, fy_px=300.0, cx_px=160.0, cy_px=120.0)
    with pytest.raises(CalibrationError, match="640 x 480 px and of 320 x 240 px; one camera in one size"):
        compare_cameras(GivenCamera(BROWN.settings(PARAMETERS)), GivenCamera(small))
    with pytest.raises(CalibrationError, match="kappa_per_px2 is not a parameter of this camera"):
        compare_cameras(
            GivenCamera(BROWN.settings(PARAMETERS), ("kappa_per_px2",), np.eye(1)),
            GivenCamera(BROWN.settings(PARAMETERS)),
        )
    with pytest.raises(CalibrationError, match="negative variances"):
        compare_cameras(
            GivenCamera(BROWN.settings(PARAMETERS), ("fx_px", "cx_px"), np.array([[1.0, 2.0], [2.0, 1.0]])),
            GivenCamera(BROWN.settings(PARAMETERS)),
        )


def test_a_fisheye_s_corners_may_see_too_far_to_compare():
    wide = FisheyeLens(width_px=640, height_px=480, fx_px=230.0, fy_px=230.0, cx_px=320.0, cy_px=240.0)
    assert not np.isfinite(make_camera(wide).undistort(np.array([[0.0, 0.0]]))).all()
    found = compare_cameras(GivenCamera(wide), GivenCamera(wide))
    assert found.largest_px < 1e-6 and 0.5 < found.compared < 1.0
