"""The padded fingers of ``tools/bench integrity``: the file that the monitor gets is of the bodies that are shown."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


def test_the_file_has_the_sizes_that_are_said():
    from benchmarks.padded import padded_model, padded_solids

    shown = {name: np.array(point.xyz_m) for name, point in padded_solids().model.points.items()}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pad, body = (
            np.array([xyz for name, xyz in shown.items() if name.rsplit(" ", 1)[0] == part])
            for part in (f"{side} pad", side)
        )
        assert np.ptp(pad, axis=0) == pytest.approx([0.002, 0.010, 0.024])
        assert (sign * pad[:, 0]).min() == pytest.approx(0.020)  # half of the nominal opening
        for z_m, width_m, thick_m in ((0.0, 0.006, 0.012), (-0.060, 0.014, 0.016)):
            end = body[np.isclose(body[:, 2], z_m)]
            assert np.ptp(end[:, :2], axis=0) == pytest.approx([width_m, thick_m])
    # Every point of the file is one of the bodies' corners, or lies on one of their edges.
    bodies = padded_solids()
    start, end = (bodies.points_grip_m(None)[bodies.edge_points[:, k]] for k in range(2))
    for name, point in padded_model().model.points.items():
        along = end - start
        share = np.clip(((point.xyz_m - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
        off_m = np.linalg.norm(start + share[:, None] * along - point.xyz_m, axis=1).min()
        assert off_m < 1e-12, name


def test_both_move_alike_with_the_jaws():
    from benchmarks.padded import padded_model, padded_solids

    for opening_m in (0.026, 0.05):
        for gripper in (padded_model(), padded_solids()):
            way = gripper.points_grip_m(opening_m) - gripper.points_grip_m(None)
            for finger, name in enumerate(gripper.finger_ids):
                sign = -1.0 if name.startswith("left") else 1.0
                own = way[gripper.point_finger == finger]
                assert own == pytest.approx(np.tile([0.5 * sign * (opening_m - 0.04), 0.0, 0.0], (len(own), 1)))


def test_its_picture_has_the_edges_where_the_file_says():
    """The steepest change of grey across each edge of the file, in its middle, within the chamfers (0.1 mm: 1 px)."""
    from benchmarks import padded

    from gripmon.model.camera import make_camera
    from gripmon.model.geometry import exp_rotation, make_transform
    from gripmon.simulate import Scenario, Simulator
    from gripmon.simulate.scenario import Background, FingerLook, Sensor

    camera = make_camera(padded.LENS)
    cam_T_grip = make_transform(exp_rotation(np.deg2rad([38.0, 0.0, 0.0])), np.array([0.0, 0.0, 0.09]))
    scenario = Scenario(
        background=Background(kind="plain", contrast=0.0, level_dn=220.0, boxes=0, cables=0, motion="still"),
        fingers=FingerLook(texture=0.0, carriers=False, marks=padded.PADS),
        sensor=Sensor(read_noise_dn=0.0, shot_noise_dn=0.0, vignetting=0.0, exposure_time_s=0.0),
    )
    light = Simulator(camera, padded.padded_solids(), cam_T_grip, scenario).light(0)
    model = padded.padded_model()
    points_m = model.points_grip_m(None) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    checked = 0
    for name, (a, b) in zip(model.edge_ids, model.edge_points, strict=True):
        ends = camera.project(np.linspace(points_m[a], points_m[b], 41))
        inside = ((ends > 20.0) & (ends < (1259.0, 699.0))).all(axis=1)
        if inside.sum() < 5:
            continue
        middle, ahead = ends[inside][inside.sum() // 2], np.diff(ends[inside], axis=0).mean(axis=0)
        across = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
        offsets_px = np.linspace(-6.0, 6.0, 121)
        u, v = (middle + offsets_px[:, None] * across).T
        left, top = np.floor(u).astype(int), np.floor(v).astype(int)
        du, dv = u - left, v - top
        grey = (1 - dv) * ((1 - du) * light[top, left] + du * light[top, left + 1])
        grey += dv * ((1 - du) * light[top + 1, left] + du * light[top + 1, left + 1])
        assert abs(offsets_px[np.abs(np.gradient(grey)).argmax()]) < 1.5, name
        checked += 1
    assert checked == len(model.edge_ids)
