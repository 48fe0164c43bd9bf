"""Finding the gripper again after jumps far beyond the profiles' reach: random jumps in simulated scenes, no lies."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.grippers import gripper_from_dict
from support.meters import (
    EVERYWHERE,
    NARROW,
    box_gripper,
    difference,
    measure,
    meter,
    moved,
    picture,
)
from support.simulated import PAPER_LENS, box_model, nominal_cam_T_grip, plain_scenario

from gripmon.model.camera import make_camera
from gripmon.simulate import make_scenario
from gripmon.track.edges import Effort, Measurement
from gripmon.track.edges.search import search_poses
from gripmon.track.edges.settings import SearchSettings

SETTINGS = SearchSettings()


def jumps(rng: np.random.Generator, count: int) -> np.ndarray:
    """Shifts of the TCP by up to 10 mm along every axis, turns by up to 4 degrees about every axis."""
    xi = np.zeros((count, 6))
    xi[:, :3] = rng.uniform(-0.01, 0.01, (count, 3))
    xi[:, 3:] = np.deg2rad(rng.uniform(-4.0, 4.0, (count, 3)))
    return xi


def is_true(found: Measurement, cam_T_grip: np.ndarray) -> bool:
    error = difference(found.cam_T_grip, cam_T_grip)
    return bool(np.abs(error[:2]).max() < 1.5e-4 and abs(error[2]) < 6e-4)


def test_random_jumps_are_found_and_never_a_wrong_place_is_trusted():
    """Of 30 jumps, in one frame, before a background that is full of straight edges."""
    rng, true = np.random.default_rng(11), nominal_cam_T_grip()
    found = 0
    for seed in (3, 4, 5):
        image = picture(make_scenario("clutter"), 0, seed)
        for xi in jumps(rng, 10):
            got = measure(image, moved(true, xi), patience=EVERYWHERE)
            assert not got.trusted or is_true(got, true), xi
            found += got.trusted
    assert found >= 27


def test_without_patience_a_jump_is_not_found_and_not_trusted():
    rng, true = np.random.default_rng(12), nominal_cam_T_grip()
    image = picture(make_scenario("static"), 0, 3)
    for xi in jumps(rng, 10):
        got = measure(image, moved(true, xi), patience=NARROW)
        assert not got.trusted and got.effort is Effort.NARROW and not got.looked_far


def test_the_grid_suffices_for_a_jump_of_a_few_pixels_and_the_search_is_spared():
    true = nominal_cam_T_grip()
    for xi in ([5e-4, -4e-4, 0.0, 0.0, 0.0, 0.0], [-5e-4, 0.0, 0.0, 0.0, 0.0, 0.008]):
        got = measure(picture(make_scenario("static"), 0, 3), moved(true, np.array(xi)), patience=EVERYWHERE)
        assert got.trusted and is_true(got, true) and got.effort is not Effort.SEARCH


def test_a_gripper_that_is_where_it_was_expected_is_not_looked_for():
    got = measure(picture(make_scenario("static"), 0, 3), patience=EVERYWHERE)
    assert got.trusted and got.effort is Effort.NARROW and not got.looked_far


def test_nothing_is_found_where_no_gripper_is():
    rng = np.random.default_rng(13)
    for seed in range(6):
        texture = cv2.GaussianBlur(rng.normal(size=(576, 768)), (0, 0), 0.7 + seed)
        boxes = np.zeros((576, 768), np.uint8)
        for _ in range(60):
            corner = rng.integers(0, [768, 576])
            size = rng.integers(20, 160, 2)
            level = int(rng.integers(30, 220))
            cv2.rectangle(boxes, corner.tolist(), (corner + size).tolist(), level, -1)
        image = np.clip(boxes + 20.0 * texture / texture.std() + 20.0, 0, 255).astype(np.uint8)
        assert not measure(image, patience=EVERYWHERE).trusted


def searched(image: np.ndarray, expected: np.ndarray, settings: SearchSettings = SETTINGS) -> np.ndarray:
    return search_poses(image, make_camera(PAPER_LENS), box_gripper(), expected, 0.034, settings)


def test_edges_that_never_show_in_place_are_not_asked_for_elsewhere():
    """Without faces a file doesn't say which of its edges the fingers hide themselves."""
    model = box_model()
    del model["faces"]
    image, true = picture(make_scenario("static"), 0, 3), nominal_cam_T_grip()
    using = meter(gripper_from_dict(model))
    here = measure(image, using=using)
    assert here.trusted and here.consensus.edge_seen.sum() < 0.7 * len(here.consensus.edge_seen)
    away = moved(true, np.array([0.006, -0.004, 0.003, 0.0, 0.0, 0.03]))
    assert not measure(image, away, using=using, patience=EVERYWHERE).trusted
    using.shown = here.consensus.edge_seen.astype(float)
    again = measure(image, away, using=using, patience=EVERYWHERE)
    assert again.trusted and again.effort is Effort.SEARCH and is_true(again, true)


def test_no_proposed_pose_lies_far_beyond_the_reach():
    image, expected = picture(make_scenario("clutter"), 0, 3), nominal_cam_T_grip()
    settings = SearchSettings(reach_m=0.004, turn_rad=0.03, tilt_rad=0.02, starts=8)
    poses = searched(image, expected, settings)
    assert len(poses) == 8
    xi = np.array([difference(expected, pose) for pose in poses])
    # Turns act about the middle of what is seen of the fingers, 25 mm from the TCP; polishing may go half as far again.
    assert np.abs(xi[:, :3]).max() <= 1.5 * (0.004 + 0.05 * 0.03)
    assert np.abs(xi[:, 3:]).max() <= 2.5 * 0.03


@pytest.mark.usefixtures("tools_importable")
def test_before_a_chequer_a_knock_of_a_usual_size_is_found_where_many_far_places_look_alike():
    """Two dozen places 15 mm away, in which borders of the chequer run like the fingers' sides, had most votes."""
    from benchmarks.integrity_practice import CONDITIONS
    from benchmarks.integrity_scenes import make_integrity_scene

    (bump,) = [condition for condition in CONDITIONS if condition.name == "bump"]
    scene = make_integrity_scene(bump, 1504, 0, 96)
    simulator, before, after = scene.simulator, scene.first + 41, range(scene.first + 42, scene.first + 48)
    expected, found = simulator.truth(before).cam_T_grip, 0
    for index in after:
        frame, true = simulator.frame(index), simulator.truth(index)
        assert frame.image is not None
        poses = search_poses(
            frame.image, simulator.camera, scene.gripper, expected, true.jaw_opening_m, SearchSettings()
        )
        found += min(np.linalg.norm(difference(pose, true.cam_T_grip)[:3]) for pose in poses) < 1.5e-3
    assert found >= 4, "1 of the 6 frames where far places count as much as near ones"


def test_nothing_is_searched_for_when_nothing_can_be_seen():
    pose = moved(nominal_cam_T_grip(), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    image = picture(plain_scenario())
    assert searched(image, pose).shape == (0, 4, 4)
    assert not measure(image, pose, patience=EVERYWHERE).trusted


@pytest.mark.parametrize("kind", ["colour", "uint16", "float32"])
def test_other_kinds_of_images_are_searched_as_well(kind: str):
    image = picture(make_scenario("static"), 0, 3)
    other = {
        "colour": np.repeat(image[..., None], 3, axis=2),
        "uint16": image.astype(np.uint16) * 257,
        "float32": image.astype(np.float32) / 255.0,
    }[kind]
    xi = np.array([0.007, -0.005, 0.003, 0.0, 0.0, 0.04])
    got = measure(other, moved(nominal_cam_T_grip(), xi), patience=EVERYWHERE)
    assert got.trusted and is_true(got, nominal_cam_T_grip())


def test_pixels_that_are_not_finite_do_not_stop_a_search():
    image = picture(make_scenario("static"), 0, 3).astype(np.float32) / 255.0
    image[40:60, 300:330] = np.nan
    xi = np.array([0.007, -0.005, 0.003, 0.0, 0.0, 0.04])
    got = measure(image, moved(nominal_cam_T_grip(), xi), patience=EVERYWHERE)
    assert got.trusted and is_true(got, nominal_cam_T_grip())
