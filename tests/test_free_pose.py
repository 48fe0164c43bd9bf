"""A gripper's pose from all its edges, held against the plate: what leaves it, and through another camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import msgspec
import numpy as np
from scipy.stats import chi2
from support.plate_fingers import DISCS, OPENING_M, rough, standing, true_corners
from support.plate_views import LENS, solved, trial
from support.plates import Look
from support.simulated import PAPER_LENS, nominal_cam_T_grip, sharp_gripper

from gripmon.calibrate.detection import detect
from gripmon.calibrate.plane import GivenCamera
from gripmon.calibrate.plane_equations import FreePose, off_plate
from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import make_camera
from gripmon.model.geometry import exp_rotation, make_transform, perturb
from gripmon.teach.hand_eye import KnownGripper

POINTS_M = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.008, 0.008) for z in (0.0, -0.03)])
SIGMA = np.array([2e-6, 3e-6, 2e-5, 2e-4, 1e-4, 5e-5])


def test_tilt_and_gap_by_their_definition():
    for tilt, gap_m in (((1e-3, 0.0), 0.0), ((0.0, -2e-3), 0.0), ((0.0, 0.0), 3e-4), ((1e-3, 2e-3), -1e-4)):
        grip_T_plate = make_transform(np.eye(3), np.array([0.0, 0.0, 0.002 + gap_m]))
        cam_T_plate = nominal_cam_T_grip() @ grip_T_plate
        leaning = nominal_cam_T_grip() @ make_transform(exp_rotation(np.array([*tilt, 0.0])), np.zeros(3))
        np.testing.assert_allclose(off_plate(leaning, cam_T_plate, 0.002), [*tilt, gap_m], atol=5e-6)


def test_through_another_camera_it_is_what_pnp_finds_there():
    made = make_camera(PAPER_LENS)
    other = make_camera(msgspec.structs.replace(PAPER_LENS, fx_px=965.0, fy_px=965.0, cx_px=385.0, kappa_per_px2=2e-7))
    free = FreePose(nominal_cam_T_grip(), np.diag(SIGMA**2), made, POINTS_M)
    uv = made.project(POINTS_M @ free.cam_T_grip[:3, :3].T + free.cam_T_grip[:3, 3])
    _, turn, shift = cv2.solvePnP(POINTS_M, other.undistort(uv), np.eye(3), None, flags=cv2.SOLVEPNP_ITERATIVE)
    found = free.through(other)
    np.testing.assert_allclose(found[:3, :3], cv2.Rodrigues(turn)[0], atol=1e-5)
    np.testing.assert_allclose(found[:3, 3], shift.ravel(), atol=1e-6)
    assert free.through(made) is free.cam_T_grip


def test_what_leaves_the_plate_has_the_spread_that_is_stated():
    """Over poses and plates with errors of their own: chi-squared with three degrees of freedom, and a camera that
    isn't exact moves plate and gripper together.
    """
    rng, sizes, p_values = np.random.default_rng(1), [], []
    for seed in range(60):
        made = trial(np.random.default_rng(seed), noise_px=0.05, corner_px=0.05)
        pose = perturb(made.cam_T_grip, rng.normal(0.0, SIGMA))
        free = FreePose(pose, np.diag(SIGMA**2), make_camera(LENS), POINTS_M)
        found = solved(replace(made, corners=replace(made.corners, free=free)))
        assert found.apart_p is not None and found.apart_sigma is not None and found.tilt_rad is not None
        p_values.append(found.apart_p)
        sizes.append(np.append(found.tilt_rad, found.gap_m) / found.apart_sigma)
    assert 40.0 < chi2.isf(np.array(p_values), 3).sum() / 3.0 < 85.0
    assert (np.abs(np.std(sizes, axis=0) - 1.0) < 0.35).all()


def test_a_tenth_of_a_degree_is_noticed_in_an_image():
    """The corners alone, in the plane, hardly tell it: by the edges that rise from the plane it is many sigma."""
    names = [name for name in true_corners(nominal_cam_T_grip()) if not name.endswith("out_far")]
    guess = rough({name: true_corners(nominal_cam_T_grip())[name] for name in names}, 1)
    found = []
    for tilt_rad in ((0.0, 0.0), (np.radians(0.1), 0.0)):
        leaning = make_transform(exp_rotation(np.array([*tilt_rad, 0.0])), np.zeros(3))
        image = standing(DISCS, look=Look(supersampling=4, noise=1.0), grip_T_standing=leaning)
        sight = detect(image, DISCS, "leaning.png")
        assert isinstance(sight, Sighting)
        method = KnownGripper(GivenCamera(PAPER_LENS), sharp_gripper(), OPENING_M)
        found.append(method.measure(image, sight, guess).coincidence)
    flat, tilted = found
    assert flat.apart_p is not None and tilted.apart_p is not None and tilted.tilt_rad is not None
    assert flat.apart_p > 1e-3 and tilted.apart_p < 1e-4
    np.testing.assert_allclose(np.degrees(tilted.tilt_rad), [-0.1, 0.0], atol=0.03)
