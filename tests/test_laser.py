"""The laser-pointer method: its geometry, its closed form from end to end, degenerate set-ups by name."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.laser_scenes import assert_same, laser_printed, numeric, paper_setup, sampled, scene, translation_error

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser import closed_form
from gripmon.laser.refinement import SpotProblem, refine
from gripmon.laser.setup import (
    LaserSetup,
    beams,
    in_camera,
    nearest_points,
    spots_in_camera,
    spots_on_plane,
    spots_on_rays,
)
from gripmon.model.geometry import invert, make_transform, perturb


def ideal(data):
    return data.camera.undistort(data.uv_px)


# ---- the three ways to a spot


def test_the_three_ways_meet_in_one_spot_that_lies_on_plane_line_and_ray():
    data = scene()
    spots = spots_on_plane(data.truth, data.base_T_ee)
    assert np.abs(spots @ data.truth.normal_base - data.truth.distance_base_m).max() < 1e-12
    points, u = beams(data.truth, data.base_T_ee)
    assert np.abs(np.cross(spots - points, u)).max() < 1e-12
    assert np.abs(data.camera.project(in_camera(data.truth, spots)) - data.uv_px).max() < 1e-9
    assert np.abs(spots_on_rays(data.truth, ideal(data)) - spots).max() < 1e-11
    for between in nearest_points(data.truth, data.base_T_ee, ideal(data)):
        assert np.abs(between - spots).max() < 1e-11


def test_a_moved_plane_and_a_moved_camera_show_in_different_gaps():
    data = scene()
    xy = ideal(data)

    def apart(setup):
        on_rays, on_beams = nearest_points(setup, data.base_T_ee, xy)
        return np.linalg.norm(on_rays - on_beams, axis=1)

    assert apart(data.truth.moved(0.01 * np.eye(13)[8])).max() < 1e-11  # no plane in it
    assert np.median(apart(data.truth.moved(0.005 * np.eye(13)[1]))) > 5e-4


def test_the_nearest_points_are_those_of_a_search():
    data = scene()
    xy = ideal(data)[:5] + 0.01
    points, u = beams(data.truth, data.base_T_ee[:5])
    rays = np.concatenate([xy, np.ones((5, 1))], axis=1) @ data.truth.base_T_cam[:3, :3].T
    on_rays, on_beams = nearest_points(data.truth, data.base_T_ee[:5], xy)
    for k in range(5):
        design = np.stack([rays[k], -u[k]], axis=1)
        depth, along = np.linalg.lstsq(design, points[k] - data.truth.base_T_cam[:3, 3], rcond=None)[0]
        assert np.abs(on_rays[k] - data.truth.base_T_cam[:3, 3] - depth * rays[k]).max() < 1e-12
        assert np.abs(on_beams[k] - points[k] - along * u[k]).max() < 1e-12


@pytest.mark.parametrize("far", [0.0, 0.5])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_jacobian_of_spots_is_that_of_central_differences(seed, far):
    data = scene(seed)
    setup, poses = data.truth.moved(far * np.random.default_rng(seed).normal(size=13)), data.base_T_ee

    def seen(change):
        moved = np.stack([perturb(T, change[13:]) for T in poses])
        return spots_in_camera(setup.moved(change[:13]), moved)[0]

    slopes = spots_in_camera(setup, poses)[1]
    there = np.linalg.norm(spots_in_camera(setup, poses)[0], axis=1) < 5.0
    assert there.any()
    assert np.abs(slopes - numeric(seen, 19))[there].max() < 1e-5


def test_a_setup_as_the_camera_has_it_is_the_same_in_the_base():
    data = scene()
    again = LaserSetup.seen(
        data.truth.cam_T_base, data.truth.normal_cam, data.truth.distance_cam_m, data.truth.point_ee_m,
        data.truth.direction_ee,
    )  # fmt: skip
    assert_same(again, data.truth, 1e-12)
    spots = in_camera(data.truth, spots_on_plane(data.truth, data.base_T_ee))
    assert np.abs(spots @ data.truth.normal_cam - data.truth.distance_cam_m).max() < 1e-12


# ---- the closed form as printed, step by step


def test_orientations_are_found_from_the_poses():
    data = scene(orientations=6)
    shuffled = np.random.default_rng(0).permutation(60)
    groups = closed_form.orientation_groups(data.base_T_ee[shuffled])
    assert sorted(len(g) for g in groups) == [10] * 6
    for group in groups:
        assert len(set(data.group[shuffled[group]])) == 1


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("method", [laser_printed.solve, closed_form.solve])
def test_the_whole_closed_form_is_exact_without_noise(method, seed):
    data = scene(seed, orientations=3 + seed)
    assert_same(method(ideal(data), data.base_T_ee), data.truth)


def test_beams_along_other_axes_choose_another_origin_plane():
    rng = np.random.default_rng(8)
    for direction in ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]):
        paper = paper_setup(rng)
        u = np.array(direction)
        point = np.array([0.02, -0.03, 0.05]) * (1.0 - u)
        truth = LaserSetup(paper.base_T_cam, paper.normal_base, paper.distance_base_m, point, u)
        data = sampled(truth, rng)
        for method in (laser_printed.solve, closed_form.solve):
            assert_same(method(ideal(data), data.base_T_ee), truth)


# ---- the better closed form


def test_with_noise_the_common_plane_is_far_better_than_the_printed_closed_form():
    printed, common = [], []
    for seed in range(10):
        data = scene(seed, orientations=9)
        noisy = data.uv_px + np.random.default_rng(seed).normal(0.0, 0.5, data.uv_px.shape)
        xy = data.camera.undistort(noisy)
        printed.append(translation_error(laser_printed.solve(xy, data.base_T_ee), data.truth))
        common.append(translation_error(closed_form.solve(xy, data.base_T_ee, robust=False), data.truth))
    assert np.mean(common) < 0.5 * np.mean(printed)


def test_with_wrong_spots_the_start_still_refines_to_the_truth():
    for seed, share in ((1, 0.05), (2, 0.1), (3, 0.2), (4, 0.3)):
        data = scene(seed, orientations=9)
        rng = np.random.default_rng(seed)
        uv = data.uv_px + rng.normal(0.0, 0.5, data.uv_px.shape)
        wrong = rng.permutation(len(uv)) < share * len(uv)
        uv[wrong] += rng.choice([-1.0, 1.0], (wrong.sum(), 2)) * rng.uniform(10.0, 60.0, (wrong.sum(), 2))
        start = closed_form.solve(data.camera.undistort(uv), data.base_T_ee)
        found = refine(SpotProblem(data.camera, data.base_T_ee, uv), start)
        assert not found.used[wrong].any()
        assert found.used[~wrong].mean() > 0.95
        assert translation_error(found.setup, data.truth) < 0.01
        assert 0.4 < found.scale < 0.6


# ---- degenerate set-ups, by name


def refused(data, poses=None, uv=None):
    poses = data.base_T_ee if poses is None else poses
    uv = data.uv_px if uv is None else uv
    texts = []
    for method in (laser_printed.solve, closed_form.solve):
        with pytest.raises(CalibrationError) as error:
            method(data.camera.undistort(uv), poses)
        texts.append(str(error.value))
    return texts


def replayed(data, poses):
    """The same set-up with other poses."""
    uv = data.camera.project(in_camera(data.truth, spots_on_plane(data.truth, poses)))
    return poses, uv


def test_one_orientation_only():
    data = scene(orientations=1)
    for text in refused(data):
        assert text.startswith("1 orientation(s) with at least 6 spots each, of 1 in all")


def test_too_few_spots_at_each_orientation():
    data = scene(orientations=6)
    few = np.concatenate([np.flatnonzero(data.group == g)[:5] for g in range(6)])
    for text in refused(data, data.base_T_ee[few], data.uv_px[few]):
        assert text.startswith("0 orientation(s)")


def test_shifts_in_a_plane():
    data = scene(orientations=5)
    poses = data.base_T_ee.copy()
    for g in range(5):
        first = poses[data.group == g][0]
        flat = poses[data.group == g, :3, 3] - first[:3, 3]
        poses[data.group == g, :3, 3] = first[:3, 3] + flat * [1.0, 1.0, 0.0]
    for text in refused(data, *replayed(data, poses)):
        assert text.startswith("the shifts lie in a plane or on a line at 5 of 5 orientations")


def test_turned_about_one_axis_only():
    data = scene(4, orientations=1)
    first = data.base_T_ee[0]
    groups = []
    for angle in (-0.3, -0.15, 0.0, 0.15, 0.3):
        turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        groups += [make_transform(turn @ first[:3, :3], pose[:3, 3]) for pose in data.base_T_ee]
    poses, uv = replayed(data, np.stack(groups))
    for text in refused(data, poses, uv):
        assert "turned about one axis only" in text


def test_a_plane_through_the_camera_puts_all_spots_on_a_line():
    rng = np.random.default_rng(3)
    data = scene(orientations=5)
    uv = np.stack([np.linspace(50.0, 600.0, 50), 240.0 + 0.2 * np.linspace(50.0, 600.0, 50)], axis=1)
    uv = uv[rng.permutation(50)]
    for text in refused(data, uv=uv):
        assert "all spots lie on one line in the image: the plane goes through the camera" in text


def test_a_beam_that_meets_the_plane_at_the_same_angle_everywhere_is_named():
    normal = np.array([0.0, 0.1, 0.99]) / np.linalg.norm([0.0, 0.1, 0.99])
    motion = np.eye(3) - np.outer(normal, normal)
    with pytest.raises(CalibrationError, match="same angle at every orientation"):
        closed_form.rotation_and_beams([motion, motion, motion], normal)


def test_poses_the_wrong_way_round_are_refused_or_fit_nothing():
    data = scene(orientations=5)
    inverted = np.stack([invert(T) for T in data.base_T_ee])
    with pytest.raises(CalibrationError):
        closed_form.solve(ideal(data), inverted)
