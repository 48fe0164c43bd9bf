"""``tools/servo``: the arm against its table of lengths and against differences, the eye against its own noise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gripmon.model.geometry import invert, make_transform, perturbation_between, skew

pytest.importorskip("pinocchio")
TOOLS = Path(__file__).resolve().parent.parent / "tools"
POSES = np.random.default_rng(5).uniform(-3.0, 3.0, (20, 6))

pytestmark = pytest.mark.usefixtures("tools_importable")


def by_hand(q: np.ndarray) -> np.ndarray:
    """Product of the Denavit-Hartenberg matrices, written out."""
    from servoing.arm import DH, FLANGE_T_GRIP

    pose = np.eye(4)
    for theta, (d, a, alpha) in zip(q.tolist(), DH, strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array(
            [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return pose @ FLANGE_T_GRIP


def hat(twist: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = skew(twist[3:]), twist[:3]
    return out


def test_forward_kinematics_is_the_product_of_its_table():
    from servoing.arm import Arm

    arm = Arm()
    for q in POSES:
        np.testing.assert_allclose(arm.base_T_grip(q), by_hand(q), atol=1e-12)


def test_jacobian_is_that_of_central_differences():
    from servoing.arm import Arm

    arm, step = Arm(), 1e-6
    for q in POSES:
        numeric = np.empty((6, 6))
        for k in range(6):
            nudge = step * np.eye(6)[k]
            change = invert(by_hand(q)) @ (by_hand(q + nudge) - by_hand(q - nudge)) / (2.0 * step)
            turn = change[:3, :3]
            numeric[:, k] = [*change[:3, 3], turn[2, 1], turn[0, 2], turn[1, 0]]
        np.testing.assert_allclose(arm.jacobian(q), numeric, atol=1e-8)


def test_a_twist_for_a_second_leads_from_one_pose_to_the_other():
    from servoing.arm import twist_to

    rng = np.random.default_rng(2)
    for _ in range(20):
        here, there = (make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)) for _ in range(2))
        np.testing.assert_allclose(here @ expm(hat(twist_to(here, there))), there, atol=1e-9)


def test_rates_give_the_twist_where_the_arm_is_free_and_stay_small_where_it_isn_t():
    from servoing.arm import HOME_RAD, RATE_RAD_PER_S, Arm

    arm, rng = Arm(), np.random.default_rng(3)
    twist = 0.01 * rng.normal(size=6)
    np.testing.assert_allclose(arm.jacobian(HOME_RAD) @ arm.rates(HOME_RAD, twist), twist, atol=1e-2 * 0.03)
    fast = arm.rates(HOME_RAD, 1e3 * twist)
    assert np.abs(fast / RATE_RAD_PER_S).max() == pytest.approx(1.0)
    np.testing.assert_allclose(fast / np.linalg.norm(fast), (r := arm.rates(HOME_RAD, twist)) / np.linalg.norm(r))
    straight = HOME_RAD * [1, 1, 0, 1, 1, 1]  # elbow stretched: no pull along the arm moves it
    assert arm.dexterity(straight) < 1e-6
    assert np.abs(arm.rates(straight, twist)).max() <= np.linalg.norm(twist) / (2 * 0.02) + 1e-12


def test_joints_stop_at_their_range_and_say_so():
    from servoing.arm import HOME_RAD, LIMIT_RAD, Arm

    arm = Arm()
    q, stopped = arm.moved(HOME_RAD, np.full(6, 0.1), 0.5)
    np.testing.assert_allclose(q, HOME_RAD + 0.05)
    assert not stopped
    q, stopped = arm.moved(HOME_RAD, np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]), 1.0)
    assert stopped and q[2] == -LIMIT_RAD[2]


def test_every_placement_can_be_reached_and_begins_at_the_stand_off():
    from servoing import stage
    from servoing.arm import Arm

    arm, rng = Arm(), np.random.default_rng(4)
    places = []
    for _ in range(20):
        base_T_object, start = stage.placement(arm, rng)
        before = invert(by_hand(start)) @ base_T_object
        away_m = before[:3, 3] - [0.0, 0.0, stage.DISTANCE_M]
        assert 1e-3 < np.linalg.norm(away_m) < 0.03
        end = arm.reach(base_T_object, start)
        assert end is not None
        np.testing.assert_allclose(by_hand(end), base_T_object, atol=1e-8)
        places.append(base_T_object[:3, 3])
    assert np.ptp(places, axis=0).min() > 0.03
    assert arm.reach(make_transform(np.eye(3), np.array([3.0, 0.0, 0.0])), start) is None


def scene():
    from servoing.eye import Eye, object_points_m

    from gripmon.daemon.config import load_config
    from gripmon.model.geometry import from_record
    from gripmon.simulate.scenario import GraspedObject

    config = load_config(TOOLS.parent / "configs" / "demo.yaml", check_source=False)
    points_m = object_points_m(GraspedObject())
    return Eye(config.camera, points_m), from_record(config.reference.cam_T_grip), config.camera, points_m


def test_without_noise_the_eye_sees_the_object_where_it_is():
    from servoing import stage

    eye, cam_T_grip, _, points_m = scene()
    quiet = np.zeros((len(points_m), 2))
    for away_m in (0.0, 0.04, stage.DISTANCE_M):
        true = cam_T_grip @ make_transform(
            Rotation.from_rotvec([0.03, -0.05, 0.2]).as_matrix(), np.array([0, 0, away_m])
        )
        seen = eye.cam_T_object(true, quiet)
        assert seen is not None
        np.testing.assert_allclose(perturbation_between(true, seen), 0.0, atol=1e-9)
    assert eye.cam_T_object(make_transform(np.eye(3), np.array([0.0, 0.5, 0.2])), quiet) is None  # outside the image
    assert eye.cam_T_object(make_transform(np.eye(3), np.array([0.0, 0.0, -0.2])), quiet) is None  # behind the camera


def test_the_eye_is_as_noisy_as_its_pixels_make_it():
    """Scatter of the pose against the bound by the projection's differences: least squares reach it."""
    from servoing.eye import SIGMA_PX

    from gripmon.model.geometry import perturb

    eye, cam_T_object, camera, points_m = scene()
    noise = np.random.default_rng(6)
    errors = np.array(
        [perturbation_between(cam_T_object, eye.cam_T_object(cam_T_object, eye.noise_px(noise))) for _ in range(1500)]
    )

    def project(xi: np.ndarray) -> np.ndarray:
        pose = perturb(cam_T_object, xi)
        return camera.project(points_m @ pose[:3, :3].T + pose[:3, 3]).ravel()

    step = 1e-6
    slope = np.stack([(project(step * e) - project(-step * e)) / (2.0 * step) for e in np.eye(6)], axis=1)
    bound = SIGMA_PX * np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    np.testing.assert_allclose(errors.std(axis=0), bound, rtol=0.1)
    assert (np.abs(errors.mean(axis=0)) < 5.0 * bound / math.sqrt(len(errors))).all()
