"""``gripmon calibrate robot-world`` from rendered images of a ChArUco board on the hand."""

from __future__ import annotations

import csv

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.plates import pose, render
from test_robot_world import columns, transform

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.detection import by_colours, detect
from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
from gripmon.calibrate.grey_levels import to_grey
from gripmon.calibrate.plate_pose import plate_pose, pose_slopes
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.tables import target_pose
from gripmon.cli import main
from gripmon.model.camera import BrownConradyLens, make_camera
from gripmon.model.geometry import invert, perturbation_between
from gripmon.model.provenance import provenance_of
from gripmon.model.targets import parse_target
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.plates import points_of

LENS = BrownConradyLens(width_px=640, height_px=480, fx_px=700.0, fy_px=700.0, cx_px=320.0, cy_px=240.0)
TARGET = "charuco:8x6:0.03:0.022:DICT_4X4_250"


def test_images_of_a_board_become_both_transforms(tmp_path, capsys):
    rng = np.random.default_rng(2)
    cam_T_base, ee_T_target = transform(rng), transform(rng, 0.1)
    rows = []
    for k in range(6):
        tilt = rng.uniform(-0.5, 0.5, 2)
        seen = pose(parse_target(TARGET), [*rng.uniform(-0.03, 0.03, 2), 0.5], tilt, rng.uniform(-0.5, 0.5))
        cv2.imwrite(str(tmp_path / f"{k}.png"), render(LENS, seen, parse_target(TARGET), seed=k))
        rows.append({"image": f"{k}.png", **columns("", invert(cam_T_base) @ seen @ invert(ee_T_target))})
    with (tmp_path / "views.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    calibration = CameraCalibration(
        camera=LENS,
        parameters=(),
        covariance=(),
        residuals=CameraResiduals(rms_px=0.1, views=1, points=4, outliers=0),
        target=TARGET,
        provenance=provenance_of("test"),
    )
    (tmp_path / "camera.yaml").write_text(as_yaml(msgspec.to_builtins(calibration)))
    out = tmp_path / "rw.yaml"
    command = ["calibrate", "robot-world", str(tmp_path / "views.csv"), "--camera", str(tmp_path / "camera.yaml")]
    assert main([*command, "--target", TARGET, "--out", str(out)]) == 0
    written = yaml.safe_load(out.read_text())
    for name, truth in (("cam_T_base", cam_T_base), ("ee_T_target", ee_T_target)):
        error = np.array(written["transforms"][name]["translation_m"]) - truth[:3, 3]
        sigmas = np.array([written["sigmas"][f"{name}.{axis}_m"] for axis in "xyz"])
        assert (np.abs(error) < 6.0 * sigmas + 1e-4).all()
        assert np.abs(error).max() < 3e-3
    assert len(written["provenance"]["inputs"]) == 8
    for k in range(6):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((480, 640), 128, np.uint8))
        again = [*command, "--target", TARGET, "--out", str(tmp_path / f"without{k}.yaml")]
        if k == 0:
            assert main(again) == 0
            assert "0.png: " in capsys.readouterr().err
            assert yaml.safe_load((tmp_path / "without0.yaml").read_text())["residuals"]["poses"] == 5
    assert main(again) == 3
    assert "none of 6 images shows the target" in capsys.readouterr().err
    assert not (tmp_path / "without5.yaml").exists()
    for target in ("chequerboard:8x6:0.03", "circles:8x8:0.008:0.004"):  # the same after half a turn
        assert main([*command, "--target", target, "--out", str(tmp_path / "no.yaml")]) == 2
        assert "doesn't tell which way up" in capsys.readouterr().err
    twice = [*command, "--target", "charuco:8x6:0.06:0.044", "--out", str(tmp_path / "no.yaml")]
    assert main(twice) == 2
    assert f"the camera was calibrated with {TARGET}, the same pattern in another size" in capsys.readouterr().err
    assert main([*twice, "--other-target"]) == 3, "these images show nothing"
    assert not (tmp_path / "no.yaml").exists()


def test_what_the_camera_s_errors_do_to_a_target_s_pose_is_what_other_cameras_give():
    target = parse_target("chequerboard:9x6:0.025")
    true = pose(target, [0.02, -0.01, 0.45], [0.4, -0.3], 0.2)
    plate_m = points_of(target)
    uv_px = make_camera(LENS).project(plate_m @ true[:3, :3].T + true[:3, 3])
    uv_px = uv_px + np.random.default_rng(3).normal(0.0, 0.1, uv_px.shape)
    count = len(plate_m)
    seen = Sighting(uv_px, plate_m, np.tile(0.01 * np.eye(2), (count, 1, 1)), (640, 480))
    sigmas = np.array([1.0, 0.5, 0.5])
    names = ("fx_px", "cx_px", "coefficients.0")  # fy follows fx
    given = GivenCamera(LENS, names, np.diag(np.square(sigmas * [1.0, 1.0, 0.01])))
    found = pose_slopes(given, seen, plate_pose(LENS, seen)[0])
    by_camera = np.empty((6, 3))
    for k, change in enumerate(0.05 * sigmas):
        values = {name: getattr(LENS, name) for name in ("fx_px", "fy_px", "cx_px")}
        ends = []
        for sign in (-1.0, 1.0):
            moved = dict(values)
            coefficients = (0.0, 0.0, 0.0, 0.0)
            if k == 0:
                moved |= {"fx_px": 700.0 + sign * change, "fy_px": 700.0 + sign * change}
            elif k == 1:
                moved |= {"cx_px": 320.0 + sign * change}
            else:
                coefficients = (sign * 0.01 * change, 0.0, 0.0, 0.0)
            lens = BrownConradyLens(width_px=640, height_px=480, cy_px=240.0, **moved, coefficients=coefficients)
            ends.append(plate_pose(lens, seen)[0])
        by_camera[:, k] = perturbation_between(*ends) / 0.1
    assert np.allclose(found @ found.T, by_camera @ by_camera.T, rtol=0.02, atol=2e-3 * np.abs(found @ found.T).max())
    assert pose_slopes(GivenCamera(LENS), seen, true).shape == (6, 0)


def test_a_chequerboard_is_turned_by_its_colours():
    target = parse_target("chequerboard:9x6:0.025")
    rng = np.random.default_rng(4)
    turns = []
    for k, roll in enumerate((0.1, 1.7, 3.0, 4.5)):
        true = pose(target, [*rng.uniform(-0.01, 0.01, 2), 0.45], rng.uniform(-0.4, 0.4, 2), roll)
        image = render(LENS, true, target, seed=k)
        sighting, inverted = detect(image, target), detect(255 - image, target)
        assert isinstance(sighting, Sighting) and isinstance(inverted, Sighting)
        found, _, _ = plate_pose(LENS, sighting)
        turns.append(found[:3, :3].T @ true[:3, :3])
        # The board's own frame, or that after half a turn: the same one whichever way up it is in the image.
        assert np.abs(turns[-1] - turns[0]).max() < 0.01
        assert np.abs(np.abs(turns[-1]) - np.eye(3)).max() < 0.01
        assert sighting.turns == inverted.turns == 1
        last = np.linalg.norm(inverted.uv_px - sighting.uv_px[np.argmin(sighting.plate_m.sum(axis=1))], axis=1).argmin()
        assert np.allclose(inverted.plate_m[last], [0.2, 0.125, 0.0])
    image[200:280, 270:370] = 128  # something on the board
    with pytest.raises(CalibrationError, match=r"\d+ of the target's 54 points; all of them, to tell which way up"):
        target_pose(image, GivenCamera(LENS), target)


@pytest.mark.parametrize(
    ("target", "turns"),
    [("chequerboard:7x5:0.03", 2), ("circles:6x6:0.03:0.015", 4), ("circles:7x6:0.03:0.015", 2),
     ("acircles:3x9:0.05:0.018", 1), ("acircles:3x8:0.05:0.018", 2), (TARGET, 1)],
)  # fmt: skip
def test_in_how_many_ways_a_whole_target_looks_the_same(target: str, turns: int):
    known = parse_target(target)
    sight = detect(render(LENS, pose(known, (0.0, 0.0, 0.45), (0.3, -0.2), 0.2), known, seed=1), known)
    assert isinstance(sight, Sighting) and sight.turns == turns
    near = detect(render(LENS, pose(known, (0.04, 0.0, 0.2), (0.3, -0.2), 0.2), known, seed=1), known)
    assert isinstance(near, Sighting) and near.turns == (1 if target == TARGET else 0), "a part of it"


@pytest.mark.parametrize(("contrast_dn", "tells"), [(44, True), (36, False)])
def test_colours_tell_from_a_fifth_of_the_grey_levels_range_on(contrast_dn: int, tells: bool):
    """Of 12 squares 10 are dark or light, one is black and one white, so that they span 200 grey levels."""
    step = 40
    cells = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    image = np.full((240, 280), 100, np.uint8)
    for column, row in np.argwhere(np.indices((4, 3)).sum(axis=0) % 2 == 1).tolist():
        image[60 + step * row : 60 + step * (row + 1), 60 + step * column : 60 + step * (column + 1)] += contrast_dn
    image[60:100, 60:100], image[60:100, 100:140] = 20, 220
    assert (by_colours(to_grey(image), cells, 60.0 + step * cells) is not None) is tells
