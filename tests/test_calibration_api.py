"""What a notebook calls takes values and gives values: arrays in, frozen results with truth inside their covariance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2
from support.laser_scenes import PAPER_LENS, scene

from gripmon.calibrate.api import calibrate_intrinsics, calibrate_robot_world, check_fixed
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.api import Samples, calibrate_laser, check_laser
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.geometry import invert, perturb, perturbation_between
from gripmon.model.provenance import provenance_of


def test_a_laser_from_arrays_and_whether_it_still_holds():
    data = scene(seed=3)
    samples = Samples.of_spots(data.uv_px, data.base_T_ee)
    found = calibrate_laser(samples, PAPER_LENS)
    truth = invert(data.truth.cam_T_base)
    written = found.document(provenance_of("a test"))
    covariance = np.reshape(written.covariance, (13, 13))[:6, :6]
    error = perturbation_between(found.base_T_cam, truth)
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.9999, 6)
    assert found.notes == ("nothing is known of the camera's errors: it counts as exact",)
    assert check_laser(written, samples).verdict == "same"
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.notes = ()  # type: ignore[misc]


def test_a_lens_of_which_nothing_is_known_can_t_be_refined():
    data = scene(seed=3)
    with pytest.raises(InputError, match="no covariance of parameters"):
        calibrate_laser(Samples.of_spots(data.uv_px, data.base_T_ee), PAPER_LENS, refine_lens=True)


@pytest.mark.parametrize("eye_in_hand", [False, True])
def test_robot_and_world_from_arrays(eye_in_hand: bool):
    rng = np.random.default_rng(7)
    cam_T_base, ee_T_target = (perturb(np.eye(4), rng.normal(0.0, 0.5, 6)) for _ in range(2))
    base_T_ee = np.stack([perturb(np.eye(4), rng.normal(0.0, 0.6, 6)) for _ in range(12)])
    moving = np.stack([invert(T) for T in base_T_ee]) if eye_in_hand else base_T_ee
    seen = np.stack([perturb(T, rng.normal(0.0, 1e-4, 6)) for T in cam_T_base @ moving @ ee_T_target])
    found = calibrate_robot_world(base_T_ee, seen, eye_in_hand=eye_in_hand)
    error = np.concatenate(
        [perturbation_between(found.cam_T_base, cam_T_base), perturbation_between(found.ee_T_target, ee_T_target)]
    )
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.9999, 12)


def test_images_without_the_target_are_no_result_with_a_reason_each():
    grey = np.random.default_rng(1).integers(0, 255, (2, 120, 160), dtype=np.uint8)
    with pytest.raises(CalibrationError, match=r"none of 2 images shows the target") as caught:
        calibrate_intrinsics(list(grey), "chequerboard:9x6:0.025")
    assert isinstance(caught.value, NoResultError)
    with pytest.raises(InputError, match="image 2: is the same image as image 1"):
        calibrate_intrinsics([grey[0], grey[0]], "chequerboard:9x6:0.025")
    with pytest.raises(InputError, match="chequerboard:COLUMNSxROWS"):
        calibrate_intrinsics(list(grey), "chequerboard:9")


@pytest.mark.parametrize(
    ("fixed", "why"),
    [
        ({"kappa_per_px2": 0.0}, "is not a parameter of the model"),
        ({"fx_px": None}, "above 0"),
        ({"aspect": 1.0}, "takes no value"),
        ({"cx_px": float("nan")}, "is not a number"),
        ({"aspect": None, "fy_px": 900.0}, "one of them"),
    ],
)
def test_parameters_that_cannot_be_held_are_named(fixed: dict[str, float | None], why: str):
    with pytest.raises(InputError, match=why) as caught:
        check_fixed(fixed, "brown_conrady")
    assert str(caught.value).partition(":")[0] in fixed
