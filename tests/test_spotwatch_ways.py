"""The world of a laser calibration, and the three ways to a spot: Jacobians, and errors as large as claimed."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.laser_scenes import laser_printed
from support.pulsed_laser import calibration, drawn_world, poses, true_world

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import origin_axes, setup_of, spots_on_plane
from gripmon.laser.world import INPUTS, calibrated, disagreements, larger, predict, predict_moved, triangulate, visible
from gripmon.model.geometry import invert, perturb

STEP = 1e-6


def slopes(function, size: int) -> np.ndarray:
    steps = STEP * np.eye(size)
    return np.stack([(function(step) - function(-step)) / (2.0 * STEP) for step in steps], axis=-1)


@pytest.fixture(scope="module")
def known():
    return calibrated(calibration())


@pytest.mark.parametrize("large", [0.0, 0.1, 0.5])
def test_derivatives_of_a_foreseen_spot_also_of_a_world_that_has_moved_far(known, large):
    rng = np.random.default_rng(3)
    change = large * rng.normal(size=13) * np.array([0.1] * 3 + [0.5] * 3 + [0.3, 0.3, 0.1, 0.5, 0.5, 0.1, 0.1])
    pose = poses()[0]
    found = predict_moved(known, change, pose)
    by_change = slopes(lambda step: predict(known.world.moved(change + step), known.camera, pose).uv_px, 13)
    by_arm = slopes(lambda step: predict(known.world.moved(change), known.camera, perturb(pose, step)).uv_px, 6)
    assert np.abs(found.rows - by_change).max() < 1e-6 * np.abs(by_change).max()
    assert np.abs(found.arm_rows - by_arm).max() < 1e-6 * np.abs(by_arm).max()


def test_derivatives_where_the_beam_has_turned_to_another_axis_of_the_hand(known):
    change = np.zeros(13)
    change[9:13] = 0.9, 0.5, 0.01, -0.02
    assert origin_axes(known.world.moved(change).lit.direction_ee) != origin_axes(known.world.lit.direction_ee)
    pose = poses()[0]
    numeric = slopes(lambda step: predict(known.world.moved(change + step), known.camera, pose).uv_px, 13)
    found = predict_moved(known, change, pose)
    assert np.isfinite(numeric).all()
    assert np.abs(found.rows - numeric).max() < 1e-6 * np.abs(numeric).max()


def test_the_base_s_parameters_say_the_same_of_a_spot_as_the_file_s(known):
    """The file has the plane in the camera's frame, and its covariance of that; the spot's must be the same."""
    document = calibration()
    setup = setup_of(document)
    covariance = np.array(document.covariance).reshape(13, 13)
    for pose in poses()[:5]:
        here = predict(known.world, known.camera, pose)
        spots, _ = spots_on_plane(setup, pose[None])
        assert np.allclose(here.uv_px, known.camera.project(spots)[0], atol=1e-9)

        def by_file(step, pose=pose, spots=spots):
            # base_T_cam perturbed in base axes, with the plane fixed to the camera, as the file's parameters are.
            moved = setup.moved(np.r_[np.zeros(6), step[6:]])
            base_T_cam = perturb(invert(setup.cam_T_base), step[:6])
            return known.camera.project(spots_on_plane(type(setup)(invert(base_T_cam), *_rest(moved)), pose[None])[0])[
                0
            ]

        rows = slopes(by_file, 13)
        expected = rows @ covariance @ rows.T
        assert np.allclose(here.rows @ known.covariance @ here.rows.T, expected, rtol=1e-4)


def _rest(setup):
    return setup.normal_cam, setup.distance_m, setup.point_ee_m, setup.direction_ee


def test_the_three_ways_are_those_of_the_calibration_with_derivatives(known):
    setup, pose = setup_of(calibration()), poses()[2]
    uv = predict(known.world, known.camera, pose).uv_px + np.array([4.0, -3.0])
    found = triangulate(known.world, known.camera, pose, uv)
    xy = known.camera.undistort(uv[None])
    points = [
        spots_on_plane(setup, pose[None])[0],
        laser_printed.spots_on_rays(setup, xy)[0],
        laser_printed.spots_between(setup, pose[None], xy)[0],
    ]
    base = known.world.base_T_cam
    expected = np.concatenate(points) @ base[:3, :3].T + base[:3, 3]
    assert np.allclose(found.spots_base_m, expected, atol=1e-12)
    assert np.linalg.norm(found.gap_m) == pytest.approx(
        float(laser_printed.spots_between(setup, pose[None], xy)[1][0]), abs=1e-12
    )

    def again(step):
        return triangulate(known.world.moved(step[:13]), known.camera, perturb(pose, step[15:]), uv + step[13:15])

    assert np.allclose(found.slopes, slopes(lambda step: again(step).spots_base_m, INPUTS), atol=1e-7)
    assert np.allclose(found.gap_slopes, slopes(lambda step: again(step).gap_m, INPUTS), atol=1e-7)


def test_disagreements_are_as_large_as_they_claim(known):
    """Normalised squares of truths that the covariance allows have their degrees of freedom as their mean."""
    rng = np.random.default_rng(5)
    arm = np.diag(np.square([1e-4] * 3 + [2e-4] * 3))
    covariance = np.zeros((INPUTS, INPUTS))
    covariance[:13, :13], covariance[13:15, 13:15], covariance[15:, 15:] = known.covariance, 0.09 * np.eye(2), arm
    squares = []
    for k in range(400):
        pose = poses()[k % len(poses())]
        real = perturb(pose, np.sqrt(arm.diagonal()) * rng.normal(size=6))
        uv = predict(drawn_world(known, rng), known.camera, real).uv_px + rng.normal(0.0, 0.3, 2)
        found = disagreements(triangulate(known.world, known.camera, pose, uv), covariance)
        assert [d.freedom for d in found] == [2, 2, 1, 1]
        squares.append([d.square for d in found])
    mean = np.mean(squares, axis=0)
    # The mean of 400 squares with k degrees of freedom scatters by sqrt(2 k / 400): four of these.
    assert np.all(np.abs(mean - [2, 2, 1, 1]) < 4.0 * np.sqrt(2.0 * np.array([2, 2, 1, 1]) / 400))


def test_what_did_not_move_still_agrees(known):
    """The plane moved: beam and ray still meet.  The pointer moved: ray and plane are where they were."""
    pose = poses()[4]
    plane, camera = np.zeros(13), np.zeros(13)
    plane[8], camera[:3] = 5e-3, 5e-3
    gaps = {}
    for name, change in (("plane", plane), ("camera", camera)):
        uv = predict(known.world.moved(change), known.camera, pose).uv_px
        found = triangulate(known.world, known.camera, pose, uv)
        gaps[name] = float(np.linalg.norm(found.gap_m))
        spots = found.spots_base_m
        if name == "plane":
            moved = predict(known.world.moved(change), known.camera, pose).spot_base_m
            assert np.allclose(spots[2], moved, atol=1e-9), "beam and ray find the spot without the plane"
    assert gaps["plane"] < 1e-9
    assert gaps["camera"] > 1e-3


def test_beams_along_the_plane_and_spots_behind_the_camera_are_not_foreseen(known):
    arm = np.zeros((6, 6))
    lit = known.world.lit
    along = np.cross(lit.normal_cam, [0.3, 0.5, 0.8])
    along /= np.linalg.norm(along)
    for beam, why in ((along, "runs along the plane"), (along + 0.004 * lit.normal_cam, "nearly runs along the plane")):
        beam = beam / np.linalg.norm(beam)
        turn = _turn(lit.direction_ee, beam)
        pose = np.eye(4)
        pose[:3, :3] = turn
        spot = predict(known.world, known.camera, poses()[0]).spot_base_m
        pose[:3, 3] = spot - 0.3 * beam - turn @ lit.point_ee_m
        if why == "runs along the plane":
            pose[:3, 3] += 0.01 * lit.normal_cam
        assert why in visible(known, predict(known.world, known.camera, pose), arm)
    beyond = np.zeros(13)
    beyond[:3] = 2.0 * known.world.base_T_cam[:3, 2]
    behind = predict(known.world.moved(beyond), known.camera, poses()[0])
    assert "behind the camera" in visible(known, behind, arm)


def _turn(from_direction, to_direction):
    from scipy.spatial.transform import Rotation

    return Rotation.align_vectors([to_direction], [from_direction])[0].as_matrix()


def test_the_larger_of_two_covariances_is_nowhere_below_either():
    rng = np.random.default_rng(2)
    for _ in range(20):
        a, b = (m @ m.T + 1e-3 * np.eye(2) for m in rng.normal(size=(2, 2, 2)))
        out = larger(a, b)
        assert np.linalg.eigvalsh(out - a)[0] > -1e-9 and np.linalg.eigvalsh(out - b)[0] > -1e-9
        assert abs(np.linalg.eigvalsh(out - a)[0] * np.linalg.eigvalsh(out - b)[0]) < 1e-9, "and touches them"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: msgspec.structs.replace(d, covariance=tuple(np.diag([-1.0] * 13).ravel())), "is none"),
        (lambda d: msgspec.structs.replace(d, covariance=d.covariance[:-1]), "not that of"),
        (
            lambda d: msgspec.structs.replace(d, laser=msgspec.structs.replace(d.laser, direction_ee=(0, 0, 3))),
            "length 3",
        ),
    ],
)
def test_files_whose_numbers_make_no_set_up_are_refused(change, said):
    with pytest.raises(CalibrationError, match=said):
        calibrated(change(calibration()))


def test_the_calibration_is_near_its_truth(known):
    """Of the tests' own scene: what is foreseen is where the truth has it, within what is claimed."""
    squares = []
    for pose in poses()[:40]:
        here, there = predict(known.world, known.camera, pose), predict(true_world(), known.camera, pose)
        off = there.uv_px - here.uv_px
        squares.append(off @ np.linalg.solve(here.rows @ known.covariance @ here.rows.T, off))
    assert np.mean(squares) < 8.0
