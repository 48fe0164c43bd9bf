"""Planned poses keep the spot in view and help more than others: as foretold, and in simulated calibrations."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from support.laser_scenes import paper_setup, sampled
from test_laser_command import calibrate, camera, rows_of, scene, write_csv  # noqa: F401 - camera is a fixture

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.planning import SEED, candidates, plan
from gripmon.laser.refinement import SpotProblem, refine
from gripmon.laser.setup import COUNT, in_camera, spots_in_camera, spots_on_plane
from gripmon.model.geometry import perturbation_between


def calibrated(seed, orientations=4):
    rng = np.random.default_rng(seed)
    data = sampled(paper_setup(rng), rng, orientations=orientations)
    uv = data.uv_px + rng.normal(0.0, 0.5, data.uv_px.shape)
    return data, uv, refine(SpotProblem(data.camera, data.base_T_ee, uv), data.truth)


def project(data, base_T_ee):
    return data.camera.project(in_camera(data.truth, spots_on_plane(data.truth, base_T_ee)))


def test_planned_poses_are_within_reach_and_their_spots_in_view():
    data, _, refined = calibrated(1)
    planned = plan(refined, 0.8, 12)
    assert planned.base_T_ee.shape == (12, 4, 4)
    assert (np.linalg.norm(planned.base_T_ee[:, :3, 3], axis=1) <= 0.8).all()
    rotations = planned.base_T_ee[:, :3, :3]
    assert np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
    # At the true set-up, too, which the plan doesn't know.
    uv = project(data, planned.base_T_ee)
    assert np.abs(uv - planned.uv_px).max() < 10.0
    assert (uv > 0.0).all() and (uv < [639.0, 479.0]).all()


def test_what_is_foretold_is_what_a_calibration_with_these_poses_says():
    data, _, refined = calibrated(2)
    planned = plan(refined, 1.0, 10)
    assert (np.diff(planned.sigmas[:, 0] ** 2 + (0.55 * planned.sigmas[:, 1]) ** 2) < 0.0).all()
    poses = np.concatenate([data.base_T_ee, planned.base_T_ee])
    exact = project(data, poses)
    rng = np.random.default_rng(3)
    again = refine(SpotProblem(data.camera, poses, exact + rng.normal(0.0, refined.scale, exact.shape)), data.truth)
    sigma = np.sqrt(np.trace(again.covariance[:3, :3]))
    assert sigma == pytest.approx(planned.sigmas[-1, 0], rel=0.35)


def test_the_first_pose_helps_a_point_at_the_plane_s_distance_most():
    """Position and rotation of the camera together; by the information of all spots, not step by step."""
    data, _, refined = calibrated(0)
    first = plan(refined, 0.8, 1).base_T_ee
    poses = np.concatenate([first, candidates(refined.setup, data.camera, 0.8, np.random.default_rng(SEED))])
    spots, slopes = spots_in_camera(refined.setup, poses)
    rows = (data.camera.project_with_jacobian(spots)[1] @ slopes)[:, :, :COUNT] / refined.scale
    after = np.linalg.inv(np.linalg.inv(refined.covariance) + rows.transpose(0, 2, 1) @ rows).diagonal(axis1=1, axis2=2)
    left = after[:, :3].sum(axis=1) + refined.setup.distance_cam_m**2 * after[:, 3:6].sum(axis=1)
    assert left[0] <= left.min() * (1.0 + 1e-6)


def test_planned_poses_help_more_than_random_ones():
    errors = {"planned": [], "random": []}
    for seed in range(15):
        data, uv, refined = calibrated(seed)
        rng = np.random.default_rng(seed + 100)
        drawn = candidates(refined.setup, data.camera, 1.0, rng)
        for name, more in (
            ("planned", plan(refined, 1.0, 8).base_T_ee),
            ("random", drawn[rng.permutation(len(drawn))[:8]]),
        ):
            spots = project(data, more)
            seen = np.concatenate([uv, spots + rng.normal(0.0, 0.5, spots.shape)])
            poses = np.concatenate([data.base_T_ee, more])
            found = refine(SpotProblem(data.camera, poses, seen), refined.setup)
            errors[name].append(perturbation_between(found.setup.base_T_cam, data.truth.base_T_cam)[:3])
    planned, drawn = (np.sqrt(np.mean(np.square(errors[name]))) for name in ("planned", "random"))
    assert planned < 0.8 * drawn


def test_an_arm_that_reaches_nothing_is_told():
    _, _, refined = calibrated(1)
    with pytest.raises(CalibrationError, match="no pose whose spot the camera would see; a longer reach"):
        plan(refined, 0.01, 3)


def test_the_command_writes_a_plan(tmp_path, camera, capsys):  # noqa: F811
    data, uv = scene()
    table = write_csv(tmp_path / "spots.csv", rows_of(data, uv))
    out, planned = tmp_path / "laser.yaml", tmp_path / "next.csv"
    assert calibrate(table, "--camera", camera, "--out", out, "--plan", planned, "--poses", 6, "--reach", 0.9) == 0
    rows = list(csv.DictReader(planned.open()))
    assert len(rows) == 6
    for row in rows:
        assert np.linalg.norm([float(row[k]) for k in ("tx_m", "ty_m", "tz_m")]) <= 0.9
        assert np.linalg.norm([float(row[k]) for k in ("qx", "qy", "qz", "qw")]) == pytest.approx(1.0)
        assert 0.0 < float(row["expected_u_px"]) < 640.0
    assert "after 6 more" in capsys.readouterr().out
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "b.yaml", "--plan", tmp_path / "b.csv") == 2
    assert "--plan needs --reach" in capsys.readouterr().err
