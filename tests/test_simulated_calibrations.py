"""What the off-line calibrations start from, held against OpenCV, plain projection and by-hand geometry: nothing of
gripmon's own detection takes part.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support import new_user
from support.simulated import BOX_FINGERS

from gripmon.cli import main
from gripmon.model.camera import BrownConradyLens, make_camera
from gripmon.model.targets import Charuco, Chequerboard, CircleGrid
from gripmon.simulate import CALIBRATION_KINDS, image_count
from gripmon.simulate.laser import paper_cell, poses_on_plane, spot_image, spots_cam_m
from gripmon.simulate.plates import Plate, Print, facing, points_of

PINHOLE = BrownConradyLens(width_px=640, height_px=480, fx_px=800.0, fy_px=800.0, cx_px=319.5, cy_px=239.5)
BOARD = Charuco(8, 6, 0.03, 0.022, "DICT_4X4_250")


def shown(target, cam_T_plate, lens=PINHOLE, **look):
    return Plate(target, cam_T_plate, Print(clutter="plain", **look)).light(lens, 0.6)


def test_discs_have_their_size_and_their_places():
    target = CircleGrid(8, 6, 0.02, 0.01)
    cam_T_plate = facing(target, (0.003, -0.002, 0.4), (0.0, 0.0), 0.3)  # parallel to the image: discs stay discs
    dark = (200.0 - shown(target, cam_T_plate, margin=np.inf)) / 160.0
    points = points_of(target) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    for u, v in PINHOLE.fx_px * points[:, :2] / points[:, 2:] + [PINHOLE.cx_px, PINHOLE.cy_px]:
        left, top = round(u) - 18, round(v) - 18
        window = dark[top : top + 37, left : left + 37]
        rows, columns = np.mgrid[top : top + 37, left : left + 37]
        area = window.sum()
        assert area == pytest.approx(np.pi * 10.0**2, rel=2e-3)  # 5 mm are 10 px here
        assert abs((columns * window).sum() / area - u) < 4e-3 and abs((rows * window).sum() / area - v) < 4e-3


def test_squares_have_their_corners_where_opencv_finds_them():
    target = Chequerboard(8, 6, 0.02)
    cam_T_plate = facing(target, (0.01, 0.0, 0.35), (0.3, -0.2), 0.1)
    image = shown(target, cam_T_plate).astype(np.uint8)
    points = points_of(target) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    true = (PINHOLE.fx_px * points[:, :2] / points[:, 2:] + [PINHOLE.cx_px, PINHOLE.cy_px]).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    found = cv2.cornerSubPix(image, true.reshape(-1, 1, 2) + 1.0, (7, 7), (-1, -1), stop).reshape(-1, 2)
    assert np.abs(found - true).max() < 0.05
    # The first square, whose inner corner is point 0, is dark; an outer light square has no line towards the margin.
    assert image[tuple(np.rint(true[[0, 1, 8, 9]].mean(axis=0)).astype(int)[::-1])] == pytest.approx(40, abs=2)


def test_marks_are_read_by_opencv_with_their_corners():
    cam_T_plate = facing(BOARD, (0.0, 0.0, 0.4), (0.3, 0.2), 0.4)
    image = shown(BOARD, cam_T_plate).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, dictionary)
    corners, ids, _, marks = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert len(ids) == 35 and sorted(np.ravel(marks).tolist()) == list(range(24))
    points = board.getChessboardCorners()[ids.ravel()] @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    true = PINHOLE.fx_px * points[:, :2] / points[:, 2:] + [PINHOLE.cx_px, PINHOLE.cy_px]
    assert np.abs(np.reshape(corners, (-1, 2)) - true).max() < 0.3


def test_spots_lie_on_the_plane_and_on_the_beam():
    rng = np.random.default_rng(3)
    cell, camera = paper_cell(rng), make_camera(PINHOLE)
    base_T_ee, group = poses_on_plane(cell, camera, rng, orientations=3, border_px=15.0)
    assert np.bincount(group).tolist() == [10, 10, 10]
    for pose, spot in zip(base_T_ee, spots_cam_m(cell, base_T_ee), strict=True):
        assert spot @ cell.normal_cam == pytest.approx(cell.distance_m, abs=1e-12)
        start, ahead = (cell.cam_T_base @ pose @ [*(cell.point_ee_m + s * cell.direction_ee), 1.0] for s in (0.0, 1.0))
        beam, way = (ahead - start)[:3], spot - start[:3]
        assert np.abs(np.cross(beam, way)).max() < 1e-12 and beam @ way > 0.0
        u, v = PINHOLE.fx_px * spot[:2] / spot[2] + [PINHOLE.cx_px, PINHOLE.cy_px]
        assert 15.0 < u < 624.0 and 15.0 < v < 464.0
    image = spot_image(np.array([100.25, 60.75]), rng, noise=0.0).astype(float) - 30.0
    rows, columns = np.indices(image.shape)
    assert (columns * image).sum() / image.sum() == pytest.approx(100.25, abs=0.01)
    assert (rows * image).sum() / image.sum() == pytest.approx(60.75, abs=0.01)
    assert spot_image(None, rng, noise=0.0).max() == 30


def test_a_folder_has_images_tables_and_truth_and_is_the_same_again(tmp_path: Path):
    for name in ("one", "two"):
        assert main(["simulate", "standing", "--out", str(tmp_path / name), "--seed", "3"]) == 0
    one, two = (sorted((tmp_path / name).iterdir()) for name in ("one", "two"))
    assert [p.name for p in one] == ["0.png", "1.png", "2.png", "rough.yaml", "truth.json"]
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]
    truth = json.loads((tmp_path / "one" / "truth.json").read_text())
    assert len(truth["images"]) == image_count("standing") == 3
    rough = yaml.safe_load((tmp_path / "one" / "rough.yaml").read_text())["corners"]
    assert set(rough) == set(truth["corners"])
    assert all(np.abs(np.subtract(at, truth["corners"][name])).max() < 4.1 for name, at in rough.items())


def test_robot_poses_and_images_fit_together_but_for_the_arms_noise(tmp_path: Path):
    new_user.simulate(tmp_path, "robot_world")
    tmp_path = tmp_path / "robot_world"
    truth = json.loads((tmp_path / "truth.json").read_text())
    with (tmp_path / "views.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    off_m = []
    for row, view in zip(rows, truth["images"], strict=True):
        assert row["image"] == view["file"] and (tmp_path / row["image"]).exists()
        base_T_ee = np.array(truth["base_T_target"]) @ np.linalg.inv(view["cam_T_target"]) @ truth["cam_T_ee"]
        off_m.append([float(row[f"t{axis}_m"]) for axis in "xyz"] - base_T_ee[:3, 3])
    assert 2.5e-5 < np.std(off_m) < 1e-4
    assert np.linalg.norm(np.array(off_m), axis=1).max() < 3e-4
    grip = np.array(truth["cam_T_ee"]) @ truth["ee_T_grip"]
    np.testing.assert_allclose(grip, truth["cam_T_grip"], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["plate", "--fps", "3"], "plate is single images; neither --seconds nor --fps"),
        (["spot"], "there is no 'spot'; one of demo,"),
        (["standing", "--config", "adaptive"], "two fingertips"),
    ],
)
def test_what_cannot_be_made_is_one_line(tmp_path: Path, arguments: list[str], said: str, capsys):
    if "adaptive" in arguments:
        arguments = [a.replace("adaptive", str(one_finger(tmp_path))) for a in arguments]
    assert main(["simulate", *arguments, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not list((tmp_path / "out").glob("*.png"))


def test_all_kinds_are_listed(capsys):
    assert main(["simulate", "--list"]) == 0
    assert {"work", *CALIBRATION_KINDS} <= set(capsys.readouterr().out.split())


def one_finger(folder: Path) -> Path:
    """The demo's configuration with the right finger 5 mm shorter: it stands on one finger."""
    model = yaml.safe_load(BOX_FINGERS.read_text())
    for point in model["points"].values():
        if point["finger"] == "right" and point["xyz_m"][2] == 0.0:
            point["xyz_m"][2] = -0.005
    (folder / "gripper.yaml").write_text(yaml.safe_dump(model))
    config = yaml.safe_load((BOX_FINGERS.parents[1] / "demo.yaml").read_text())
    config["gripper"] = str(folder / "gripper.yaml")
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder / "config.yaml"
