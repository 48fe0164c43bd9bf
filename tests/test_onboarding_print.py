"""Fingers before a print: its colours wherever they may be seen, and edges that vanish before every other square."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from support import plate_fingers
from support.plate_fingers import CHARUCO, CHEQUERBOARD, DISCS, outline_pixels, rough, standing
from support.plates import Look
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.calibrate.detection import detect
from gripmon.calibrate.plane import GivenCamera
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import make_camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.targets import Target
from gripmon.teach.hand_eye import UnknownGripper
from gripmon.teach.plate_print import plate_print

TRUE = nominal_cam_T_grip()


def _sight(frame: np.ndarray, target: Target) -> Sighting:
    found = detect(frame, target, "plate.png")
    assert isinstance(found, Sighting), found
    return found


@pytest.mark.parametrize("target", [CHEQUERBOARD, CHARUCO])
def test_the_print_is_what_the_image_shows_of_it(target: Target):
    frame = standing(target, look=Look(supersampling=3))
    seen = _sight(frame, target)
    camera, pose = make_camera(PAPER_LENS), plate_pose(PAPER_LENS, seen)[0]
    printed = plate_print(camera, pose, seen, target, frame)
    assert printed is not None
    # About the corners, which are bare; lines themselves are half and half.
    places = (seen.uv_px[:, None] + np.random.default_rng(1).uniform(-12.0, 12.0, (len(seen), 40, 2))).reshape(-1, 2)
    places = np.rint(places[np.all((places > 3.0) & (places < np.array(frame.shape[::-1]) - 4.0), axis=1)])
    around = np.stack([printed.shown(places + step) for step in ([0, 0], [3, 0], [-3, 0], [0, 3], [0, -3])])
    plain = np.all(around == around[0], axis=0)
    assert np.count_nonzero(plain) > 300
    light, dark = printed.levels(places[plain])
    grey = frame[places[plain, 1].astype(int), places[plain, 0].astype(int)].astype(float)
    agree = np.abs(grey - np.where(around[0, plain] == 1.0, light, dark)) < 0.15 * (light - dark)
    assert np.mean(agree) > 0.97
    assert np.isnan(printed.shown(np.array([[-500.0, -500.0]]))).all()


def test_discs_and_a_plate_that_isnt_told_need_no_print():
    frame = standing(DISCS, look=Look(supersampling=3))
    seen = _sight(frame, DISCS)
    camera = make_camera(PAPER_LENS)
    assert plate_print(camera, TRUE, seen, DISCS, frame) is None
    assert plate_print(camera, TRUE, seen, None, frame) is None


@pytest.mark.parametrize(("target", "grey"), [(CHARUCO, 40.0), (CHEQUERBOARD, 130.0)])
def test_fingers_that_vanish_before_dark_print_or_stand_out_light(
    target: Target, grey: float, monkeypatch: pytest.MonkeyPatch
):
    """As dark as dark squares; and between both, so that the contrast changes its sign from square to square."""
    monkeypatch.setattr(plate_fingers, "FACE_GREYS", (grey,) * 6)
    frame = standing(target, turn_rad=0.35, look=Look(supersampling=3))
    seen = _sight(frame, target)
    found = (
        UnknownGripper(GivenCamera(PAPER_LENS), target).measure(frame, seen, rough(outline_pixels(TRUE), 2)).coincidence
    )
    error = perturbation_between(found.cam_T_grip, TRUE)
    assert np.abs(error[:3]).max() < 5e-5, 1e6 * error[:3]
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(1.0 - 1e-5, 6)
