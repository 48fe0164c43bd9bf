"""What ``gripmon check`` expects of a frame, held against sampled edge points, rendered images and brute force."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.grippers import gripper_from_dict
from support.meters import FISHEYE_LENS, JAW_SIGMA_M, box_gripper, difference, measure, meter, picture
from support.sampled import INDEPENDENT, OPENING_M, NoisyMeter
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, box_model, nominal_cam_T_grip, plain_scenario
from support.watched import watched

from gripmon.cli import main
from gripmon.daemon.config import builtin_config
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.monitor import MonitorSettings
from gripmon.teach.accuracy import Accuracy, forecast_frame, weakest_direction
from gripmon.teach.visibility import Rig
from gripmon.track.edges import MeasurementSettings


def forecast(lens: LensSettings = PAPER_LENS, **settings: object) -> Accuracy:
    known = MonitorSettings(**{"floor_m": 0.0, "floor_rad": 0.0, "corners": INDEPENDENT, **settings})  # type: ignore[arg-type]
    rig = Rig(make_camera(lens), box_gripper(), known)
    return forecast_frame(rig, nominal_cam_T_grip(), OPENING_M, with_jaw=True)


def lever_m(gripper: Gripper) -> float:
    """Root mean square distance of the corners from the TCP, by which a turn of one radian moves them."""
    corners_m = gripper.points_grip_m(OPENING_M)[gripper.landmarks]
    return float(np.sqrt((corners_m**2).sum(axis=1).mean()))


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS, FISHEYE_LENS], ids=["paper", "brown_conrady", "fisheye"])
@pytest.mark.parametrize(
    "reported",
    [True, pytest.param(False, marks=pytest.mark.slow("5 s each: sampled; a reported opening is in the default run"))],
    ids=["opening reported", "opening unknown"],
)
def test_expected_sigmas_are_the_spread_of_sampled_measurements(lens: LensSettings, reported: bool):
    """A camera that stands, a robot that reports its jaws with the stated error or not at all."""
    rng, samples = np.random.default_rng(2), 250
    sampled = NoisyMeter(JAW_SIGMA_M, lens=lens)
    errors, seen_m = np.empty((samples, 6)), np.empty(samples)
    for k in range(samples):
        wrong_m = rng.normal(scale=JAW_SIGMA_M)
        measured = sampled.forecast(nominal_cam_T_grip(), OPENING_M + wrong_m, reported)
        errors[k] = difference(measured.cam_T_grip, nominal_cam_T_grip())
        seen_m[k] = measured.jaw_opening_m - OPENING_M
    expected = forecast(lens)
    sigma = (expected.expected if reported else expected.jaw.unknown).array
    # A sampled standard deviation scatters by 1 / sqrt(2 n); the robust weights cost a few per cent.
    np.testing.assert_allclose(errors.std(axis=0) / sigma, 1.0, atol=4.0 / np.sqrt(2.0 * samples) + 0.05)
    if not reported:
        assert seen_m.std() == pytest.approx(expected.jaw.unknown.jaw_m, rel=0.25)
        # Along the weakest direction the errors of pose and opening go together as told.
        scale = np.array([1.0] * 3 + [lever_m(box_gripper())] * 3)
        _, _, axes = np.linalg.svd(errors * scale)
        told = abs(np.corrcoef(errors * scale @ axes[0], seen_m)[0, 1])
        assert told == pytest.approx(expected.jaw.correlation, abs=0.05)


@pytest.mark.parametrize("measurement", ["edges", "corners"])
def test_simulated_sequences_scatter_as_expected(measurement: str):
    """Another noise and texture than assumed: within a factor of three."""
    settings = MonitorSettings(measurement=measurement)  # type: ignore[arg-type]
    camera, gripper = make_camera(PAPER_LENS), box_gripper(sharp=False)
    expected = forecast_frame(Rig(camera, gripper, settings), nominal_cam_T_grip(), OPENING_M).expected.array
    spread = np.nanstd(watched("static", measurement).errors(), axis=0)
    assert (spread < 3.0 * expected).all()
    assert (spread > 0.1 * expected).all()
    # The order of the axes is that of the geometry.
    assert spread[:3].argmax() == expected[:3].argmax() == 2


def test_an_opening_that_is_wrong_shifts_the_pose_of_a_rendered_image_as_told():
    told = forecast().jaw.pose_per_jaw_m.array
    image, wrong_m = picture(plain_scenario()), 1e-4
    sure = type(meter())(make_camera(PAPER_LENS), box_gripper(), MeasurementSettings(), 0.0)
    right, wrong = (measure(image, using=sure, jaw_opening_m=OPENING_M + e).cam_T_grip for e in (0.0, wrong_m))
    shift = difference(right, wrong)
    # The image weighs the edges by their texture, which the forecast can not know.
    assert shift[2] == pytest.approx(told[2] * wrong_m, rel=0.3)
    assert np.abs(shift[:2] - told[:2] * wrong_m).max() < 3e-5
    assert told[2] > 2.0, "an opening looks like a distance: one part in 34 mm of 115 mm"


def test_an_exact_opening_leaves_the_pose_of_six_unknowns():
    """The seventh unknown with a prior of a micrometre against a gripper that has no jaw."""
    model = box_model()
    model.pop("jaw")
    model["fingers"] = {"left": {}, "right": {}}
    rigid = gripper_from_dict(model)
    settings = MonitorSettings(floor_m=0.0, floor_rad=0.0, jaw_sigma_m=0.0)
    six = forecast_frame(Rig(make_camera(PAPER_LENS), rigid, settings), nominal_cam_T_grip(), None, with_jaw=True)
    assert six.jaw is None
    seven = forecast(jaw_sigma_m=0.0, corners=MeasurementSettings())
    np.testing.assert_allclose(seven.expected.array, six.expected.array, rtol=0.05)


def test_the_weakest_direction_is_that_of_the_largest_spread():
    rng, radius_m = np.random.default_rng(3), 0.02
    mixing = rng.normal(size=(6, 6)) * np.array([1e-6, 2e-6, 1e-5, 1e-4, 3e-4, 5e-4])[:, None]
    covariance = mixing @ mixing.T
    weakest = weakest_direction(covariance, radius_m)
    scale = np.array([1.0] * 3 + [radius_m] * 3)
    length = np.linalg.norm(weakest * scale)
    directions = rng.normal(size=(20000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scaled = covariance * np.outer(scale, scale)
    spread = np.sqrt(np.einsum("ni,ij,nj->n", directions, scaled, directions))
    assert spread.max() <= length
    own = weakest * scale / length
    assert np.sqrt(own @ scaled @ own) == pytest.approx(length)


def test_corners_nearly_on_a_line_show_it_in_the_covariance():
    """The rectangle about the TCP squeezed to a hundredth: the update by corners hardly tells a turn about its axis."""
    model = box_model()
    for name, point in model["points"].items():
        x, y, z = point["xyz_m"]
        point["xyz_m"] = [x, y if name.endswith("_back") else 0.08 * y, z]
    model.pop("faces")
    thin = gripper_from_dict(model)
    settings = MonitorSettings(measurement="corners", corners=INDEPENDENT)
    rigs = [Rig(make_camera(PAPER_LENS), gripper, settings) for gripper in (box_gripper(), thin)]
    wide, squeezed = (forecast_frame(rig, nominal_cam_T_grip(), OPENING_M) for rig in rigs)
    assert squeezed.expected.rotation_rad[0] > 3.0 * wide.expected.rotation_rad[0]
    assert np.abs(squeezed.weakest.rotation_rad).argmax() == 0, "about the line"


# --- the command ---


def checked(path: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> tuple[str, dict[str, Any]]:
    """Text and JSON of ``gripmon check``."""
    assert main(["check", str(path), "--verbose"]) == code
    text = capsys.readouterr().out
    assert main(["check", str(path), "--json"]) == code
    return text, json.loads(capsys.readouterr().out)["accuracy"]


def config_with(tmp_path: Path, model: dict[str, Any] | None = None, monitor: str = "") -> Path:
    """The demo's configuration with a gripper and settings of the monitor."""
    text = builtin_config("demo.yaml").read_text().replace("monitor:\n", f"monitor:\n{monitor}", 1)
    if model is not None and "jaw" not in model:
        text = text.replace("source: frames", "source: fixed")
    (tmp_path / "gripper.yaml").write_text(BOX_FINGERS.read_text() if model is None else yaml.safe_dump(model))
    path = tmp_path / "config.yaml"
    path.write_text(text.replace("gripper: grippers/two_box_fingers.yaml", "gripper: gripper.yaml"))
    return path


def test_check_says_what_one_frame_tells_and_what_it_cannot(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text, values = checked(config_with(tmp_path), capsys)
    assert values["jaw"]["like"] == "the distance (z)" and values["jaw"]["growth"] > 2.0
    assert values["recalibration"]["corners"] == 6 and values["recalibration"]["coplanar"]
    expected = values["expected"]["tcp_m"]
    assert 0.0 < max(expected[:2]) < expected[2] < values["jaw"]["unknown"]["tcp_m"][2]
    x, y, z = (1e3 * v for v in expected)
    assert f"TCP {x:.4g} {y:.4g} {z:.4g} mm" in text
    assert values["jaw"]["pose_per_jaw_m"]["tcp_m"][2] == pytest.approx(3.0, abs=0.5)
    # Openings that are reported with an error cost what an error of that size shifts.
    _, vague = checked(config_with(tmp_path, monitor="  jaw_sigma_m: 0.00001\n  #"), capsys)
    added = np.sqrt(vague["expected"]["tcp_m"][2] ** 2 - expected[2] ** 2)
    assert added == pytest.approx(1e-5 * values["jaw"]["pose_per_jaw_m"]["tcp_m"][2], rel=0.5)


def test_check_of_a_gripper_without_jaw_says_nothing_about_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = box_model()
    model.pop("jaw")
    model["fingers"] = {"left": {}, "right": {}}
    text, values = checked(config_with(tmp_path, model), capsys)
    assert values["jaw"] is None and "opening" not in text.split("accuracy")[1].split("source")[0]


@pytest.mark.parametrize(
    ("corners", "said"),
    [
        (("L_in_near", "R_in_near", "L_in_far"), "3 corners; at least 4 coplanar ones or 6 are needed"),
        (("L_in_near", "R_in_near", "L_in_far", "R_in_far", "L_in_near_back"), "5 corners; at least 6 are needed"),
    ],
)
def test_check_says_when_corners_do_not_give_a_new_pose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], corners: tuple[str, ...], said: str
):
    model = box_model()
    # A back end in view and with edges of its own is a corner like any other.
    model["points"]["L_in_near_back"]["xyz_m"] = [-0.017, -0.008, -0.015]
    for name in ("L_in_far_back", "L_out_near_back", "L_out_far_back"):
        model["points"][name]["xyz_m"][2] = -0.015
    model["edges"]["L_back_in"] = {"from": "L_in_near_back", "to": "L_in_far_back"}
    model["edges"]["L_back_near"] = {"from": "L_in_near_back", "to": "L_out_near_back"}
    for name, point in model["points"].items():
        point["corner"] = name in corners
    model.pop("faces")
    text, values = checked(config_with(tmp_path, model), capsys)
    assert f"the reference can't be measured again from the corners in view: {said}" in text
    new_pose = values["recalibration"]
    assert (new_pose.pop("mode"), new_pose.pop("sure_sigma_m")) == ("auto", 5e-5)
    assert 0.0 < new_pose.pop("sigma_m") < 5e-5
    assert new_pose == {
        "corners": len(corners), "coplanar": len(corners) == 3, "possible": False, "reason": said,
    }  # fmt: skip


def test_check_says_when_too_few_edges_are_in_view(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """In a sixteenth of the resolution no edge is long enough."""
    path = config_with(tmp_path)
    small = {"width_px: 768": "width_px: 48", "height_px: 576": "height_px: 36", "x_px: 962.0": "x_px: 60.0"}
    small |= {"y_px: 962.0": "y_px: 60.0", "383.5": "23.5", "287.5": "17.5", "1.9e-7": "4.9e-5"}
    text = path.read_text()
    for large, little in small.items():
        text = text.replace(large, little)
    path.write_text(text)
    _, values = checked(path, capsys, code=3)
    assert values["expected"] is None and values["edges"] < 3
    assert values["edges_needed"] == 3
