"""Several images of a gripper on a plate: the mean, what it shares, and what is said of it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import chi2, kstest
from support.plate_views import CORNERS_M, LENS, NAMES, Trial, solved, transform, trial

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.plane import Coincidence, FingerCorners
from gripmon.calibrate.plane_average import PlaneCalibration, against, average
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.geometry import perturb, perturbation_between

TRUE = transform([np.radians(32.0), 0.0, 0.0], [0.0004, 0.0013, 0.115])
TRIALS = 40


def views(seed: int, known: bool, count: int = 3, noise_px: float = 0.05, **settings: object) -> list[Coincidence]:
    rng = np.random.default_rng(seed)
    made = [
        trial(rng, noise_px=noise_px, corner_px=noise_px, cam_T_grip=TRUE, name=f"{k}.png", **settings)  # type: ignore[arg-type]
        for k in range(count)
    ]
    return [solved(one, CORNERS_M if known else None) for one in made]


@lru_cache(maxsize=2)
def means(known: bool) -> tuple[PlaneCalibration, ...]:
    return tuple(average(views(seed, known), not known) for seed in range(TRIALS))


@pytest.mark.parametrize(
    "known",
    [pytest.param(True, marks=pytest.mark.slow("5 s: sampled; inferred corners are in the default run")), False],
)
def test_the_mean_has_the_stated_spread_and_images_agree_as_often_as_said(known: bool):
    sizes = []
    for mean in means(known):
        error = perturbation_between(mean.cam_T_grip, TRUE)
        sizes.append(error @ np.linalg.solve(mean.covariance, error))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * TRIALS) / TRIALS
    assert low < np.mean(sizes) < high
    assert kstest([m.consistency_p for m in means(known)], "uniform").pvalue > 1e-4


def test_inferred_lengths_have_the_stated_spread():
    sizes = []
    for mean in means(False):
        error = np.concatenate(
            [2.0 * mean.corners_m[3, :2] - [0.034, 0.016], (mean.corners_m - CORNERS_M)[4:, :2].ravel()]
        )
        sizes.append(error @ np.linalg.solve(mean.lengths_covariance, error))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * TRIALS) / TRIALS
    assert low < np.mean(sizes) < high


def test_one_image_is_its_own_mean():
    (one,) = views(1, True, count=1)
    mean = average([one], inferred=False)
    np.testing.assert_allclose(mean.cam_T_grip, one.cam_T_grip, atol=1e-15)
    np.testing.assert_allclose(mean.covariance, one.covariance, rtol=1e-6, atol=1e-20)
    assert mean.consistency_p is None and mean.warnings == ()
    assert "+- of noise, camera and print; without bevelled edges, and dark ones before dark print" in mean.summary()


def test_more_images_are_more_exact_but_not_more_than_their_camera():
    parameters, covariance = ("fx_px",), np.array([[4.0]])
    camera = GivenCamera(LENS, parameters, covariance)
    rng = np.random.default_rng(2)
    made = [trial(rng, noise_px=0.05, corner_px=0.05, cam_T_grip=TRUE) for _ in range(8)]
    exact = [average([solved(m) for m in made[:n]], False).covariance for n in (1, 8)]
    unsure = [average([solved(m, camera=camera) for m in made[:n]], False).covariance for n in (1, 8)]
    gain = np.sqrt(exact[0].diagonal() / exact[1].diagonal())
    np.testing.assert_allclose(gain, np.sqrt(8.0), rtol=0.5)
    # The distance is the focal length's: 115 mm times 2 / 962.
    for covariance in unsure:
        assert np.sqrt(covariance[2, 2]) == pytest.approx(0.115 * 2.0 / 962.0, rel=0.1)


def test_errors_of_the_print_dont_average_out():
    """The same plate in the same place: three images know no more of it than one."""
    rng = np.random.default_rng(3)
    print_errors_m = rng.normal(0.0, 5e-5, (64, 2))
    one = [
        trial(np.random.default_rng(9), noise_px=0.02, corner_px=0.02, print_errors_m=print_errors_m) for _ in range(3)
    ]
    sigma = [np.sqrt(average([solved(m) for m in one[:n]], False).covariance[2, 2]) for n in (1, 3)]
    assert sigma[1] > 0.95 * sigma[0]


@pytest.mark.slow("9 s: sampled; the mean's spread is in the default run")
def test_one_print_in_images_from_different_places_isnt_taken_for_new_ones():
    """Whichever way its errors come into each image, the mean's stated spread holds them."""
    sizes, one = [], []
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        errors_m = rng.normal(0.0, 5e-5, (64, 2))
        made = [trial(rng, noise_px=0.02, corner_px=0.02, print_errors_m=errors_m, cam_T_grip=TRUE) for _ in range(4)]
        looks = [solved(m) for m in made]
        for found, into in ((average(looks, False), sizes), (average(looks[:1], False), one)):
            error = perturbation_between(found.cam_T_grip, TRUE)
            into.append(error @ np.linalg.solve(found.covariance, error))
    for found in (sizes, one):
        assert np.mean(found) < chi2.ppf(1.0 - 5e-5, 6 * TRIALS) / TRIALS


def test_images_that_contradict_each_other_are_said_and_count_less():
    images = views(4, True)
    odd = trial(np.random.default_rng(5), noise_px=0.05, corner_px=0.05, name="odd.png",
                cam_T_grip=perturb(TRUE, np.array([0.0, 3e-4, 0.0, 0.0, 0.0, 0.0])))  # fmt: skip
    good, bad = average(images, False), average([*images, solved(odd)], False)
    assert good.warnings == () and good.consistency_p is not None and good.consistency_p > 1e-3
    assert bad.consistency_p is not None and bad.consistency_p < 1e-3
    (warning,) = bad.warnings
    assert warning.startswith("the images contradict each other") and "odd.png" in warning
    assert bad.covariance[1, 1] > 10.0 * good.covariance[1, 1]
    # The mean lies a quarter of the way to the odd one, and the stated uncertainty has room for that.
    away = perturbation_between(bad.cam_T_grip, TRUE)
    assert away @ np.linalg.solve(bad.covariance, away) < chi2.ppf(0.999, 6)


def test_weights_follow_the_uncertainties():
    sharp, blurred = views(6, True, count=1, noise_px=0.02)[0], views(7, True, count=1, noise_px=0.4)[0]
    mean = average([sharp, blurred], False)
    to_sharp = np.linalg.norm(perturbation_between(sharp.cam_T_grip, mean.cam_T_grip)[:3])
    to_blurred = np.linalg.norm(perturbation_between(blurred.cam_T_grip, mean.cam_T_grip)[:3])
    assert to_sharp < 0.05 * to_blurred


def test_inferred_grippers_show_the_same_corners_in_all_images():
    rng = np.random.default_rng(8)
    six, four = trial(rng, cam_T_grip=TRUE), trial(rng, cam_T_grip=TRUE, corners_m=CORNERS_M[:4])
    with pytest.raises(CalibrationError, match="the images show different corners"):
        average([solved(six, None), solved(four, None)], True)


def test_two_known_corners_suffice_and_are_said():
    made = trial(np.random.default_rng(9), noise_px=0.02, corner_px=0.02, cam_T_grip=TRUE)
    two = FingerCorners(NAMES[::3][:2], made.corners.uv_px[::3][:2], np.eye(4) * 0.02**2)
    found = solved(Trial(TRUE, made.sighting, two), CORNERS_M[::3][:2])
    mean = average([found], False)
    error = perturbation_between(mean.cam_T_grip, TRUE)
    assert error @ np.linalg.solve(mean.covariance, error) < chi2.ppf(0.9999, 6)
    assert mean.warnings == (
        "view.png: two corners only (left_inner_near, right_inner_far): nothing but their distance checks them",
    )


def test_tilt_gap_and_misfit_are_warned_of_in_words():
    tilted = average(
        [solved(trial(np.random.default_rng(10), tilt_rad=(0.01, 0.0), noise_px=0.02, corner_px=0.02))], False
    )
    assert any("the fingertips don't stand on the plate" in w and "tilted by +0.5" in w for w in tilted.warnings)
    apart = average([solved(trial(np.random.default_rng(10), gap_m=5e-4, noise_px=0.02, corner_px=0.02))], False)
    assert any(" mm above it" in w for w in apart.warnings)
    below = average([solved(trial(np.random.default_rng(10), gap_m=-5e-4, noise_px=0.02, corner_px=0.02))], False)
    assert any(" mm below it" in w for w in below.warnings)
    bent = CORNERS_M.copy()
    bent[3] += [1e-3, 0.0, 0.0]
    found = solved(trial(np.random.default_rng(11), corners_m=bent, noise_px=0.02, corner_px=0.02))
    assert any("right_inner_far" in w and "uncertainty x" in w for w in average([found], False).warnings)


def test_an_inferred_gripper_that_is_no_rectangle_is_refused_or_warned_of():
    def bent(by_m: float) -> Trial:
        corners_m = CORNERS_M.copy()
        corners_m[3, 0] += by_m
        return trial(np.random.default_rng(11), corners_m=corners_m, noise_px=0.02, corner_px=0.02)

    with pytest.raises(CalibrationError, match=r"don't form a rectangle on the plate .* mm off"):
        solved(bent(1e-3), None)
    # Fingers may be a little out of line: that is warned of, however well it is seen.
    found = solved(bent(1e-4), None)
    assert found.p_value < 1e-6
    assert any("don't form a rectangle" in w and "uncertainty x" in w for w in average([found], True).warnings)


def test_corners_off_the_plate_are_warned_of():
    made = trial(np.random.default_rng(12), noise_px=0.02, corner_px=0.02, cam_T_grip=TRUE)
    left = made.sighting.uv_px[:, 0] < 330.0
    part = type(made.sighting)(
        made.sighting.uv_px[left], made.sighting.plate_m[left], made.sighting.covariance_px[left],
        made.sighting.size_px, 0.0, "beside.png",
    )  # fmt: skip
    found = solved(Trial(TRUE, part, made.corners))
    warnings = average([found], False).warnings
    assert any(
        w.startswith("beside.png: off the part of the plate that is seen:") and "right_outer" in w for w in warnings
    )
    assert not any("left_outer" in w for w in warnings)


def test_a_gripper_that_is_turned_around_is_told_from_its_rough_calibration():
    about_z = transform([0.0, 0.0, np.pi], [0.0, 0.0, 0.0])
    said = against(TRUE @ about_z, TRUE)
    assert said is not None and "turned by 180 degrees" in said
    assert against(TRUE @ transform([0.1, 0.2, 0.3], [0.01, 0.0, 0.0]), TRUE) is None
