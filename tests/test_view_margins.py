"""How far camera and jaws may move until too little is in view: against brute force by other means."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.configurations import shipped
from support.meters import box_gripper, moved
from support.simulated import STRONG_LENS, nominal_cam_T_grip

from gripmon.cli import main
from gripmon.daemon.config import builtin_config
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.monitor import MonitorSettings
from gripmon.teach.jaw_travel import over_jaw
from gripmon.teach.visibility import (
    Freedom,
    Rig,
    behind_another_finger,
    border,
    freedom,
    moved_camera,
    see,
)
from gripmon.track.edges.prediction import BORDER_PX, lay_out

NEAR = nominal_cam_T_grip(tcp_m=(0.008, -0.003, 0.046))  # so near that open jaws leave the image


def rig(lens: LensSettings = STRONG_LENS) -> Rig:
    return Rig(make_camera(lens), box_gripper(), MonitorSettings())


def pixels_by_opencv(lens: LensSettings, points_cam_m: np.ndarray) -> np.ndarray:
    matrix = np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])
    return cv2.projectPoints(points_cam_m, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0][:, 0]


def triangles(gripper: Gripper, points_m: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Finger and corners of every face's fan of triangles."""
    return [
        (face.finger, points_m[[face.points[0], face.points[i], face.points[i + 1]]])
        for face in gripper.faces
        for i in range(1, len(face.points) - 1)
    ]


def share_to_triangle(eye: np.ndarray, target: np.ndarray, corners: np.ndarray) -> float:
    """Where on the way from eye to target a triangle is hit, by Möller and Trumbore; NaN if it isn't."""
    e1, e2, ray = corners[1] - corners[0], corners[2] - corners[0], target - eye
    p = np.cross(ray, e2)
    det = e1 @ p
    if abs(det) < 1e-15:
        return np.nan
    s = (eye - corners[0]) / det
    q = np.cross(s, e1)
    u, v = s @ p, ray @ q
    return float(e2 @ q) if u >= 0.0 and v >= 0.0 and u + v <= 1.0 else np.nan


def enough_by_brute_force(lens: LensSettings, gripper: Gripper, cam_T_grip: np.ndarray, opening_m: float) -> bool:
    """Corners by OpenCV and rays through every triangle of the gripper; edges by the monitor's own layout."""
    points_m = gripper.points_grip_m(opening_m)
    corners_m = points_m[gripper.corner_points]
    cam_m = corners_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    uv_px = pixels_by_opencv(lens, cam_m)
    last_px = np.array([lens.width_px - 1, lens.height_px - 1])
    inside = ((uv_px >= BORDER_PX) & (uv_px <= last_px - BORDER_PX)).all(axis=1) & (cam_m[:, 2] > 0.0)
    eye = -cam_T_grip[:3, :3].T @ cam_T_grip[:3, 3]
    soup = [corners for _, corners in triangles(gripper, points_m)]
    seen = 0
    for target in corners_m[inside]:
        hits = [share_to_triangle(eye, target, corners) for corners in soup]
        seen += not any(h < 1.0 - 1e-4 for h in hits if np.isfinite(h) and h > 0.0)
    layout = lay_out(make_camera(lens), gripper, cam_T_grip, opening_m, MonitorSettings().corners.sampling)
    return seen >= 3 and len(layout.edges) >= 3


def test_points_behind_another_finger_are_those_whose_ray_meets_a_triangle_of_it():
    gripper, rng = box_gripper(), np.random.default_rng(4)
    points_m = gripper.points_grip_m(0.020)
    soup, found = triangles(gripper, points_m), 0
    targets_m = rng.uniform(points_m.min(axis=0), points_m.max(axis=0), (60, 3))
    finger = rng.integers(0, len(gripper.finger_ids), len(targets_m))
    for eye in rng.normal(size=(12, 3)):
        eye_m = 0.1 * eye / np.linalg.norm(eye)
        hidden = behind_another_finger(gripper, points_m, eye_m, targets_m, finger)
        for k, target in enumerate(targets_m):
            hits = [share_to_triangle(eye_m, target, corners) for f, corners in soup if f != finger[k]]
            depth_m = (1.0 - np.nanmin([*hits, np.nan, 1.0])) * np.linalg.norm(target - eye_m)
            if abs(depth_m - 1e-4) > 1e-6:  # not on the very limit of what counts as touching
                assert hidden[k] == (depth_m > 1e-4), (eye_m, target)
        found += np.count_nonzero(hidden)
    assert 50 < found < 0.8 * 12 * len(targets_m)


def test_the_border_is_that_of_the_corner_nearest_to_it():
    seen = see(rig(), nominal_cam_T_grip(tcp_m=(0.02, 0.004, 0.115)), 0.034)
    nearest = border(rig(), seen)
    distances = {
        (name, side): distance
        for name, (u, v), visible in zip(box_gripper().corner_ids, seen.uv_px, seen.visible, strict=True)
        if visible
        for side, distance in (("left", u), ("right", 767.0 - u), ("top", v), ("bottom", 575.0 - v))
    }
    assert (nearest.corner, nearest.side) == min(distances, key=distances.__getitem__)
    assert nearest.smallest_px == min(distances.values())
    assert nearest.side == "right"


def limits_of(free: Freedom) -> np.ndarray:
    """(6, 2), NaN where nothing was found."""
    return np.array([*free.shift_m.values(), *free.turn_rad.values()], dtype=float)


@pytest.mark.parametrize(("axis", "step"), [(0, 2e-4), (2, 1e-3), (4, 2e-3)])
def test_the_camera_may_move_until_it_happens(axis: int, step: float):
    """The camera is moved on in small steps until fewer than three corners, or edges, are left."""
    limits = limits_of(freedom(rig(), nominal_cam_T_grip(), 0.034))
    for k, sign in enumerate((-1.0, 1.0)):
        if np.isnan(limits[axis, k]):
            assert axis == 2 and sign < 0.0, "only backwards nothing leaves the image"
            continue
        # Every step up to the limit would take long: the last ones before it, some in between, and the first beyond.
        amounts = np.concatenate(
            [np.arange(0.0, limits[axis, k] - step, 12.0 * step), limits[axis, k] - [step, 0.1 * step]]
        )
        for amount in amounts:
            pose = moved_camera(nominal_cam_T_grip(), sign * amount * np.eye(6)[axis])
            assert enough_by_brute_force(STRONG_LENS, box_gripper(), pose, 0.034), amount
        beyond = moved_camera(nominal_cam_T_grip(), sign * (limits[axis, k] + 0.1 * step) * np.eye(6)[axis])
        assert not enough_by_brute_force(STRONG_LENS, box_gripper(), beyond, 0.034)


def test_the_share_of_the_jaws_travel_is_counted_in_small_steps():
    travel = over_jaw(rig(), NEAR)
    openings_m = np.linspace(0.0, 0.060, 301)
    counted = [enough_by_brute_force(STRONG_LENS, box_gripper(), NEAR, o) for o in openings_m.tolist()]
    assert 0.2 < travel.share < 0.98
    assert travel.share == pytest.approx(np.mean(counted), abs=2.0 / 300.0)
    for opening_m, good in zip(openings_m, counted, strict=True):
        inside = any(gap.from_m - 1e-4 <= opening_m <= gap.to_m + 1e-4 for gap in travel.gaps)
        assert good or inside
    assert any("outside of the image" in gap.reason for gap in travel.gaps)


def test_a_gripper_in_no_image_has_neither_border_nor_freedom():
    away = moved(nominal_cam_T_grip(), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    seen = see(rig(), away, 0.034)
    assert not seen.enough and border(rig(), seen) is None
    assert seen.reason == "0 corners visible (8 outside of the image)"
    assert (limits_of(freedom(rig(), away, 0.034)) == 0.0).all()
    travel = over_jaw(rig(), away)
    assert travel.share == 0.0 and len(travel.gaps) == 1


# --- the command ---


def test_check_tells_the_margins(capsys: pytest.CaptureFixture[str]):
    path = str(builtin_config("demo.yaml"))
    assert main(["check", path, "--verbose"]) == 0
    text = capsys.readouterr().out
    assert main(["check", path, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)["in_view"]
    assert values["enough"] and values["corners"] == 6
    may = values["camera_may_move"]
    assert may["shift_m"]["z"][0] is None and may["turn_rad"]["z"] == [None, None]
    assert f"too few once the camera shifts by {1e3 * min(may['shift_m']['y']):.1f} mm" in text
    travel = values["jaw_travel"]
    assert (travel["share"], travel["corners"], travel["edges"]) == (1.0, [4, 6], [5, 8])
    certainty = travel["certainty"]
    assert certainty["worst_sigma_m"] == sorted(certainty["worst_sigma_m"], reverse=True), "least certain when closed"
    assert certainty["alert_limit_m"] == 1e-3
    short = [bound_m > 1e-3 for bound_m in certainty["protection_m"]]
    assert ("every transform is suspect" in text) == any(short) and not all(short)


def test_check_says_where_the_jaws_leave_the_view_and_when_the_margin_is_small(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "near.yaml"
    path.write_text(shipped("demo.yaml", ("[0.0004, 0.0014, 0.1188]", "[0.012, 0.0014, 0.06]")))
    assert main(["check", str(path), "--verbose"]) == 0
    said = capsys.readouterr().out
    assert "nothing can be measured from" in said and "outside of the image" in said
    assert "less than the shift" not in said
    path.write_text(path.read_text().replace("monitor:\n", "monitor:\n  policy: {limit_m: 0.1}\n", 1))
    assert main(["check", str(path), "--verbose"]) == 0
    assert "less than the shift that leads to a recalibration, 100 mm" in capsys.readouterr().out
