"""The compiled geometry of a prediction against the same in NumPy, function by function."""

from __future__ import annotations

import numpy as np
import pytest
from support.by_numpy import prediction as by_numpy
from support.meters import FISHEYE_LENS, box_gripper, moved
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, nominal_cam_T_grip

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.track.edges import prediction, prediction_kernel
from gripmon.track.edges.prediction import Prediction, lay_out, predict
from gripmon.track.edges.profiles import profile_offsets_px
from gripmon.track.edges.settings import SamplingSettings

CLOSE = 1e-9
GRIPPERS = {"box": box_gripper(), "arc": read_gripper(BOX_FINGERS.parent / "adaptive_arc_fingers.yaml")}
WAYS = {
    "as expected": np.zeros(6),
    "half out of the image": np.array([0.03, 0.02, 0.0, 0.0, 0.0, 0.0]),
    "near, some of it behind the camera": np.array([0.0, 0.0, -0.105, 0.3, 0.0, 0.2]),
}


def predicted(by: object, lens: object, gripper: str, way: str, monkeypatch: pytest.MonkeyPatch) -> Prediction:
    monkeypatch.setattr(prediction, "prediction_kernel", by)
    camera, pose = make_camera(lens), moved(nominal_cam_T_grip(), WAYS[way])
    settings = SamplingSettings(creases=True)
    layout = lay_out(camera, GRIPPERS[gripper], pose, 0.031, settings)
    return predict(
        camera, GRIPPERS[gripper], layout, pose, 0.031, profile_offsets_px(7.0), jaw_unknown=gripper == "box"
    )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("gripper", GRIPPERS)
@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS, FISHEYE_LENS], ids=["paper", "brown_conrady", "fisheye"])
def test_both_predict_the_same(lens: object, gripper: str, way: str, monkeypatch: pytest.MonkeyPatch):
    one = predicted(prediction_kernel, lens, gripper, way, monkeypatch)
    other = predicted(by_numpy, lens, gripper, way, monkeypatch)
    np.testing.assert_array_equal(one.layout.edge, other.layout.edge)
    np.testing.assert_allclose(one.layout.fraction, other.layout.fraction, atol=CLOSE)
    assert way != "as expected" or len(one.layout.edges) >= 6
    for name in ("uv_px", "normal", "jacobian", "xy", "way_xy", "along", "gain", "line_origin", "line_direction"):
        own = getattr(other, name)
        scale = np.nanmax(np.abs(own), initial=1.0)
        np.testing.assert_allclose(getattr(one, name), own, rtol=0.0, atol=CLOSE * scale, err_msg=name)
    np.testing.assert_array_equal(one.ok, other.ok)
    # Of single precision: where the doubles before it differ by rounding, the last bit may.
    for name in ("map_x", "map_y"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=3e-7, atol=1e-4, err_msg=name)
    xi = np.array([1e-3, -2e-3, 5e-4, 0.01, -0.02, 0.005])
    motions = [by.largest_motion(one.jacobian, xi) for by in (prediction, by_numpy)]
    assert motions[0] == pytest.approx(motions[1], rel=CLOSE)


def test_the_longest_run_inside_the_image_is_sampled():
    """Edges that leave the image and come back, that lie outside, that aren't wanted or are too short."""
    rng = np.random.default_rng(3)
    uv_px = np.cumsum(rng.uniform(0.0, 3.0, (60, 65, 2)), axis=1)
    outside = np.cumsum(rng.uniform(size=(60, 65)) < 0.06, axis=1) % 2 == 1
    outside[0], outside[1] = True, False
    inside_px = np.where(outside, -1.0, 1.0) * rng.uniform(0.1, 3.0, (60, 65))
    uv_px[2, 30:34] = inside_px[2, 30:34] = np.nan  # the lens maps it nowhere
    uv_px[3, 20:40] = uv_px[3, 20]  # seen end on
    wanted = rng.uniform(size=60) < 0.8
    wanted[:4] = True
    one, other = (by.sampled_ranges(uv_px, inside_px, wanted, 4.0, 8.0) for by in (prediction_kernel, by_numpy))
    np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-7)
    assert not one[0].any() and one[1, 2] > 100.0 and not one[~wanted].any()
    assert 20 < np.count_nonzero(one[:, 2]) < 60


def test_a_finger_is_where_its_table_has_it():
    """Against NumPy's own interpolation, at the table's rows and between them; beyond its ends it goes on straight."""
    from gripmon.model.gripper.motion import offset_m

    table = np.array([[0.0, 0.0, 0.1, 0.2], [0.01, 1.0, 0.0, 0.3], [0.04, 4.0, -0.5, 0.1], [0.05, 3.0, 0.0, 0.0]])
    np.testing.assert_allclose(offset_m(table, -0.01), [-1.0, 0.2, 0.1], atol=1e-15)
    np.testing.assert_allclose(offset_m(table, 0.07), [1.0, 1.0, -0.2], atol=1e-14)
    for opening_m in (0.0, 0.003, 0.01, 0.0399, 0.04, 0.05):
        expected = [np.interp(opening_m, table[:, 0], table[:, k]) for k in (1, 2, 3)]
        np.testing.assert_allclose(offset_m(table, opening_m), expected, atol=1e-15)
