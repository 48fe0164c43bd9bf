"""``gripmon check --sweep``: mounts are what they are said to be, and what is predicted of them happens in images."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.meters import FISHEYE_LENS, box_gripper, difference
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.monitor import MonitorSettings, Tracker
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, FingerLook
from gripmon.teach.accuracy import forecast_frame
from gripmon.teach.mounts import Mount, field_of_view_rad, towards, try_mount, with_focal
from gripmon.teach.visibility import Rig, see
from gripmon.track.edges.prediction import lay_out

AT_PX = (386.0, 298.0)
SEEN = Mount(0.115, math.radians(32.0), 0.0, 0.0)


def pose(mount: Mount) -> np.ndarray:
    return mount.pose(towards(make_camera(PAPER_LENS), AT_PX))


def rig() -> Rig:
    return Rig(make_camera(PAPER_LENS), box_gripper(), MonitorSettings())


def tried(mount: Mount) -> Any:
    return try_mount(rig(), mount, pose(mount), 0.034)


# --- what the numbers of a mount mean ---


@pytest.mark.parametrize("seed", range(2))
def test_a_mount_says_what_a_pose_is(seed: int):
    rng = np.random.default_rng(seed)
    cam_T_grip = np.eye(4)
    cam_T_grip[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    cam_T_grip[:3, 3] = rng.normal(size=3) * 0.02 + np.array([0.0, 0.0, 0.1])
    mount = Mount.of(cam_T_grip)
    np.testing.assert_allclose(mount.pose(cam_T_grip[:3, 3]), cam_T_grip, atol=1e-12)
    # By their definitions, with the camera's axis and centre in the gripper frame.
    axis = cam_T_grip[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    assert math.cos(mount.tilt_rad) == pytest.approx(axis[2])
    assert mount.distance_m == pytest.approx(np.linalg.norm(cam_T_grip[:3, 3]))
    # It looks away from the side on which it sits.
    sits = np.array([math.sin(mount.side_rad), -math.cos(mount.side_rad)])
    assert -axis[:2] / np.linalg.norm(axis[:2]) == pytest.approx(sits)


def test_a_roll_turns_the_picture_clockwise():
    """About the principal point, where the axis is: y points down, so clockwise is from x to y."""
    camera = make_camera(PAPER_LENS)
    ahead = towards(camera, (camera.cx_px, camera.cy_px))
    upright, rolled = (Mount(0.115, 0.5, 0.3, roll).pose(ahead) for roll in (0.2, 0.2 + math.radians(25.0)))
    points = np.array([[0.01, 0.005, 0.0], [-0.02, 0.01, -0.01]])
    before, after = (
        camera.project(points @ p[:3, :3].T + p[:3, 3]) - [camera.cx_px, camera.cy_px] for p in (upright, rolled)
    )
    c, s = math.cos(math.radians(25.0)), math.sin(math.radians(25.0))
    np.testing.assert_allclose(after, before @ np.array([[c, s], [-s, c]]), atol=1e-9)


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS, FISHEYE_LENS], ids=["paper", "brown_conrady", "fisheye"])
def test_the_tcp_stays_where_it_is_with_every_lens(lens: Any):
    camera = make_camera(lens)
    for focal_px in (lens.fx_px, 600.0, 1500.0):
        other = with_focal(camera, focal_px)
        cam_T_grip = SEEN.pose(towards(other, AT_PX))
        np.testing.assert_allclose(other.project(cam_T_grip[None, :3, 3])[0], AT_PX, atol=1e-6)
    assert with_focal(camera, lens.fx_px) is camera
    wide = with_focal(camera, 600.0)
    assert wide.fy_px / wide.fx_px == pytest.approx(lens.fy_px / lens.fx_px)
    # Without distortion: OpenCV's own projection with none.
    point = np.array([[0.03, -0.02, 0.1]])
    matrix = np.array([[600.0, 0.0, wide.cx_px], [0.0, wide.fy_px, wide.cy_px], [0.0, 0.0, 1.0]])
    model = cv2.fisheye.projectPoints if lens is FISHEYE_LENS else cv2.projectPoints
    expected = model(point[None], np.zeros(3), np.zeros(3), matrix, np.zeros(4))[0].reshape(1, 2)
    np.testing.assert_allclose(wide.project(point), expected, atol=1e-9)


def test_the_field_of_view_is_the_angle_between_the_rays_at_the_images_ends():
    ideal = with_focal(make_camera(PAPER_LENS), 500.0)
    width = math.atan(ideal.cx_px / 500.0) + math.atan((767.0 - ideal.cx_px) / 500.0)
    assert field_of_view_rad(ideal) == pytest.approx(width)
    fisheye = with_focal(make_camera(FISHEYE_LENS), 500.0)
    # Equidistant: the angle is the radius over the focal length, along a row through the centre.
    assert field_of_view_rad(fisheye) == pytest.approx(767.0 / 500.0, rel=1e-3)


# --- what is predicted, against simulated images ---

MOUNTS = {
    "near and flat": Mount(0.095, math.radians(55.0), 0.0, 0.0),
    "rolled": Mount(0.125, math.radians(30.0), 0.0, math.radians(90.0)),
    "aside": Mount(0.125, math.radians(20.0), math.radians(60.0), 0.0),
}
FRAMES = 20
TABLE = Background(boxes=0, cables=0)


def scatter(mount: Mount) -> np.ndarray:
    """(6,) spread of what the real tracker measures in simulated images while the robot moves over a printed table.

    Nothing but the fingers hides anything: what a gripper file doesn't describe can't be predicted.
    """
    camera, gripper = make_camera(PAPER_LENS), read_gripper(BOX_FINGERS)
    cam_T_grip = pose(mount)
    scenario = Scenario(duration_s=20.0, fps=4.0, background=TABLE, fingers=FingerLook(carriers=False))
    simulator = paper_rig(gripper, cam_T_grip).simulator(scenario, 3)
    tracker = Tracker(camera, gripper, MonitorSettings(jaw_sigma_m=0.0))
    errors = []
    for k in range(FRAMES):
        measured = tracker.measure(simulator.frame(k), cam_T_grip, k / scenario.fps)
        assert measured.trusted
        errors.append(difference(tracker.update(measured)[0], simulator.truth(k).cam_T_grip))
    return np.std(errors, axis=0)


@pytest.mark.parametrize("name", MOUNTS)
def test_a_swept_mount_scatters_as_predicted(name: str):
    """Another noise, and texture, than assumed: within a factor of three on every axis, the axes in their order."""
    spread = scatter(MOUNTS[name])
    gripper = read_gripper(BOX_FINGERS)
    known = Rig(make_camera(PAPER_LENS), gripper, MonitorSettings(jaw_sigma_m=0.0))
    trial = try_mount(known, MOUNTS[name], pose(MOUNTS[name]), 0.034)
    expected = trial.accuracy.expected.array
    print(name, (spread / expected).round(2), (expected[:3] * 1e6).round(1))
    assert (spread < 3.0 * expected).all()
    assert (spread > 0.1 * expected).all()
    assert spread[:3].argmax() == expected[:3].argmax()


# --- why a mount would not work ---


def test_too_near_the_open_jaws_leave_the_image():
    trial = tried(Mount(0.060, math.radians(32.0), 0.0, 0.0))
    assert trial.faults[0].kind == "too little in view in a part of the jaw's travel"
    assert "outside of the image" in trial.faults[0].text
    # Counted one by one.
    mount = Mount(0.060, math.radians(32.0), 0.0, 0.0)
    enough = [see(rig(), pose(mount), o).enough for o in np.linspace(0.0, 0.060, len(trial.jaw.opening_m))]
    assert trial.jaw.share == np.mean(enough) < 1.0
    assert trial.rank > tried(SEEN).rank


def test_from_the_side_one_finger_hides_the_other():
    sight = see(rig(), pose(Mount(0.115, math.radians(88.0), math.radians(90.0), 0.0)), 0.034)
    assert sight.behind.any()
    names = [n for n, behind in zip(box_gripper().corner_ids, sight.behind, strict=True) if behind]
    assert all(name.startswith("L") for name in names), "the camera sits on the right finger's side"


def test_edges_behind_another_finger_are_not_counted_on():
    """The monitor lays its samples on them all the same; what they would add isn't promised."""
    camera, gripper, settings, _ = rig()
    cam_T_grip = pose(Mount(0.115, math.radians(70.0), math.radians(75.0), 0.0))
    layout = lay_out(camera, gripper, cam_T_grip, 0.034, settings.corners.sampling)
    sight = see(rig(), cam_T_grip, 0.034)
    assert sight.edges < len(layout.edges)
    assert forecast_frame(rig(), cam_T_grip, 0.034).edges == sight.edges


def test_a_camera_that_looks_at_the_back_of_everything_sees_nothing():
    trial = tried(Mount(5.0, math.radians(32.0), 0.0, 0.0))
    assert trial.faults[0].kind == "nowhere enough in view" and trial.accuracy is None
    assert trial.noticed_m == math.inf
    assert "0 edges long enough" in trial.faults[0].text
