"""Golden images with text truth: neither the measurement nor the renderer changes unnoticed.

The images lie in the repository, with camera, gripper, pose, corner pixels and limits as text beside them.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.optimize import brentq
from support.golden_images import FOLDER, SCENES, load, simulator
from support.meters import EVERYWHERE, USUAL_SHARE, difference

from gripmon.model.camera import LensSettings, make_camera
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings

NAMES = sorted(SCENES)


def measured(name: str) -> tuple[Measurement, dict]:
    image, truth, gripper = load(name)
    camera = make_camera(msgspec.convert(truth["camera"], LensSettings))
    meter = FingertipMeter(camera, gripper, MeasurementSettings(), 0.0)
    start = np.array(truth["start_cam_T_grip"])
    return meter.measure(image, start, truth["jaw_opening_m"], USUAL_SHARE, EVERYWHERE), truth


def test_the_folder_holds_these_images_and_nothing_else():
    names = {path.name for path in FOLDER.iterdir()}
    grippers = {f"gripper_{gripper}.yaml" for gripper, *_ in SCENES.values()}
    assert names == {f"{name}.{end}" for name in NAMES for end in ("png", "yaml")} | grippers
    assert all(path.stat().st_size < 60_000 for path in FOLDER.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_image_measures_as_its_text_says(name: str):
    found, truth = measured(name)
    limits = truth["limits"]
    assert found.trusted
    error_um = 1e6 * difference(found.cam_T_grip, np.array(truth["cam_T_grip"]))[:3]
    assert (np.abs(error_um) < limits["tcp_um"]).all(), error_um
    used = dict(zip(truth["corners_uv_px"], found.corners.usable, strict=True))
    assert sum(used.values()) >= limits["corners_at_least"]
    assert not any(used[corner] for corner in truth["hidden_corners"])
    for (corner, true_px), uv_px in zip(truth["corners_uv_px"].items(), found.corners.uv_px, strict=True):
        if used[corner]:
            assert np.linalg.norm(uv_px - true_px) < limits["corner_px"], corner


@pytest.mark.parametrize("name", NAMES)
def test_the_errors_are_within_what_the_measurement_claims(name: str):
    found, truth = measured(name)
    error = difference(found.cam_T_grip, np.array(truth["cam_T_grip"]))
    assert error @ np.linalg.solve(found.covariance[:6, :6], error) < 22.46


def seen_by_opencv(camera: dict, points_cam_m: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points (n, 3) by OpenCV; the paper's lens, which OpenCV lacks, by its equation (4)."""
    matrix = np.array([[camera["fx_px"], 0.0, camera["cx_px"]], [0.0, camera["fy_px"], camera["cy_px"]], [0, 0, 1.0]])
    zero, points = np.zeros(3), points_cam_m[:, None]
    if camera["model"] == "fisheye":
        return cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(camera["coefficients"]))[0][:, 0]
    if camera["model"] == "brown_conrady":
        return cv2.projectPoints(points, zero, zero, matrix, np.array(camera["coefficients"]))[0][:, 0]
    assert camera["model"] == "paper" and camera["fx_px"] == camera["fy_px"]
    ideal_px = camera["fx_px"] * points_cam_m[:, :2] / points_cam_m[:, 2:]
    far_px = np.linalg.norm(ideal_px, axis=1)
    near_px = [brentq(lambda r, far=far: r * (1.0 + camera["kappa_per_px2"] * r**2) - far, 0.0, far) for far in far_px]
    return ideal_px * (near_px / far_px)[:, None] + matrix[:2, 2]


def corners_grip_m(model: dict, jaw_opening_m: float) -> dict[str, np.ndarray]:
    """Fingertip corners of a gripper file, as its text describes them."""
    corners = {}
    for name, point in model["points"].items():
        if point.get("corner"):
            motion = model["fingers"][point["finger"]]["motion"]
            if "axis" in motion:
                way_m = (jaw_opening_m - model["jaw"]["nominal_m"]) * np.array(motion["axis"])
            else:
                table = np.array(motion["table"])
                way_m = np.array([np.interp(jaw_opening_m, table[:, 0], column) for column in table[:, 1:].T])
            corners[name] = point["xyz_m"] + way_m
    return corners


@pytest.mark.parametrize("name", NAMES)
def test_corners_lie_where_another_program_projects_them(name: str):
    """Pose, gripper file and lens put the corners where the text has them, without any of gripmon's cameras."""
    _, truth, _ = load(name)
    model = yaml.safe_load((FOLDER / f"gripper_{truth['gripper']}.yaml").read_text())
    corners = corners_grip_m(model, truth["jaw_opening_m"])
    cam_T_grip = np.array(truth["cam_T_grip"])
    points = np.array(list(corners.values())) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    assert list(truth["corners_uv_px"]) == list(corners)
    np.testing.assert_allclose(
        seen_by_opencv(truth["camera"], points), list(truth["corners_uv_px"].values()), atol=1e-3
    )


@pytest.mark.parametrize("name", NAMES)
def test_the_renderer_still_draws_it(name: str):
    """From the text alone, up to rounding and another JPEG library."""
    image, truth, gripper = load(name)
    made = simulator(truth, gripper)
    drawn = made.render(truth["frame"])
    difference_dn = np.abs(drawn.astype(float) - image)
    assert difference_dn.mean() < 0.5
    assert np.percentile(difference_dn, 99.9) <= 4.0
    known = made.truth(truth["frame"])
    np.testing.assert_allclose(known.cam_T_grip, truth["cam_T_grip"], atol=1e-12)
    assert [i for i, seen in zip(known.corner_ids, known.visible, strict=True) if not seen] == truth["hidden_corners"]
