"""From corners put by hand to edges, a pose and files: the reckoning, and ``gripmon teach --corners``."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.meters import WIDE_LENS, box_gripper
from support.simulated import IDEAL_SENSOR, PAPER_LENS, nominal_cam_T_grip, plain_scenario, sharp_gripper, simulator
from support.taught_by_hand import Rig, make_rig
from support.taught_scenes import CAMERA, bevelled, image_of, scene

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.documents import CalibratedGripper, CameraCalibration, HandEyeCalibration, HandEyeResiduals
from gripmon.cli import main
from gripmon.daemon.config import Settings, builtin_config, load_config, read_gripper
from gripmon.daemon.config.settings import JawSettings
from gripmon.daemon.config.typed import to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.camera import make_camera
from gripmon.model.geometry import from_record, perturb, perturbation_between, to_record
from gripmon.model.provenance import Provenance
from gripmon.model.yaml_text import as_yaml
from gripmon.monitor import MonitorSettings
from gripmon.simulate import paper_rig
from gripmon.simulate.scenario import JawScript, Sensor
from gripmon.teach.accuracy import forecast_frame
from gripmon.teach.corner_pose import PoseRefused, Snapped, pose_from_corners
from gripmon.teach.inset import unstated_inset_m
from gripmon.teach.session import Setup
from gripmon.teach.snapping import Snapper
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig as Viewed
from gripmon.track.edges import Measurement
from gripmon.track.edges.taught import gripper_digest

INNER = ("L_in_near", "L_in_far", "R_in_near", "R_in_far")
OPENING_M = 0.034
PHOTOGRAPHS = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "visp_cube"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return make_rig(tmp_path_factory.mktemp("corners"))


@pytest.fixture(scope="module")
def setup(rig: Rig) -> Setup:
    return Setup(rig.camera, rig.gripper, MonitorSettings(), None)


def put(values: dict[str, list[float]]) -> dict[str, np.ndarray]:
    return {name: np.array(at) for name, at in values.items()}


def snapped_in(
    setup: Setup, image: np.ndarray, put_px: dict[str, np.ndarray]
) -> tuple[Snapped, Measurement | None]:
    settings = setup.settings
    snapper = Snapper(setup.camera, setup.gripper, settings.corners, settings.jaw_sigma_m)
    return snapper.snap(image, put_px, OPENING_M, setup.prior(OPENING_M), known=False)


@pytest.mark.parametrize("opening_m", [OPENING_M, None])
def test_rough_corners_snap_to_the_true_ones(rig: Rig, setup: Setup, opening_m: float | None):
    for seed in range(4):
        found = setup.evaluate(rig.image, put(rig.rough(*INNER, off_px=5.0, seed=seed)), (), opening_m)
        assert found.snapped.refused is None
        measured = [corner for corner in found.snapped.corners if corner.uv_px is not None]
        assert len(measured) == 6
        for corner in measured:
            off = corner.uv_px - rig.corners_px[corner.name]  # type: ignore[operator]
            assert np.linalg.norm(off) < 0.2
            assert off @ np.linalg.solve(corner.covariance_px, off) < 25.0
            assert corner.sigma_px == pytest.approx(np.sqrt(np.linalg.eigvalsh(corner.covariance_px)[-1]), rel=1e-6)
        assert found.snapped.jaw_opening_m == pytest.approx(OPENING_M, abs=5.0 * (found.snapped.jaw_sigma_m or 0.0))


def test_an_opening_that_nobody_reports_may_be_far_from_the_nominal_one(rig: Rig, tmp_path: Path):
    """The same gripper, described with its jaws wide open."""
    model = yaml.safe_load((rig.folder / "gripper.yaml").read_text())
    model["jaw"]["nominal_m"] = 0.058
    for name, at in zip(rig.gripper.point_ids, rig.gripper.points_grip_m(0.058).tolist(), strict=True):
        model["points"][name]["xyz_m"] = at
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(model))
    setup = Setup(rig.camera, read_gripper(tmp_path / "gripper.yaml"), MonitorSettings(), None)
    snapped = setup.evaluate(rig.image, put(rig.rough(*INNER)), (), None).snapped
    assert snapped.refused is None and sum(corner.uv_px is not None for corner in snapped.corners) == 6
    assert snapped.jaw_opening_m == pytest.approx(OPENING_M, abs=5.0 * (snapped.jaw_sigma_m or 0.0))


def test_refusals_say_what_to_do(rig: Rig, setup: Setup):
    good = rig.rough(*INNER)
    few = setup.evaluate(rig.image, put({"L_in_near": good["L_in_near"]}), (), OPENING_M)
    assert few.snapped.refused == "place 2 more corners on the fingertips" and few.reference is None
    swapped = {**good, "L_in_near": good["R_in_near"], "R_in_near": good["L_in_near"]}
    assert "where the others put it" in str(setup.evaluate(rig.image, put(swapped), (), OPENING_M).snapped.refused)
    other = {name: good[f"{'R' if name[0] == 'L' else 'L'}{name[1:]}"] for name in good}
    exchanged = setup.evaluate(rig.image, put(other), (), OPENING_M)
    assert "the fingers, or near and far, have each other's names" in str(exchanged.snapped.refused)
    empty = np.full_like(rig.image, 120)
    assert "no fingers are seen" in str(setup.evaluate(empty, put(good), (), OPENING_M).snapped.refused)
    tips = rig.rough("L_in_near", "L_out_near", "R_in_near", "R_out_near")
    assert "lie on a line" in str(setup.evaluate(empty, put(tips), (), OPENING_M).snapped.refused)
    assert setup.evaluate(rig.image, put(tips), (), OPENING_M).snapped.refused is None, "the edges say the rest"
    hidden = rig.rough("L_in_far", "R_in_near", "R_in_far", "L_out_far", off_px=8.0)
    assert setup.evaluate(rig.image, put(hidden), (), OPENING_M).snapped.refused is None
    away = {name: [u, v - 150.0] for name, (u, v) in good.items()}
    assert setup.evaluate(rig.image, put(away), (), OPENING_M).snapped.refused is not None


def test_a_corner_put_by_hand_beyond_the_lens_gives_no_pose():
    """A fisheye's image reaches farther than its model."""
    pose = nominal_cam_T_grip(tcp_m=(0.0, 0.002, 0.035))
    image = simulator(plain_scenario(), lens=WIDE_LENS, cam_T_grip=pose).render(0)
    camera, gripper = make_camera(WIDE_LENS), sharp_gripper()
    points_m = gripper.points_grip_m(OPENING_M)[gripper.corner_points] @ pose[:3, :3].T + pose[:3, 3]
    shown = dict(zip(gripper.corner_ids, camera.project(points_m), strict=True))
    setup = Setup(camera, gripper, MonitorSettings(), None)
    assert setup.evaluate(image, shown, (), OPENING_M).reference is not None
    with pytest.raises(PoseRefused, match="L_in_near was placed outside the lens's view"):
        pose_from_corners(camera, gripper, *snapped_in(setup, image, shown), {"L_in_near": np.array([1.0, 1.0])})


@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="../shared/data/visp_cube is not there")
def test_a_photograph_of_a_box_without_jaw():
    """Wherever the corners were put by hand, the same ones are measured; four are enough."""
    config = load_config(builtin_config("visp_cube.yaml"), check_source=False)
    image = cv2.imread(str(PHOTOGRAPHS / "image0000.png"), cv2.IMREAD_GRAYSCALE)
    points_m = config.gripper.points_grip_m()[config.gripper.corner_points]
    shown = config.camera.project(points_m @ config.cam_T_grip[:3, :3].T + config.cam_T_grip[:3, 3])
    setup, rng = Setup(config.camera, config.gripper, config.settings.monitor, None), np.random.default_rng(3)
    poses, corners = [], []
    for taken in ((0, 1, 3, 5, 6, 7), (0, 3, 6, 7), (0, 1, 5, 6), (1, 3, 4, 6)):
        hand = {config.gripper.corner_ids[k]: shown[k] + rng.normal(0.0, 4.0, 2) for k in taken}
        found = setup.evaluate(image, hand, (), None)
        assert found.reference is not None, (found.no_reference, found.snapped.refused)
        poses.append(from_record(found.reference.cam_T_grip))
        corners.append({c.name: c.uv_px for c in found.snapped.corners if c.uv_px is not None})
    for pose, seen in zip(poses[1:], corners[1:], strict=True):
        assert np.linalg.norm(pose[:3, 3] - poses[0][:3, 3]) < 5e-4
        assert seen.keys() == corners[0].keys()
        assert max(np.linalg.norm(at - corners[0][name]) for name, at in seen.items()) < 0.2
    # Four points that someone clicked on: some mm and degrees.
    xi = perturbation_between(config.cam_T_grip, poses[0])
    assert np.linalg.norm(xi[:3]) < 0.012 and np.linalg.norm(xi[3:]) < 0.05


def test_what_is_expected_is_what_check_says(rig: Rig, setup: Setup):
    found = setup.evaluate(rig.image, put(rig.rough(*INNER)), (), OPENING_M)
    assert found.reference is not None and found.expected is not None
    # As of the configuration that is saved then, which names what this image teaches.
    _, taught = setup.taught(found.reference, [TeachingImage(rig.image, found.snapped.jaw_opening_m, "")])
    known = Viewed(rig.camera, rig.gripper, MonitorSettings(), taught)
    expected = forecast_frame(known, from_record(found.reference.cam_T_grip), OPENING_M)
    shown = found.expected.accuracy
    np.testing.assert_allclose(shown.expected.array, expected.expected.array)
    assert min(shown.drift.smallest.array) > 0.0 and shown.edges == expected.edges


@pytest.mark.slow("11 s: sampled; the corners' spread is in the default run")
def test_the_pose_is_as_good_as_its_covariance_says():
    """Over poses, openings that are reported wrongly, and cameras that are calibrated wrongly, by what is stated."""
    gripper, rng = sharp_gripper(), np.random.default_rng(8)
    sigma_m, sigma_px = 1e-4, 4.0
    error = GivenCamera(PAPER_LENS, ("fx_px", "cx_px", "cy_px"), np.diag([sigma_px**2] * 3))
    squares = []
    for trial in range(24):
        off = rng.normal(0.0, sigma_px, 3)
        lens = msgspec.structs.replace(
            PAPER_LENS, fx_px=962.0 + off[0], fy_px=962.0 + off[0], cx_px=383.5 + off[1], cy_px=287.5 + off[2]
        )
        pose = perturb(nominal_cam_T_grip(), np.concatenate([rng.normal(0.0, 0.003, 3), rng.normal(0.0, 0.06, 3)]))
        sensor = msgspec.structs.replace(IDEAL_SENSOR, read_noise_dn=1.5)
        assert isinstance(sensor, Sensor)
        scene = plain_scenario(jaw=JawScript(knots=((0.0, OPENING_M),)), sensor=sensor)
        simulator = paper_rig(gripper, pose, lens=lens).simulator(scene, trial)
        exact = MonitorSettings(jaw_sigma_m=sigma_m, model_sigma_m=0.0)
        setup = Setup(make_camera(PAPER_LENS), gripper, exact, None, error)
        points_m = gripper.points_grip_m(OPENING_M)[gripper.corner_points]
        uv_px = make_camera(lens).project(points_m @ pose[:3, :3].T + pose[:3, 3])
        shown = dict(zip(gripper.corner_ids, uv_px + rng.normal(0.0, 3.0, uv_px.shape), strict=True))
        reported_m = OPENING_M + rng.normal(0.0, sigma_m)
        found = setup.evaluate(simulator.render(0), {name: shown[name] for name in INNER}, (), reported_m)
        assert found.reference is not None, found.no_reference
        xi = perturbation_between(from_record(found.reference.cam_T_grip), pose)
        squares.append(xi @ np.linalg.solve(np.reshape(found.reference.covariance, (6, 6)), xi))
    # Six degrees of freedom each; that grippers are not made exactly is allowed for, and not simulated.
    assert 0.5 < np.mean(squares) < 7.5
    assert max(squares) < 28.0


@pytest.mark.parametrize("opening_m", [OPENING_M, None])
def test_the_poses_covariance_includes_bevels_that_nobody_stated(opening_m: float | None):
    """Rendered ones of 0.2 mm; without them in the covariance the error is beyond what 19 of 20 are within."""
    gripper, pose = box_gripper(), nominal_cam_T_grip()
    points_m = gripper.points_grip_m(OPENING_M)[gripper.corner_points]
    shown_px = CAMERA.project(points_m @ pose[:3, :3].T + pose[:3, 3])
    shown = dict(zip(gripper.corner_ids, shown_px, strict=True))
    image = image_of(2e-4, scene(opening_m=OPENING_M), pose)
    squares = []
    for model_sigma_m in (1e-4, 0.0):
        setup = Setup(CAMERA, gripper, MonitorSettings(model_sigma_m=model_sigma_m), None)
        found = setup.evaluate(image, shown, (), opening_m)
        assert found.reference is not None, found.no_reference
        xi = perturbation_between(from_record(found.reference.cam_T_grip), pose)
        squares.append(xi @ np.linalg.solve(np.reshape(found.reference.covariance, (6, 6)), xi))
        # The page promises what the run's bounds will say: with the error that the taught edges take over, what is
        # known of the reference and what their images show of it together.
        _, taught = setup.taught(found.reference, [TeachingImage(image, found.snapped.jaw_opening_m, "")])
        known = np.linalg.inv(np.reshape(found.reference.covariance, (6, 6)))
        more = np.linalg.inv(taught.reference_error.T @ taught.reference_error) - known
        assert np.linalg.eigvalsh(more / np.sqrt(np.outer(known.diagonal(), known.diagonal()))).min() > -1e-6
    assert squares[0] < 12.6 < squares[1]
    assert not unstated_inset_m(bevelled(2e-4))


def test_corners_by_hand_count_little_against_measured_ones(rig: Rig, setup: Setup):
    rough = put(rig.rough(*INNER))
    found = setup.evaluate(rig.image, rough, (), OPENING_M)
    held = {"R_in_near": rig.corners_px["R_in_near"] + 0.5}
    by_hand = pose_from_corners(rig.camera, rig.gripper, *snapped_in(setup, rig.image, rough), held)
    assert found.pose is not None and set(by_hand.corners) == set(found.pose.corners)
    assert by_hand.covariance[0, 0] > 1.2 * found.pose.covariance[0, 0]
    moved = perturbation_between(found.pose.cam_T_grip, by_hand.cam_T_grip)
    assert moved @ np.linalg.solve(by_hand.covariance, moved) < 4.0


def run(arguments: list[object], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    capsys.readouterr()
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as ended:
        code = int(ended.code or 0)
    text = capsys.readouterr()
    return code, text.out, text.err


def rough_file(rig: Rig, path: Path, **more: object) -> Path:
    path.write_text(yaml.safe_dump({"corners": {**rig.rough(*INNER), **more}}))
    return path


def test_without_a_page_a_file_of_corners_does_the_same(rig: Rig, tmp_path: Path, capsys):
    rough = rough_file(rig, tmp_path / "rough.yaml")
    command: list[object] = ["teach", rig.image_path, "--corners", rough, *rig.options, "--out", tmp_path / "mine"]
    code, out, err = run(command, capsys)
    assert (code, err) == (0, "")
    assert "L_out_far   not measured: hidden by its own finger" in out and "smallest drift  " in out
    assert "less accurate than with a plate" in out
    config = load_config(tmp_path / "mine" / "config.yaml")
    assert config.taught is not None and config.settings.jaw.source == "frames"
    # What is not said holds as everywhere.
    defaults = {field.name: field.default for field in msgspec.structs.fields(Settings)}
    for name in ("monitor", "publish", "ros2", "recording", "metrics", "daemon", "state"):
        assert getattr(config.settings, name) == defaults[name]
    # Its own corners are a file of corners again.
    again: list[object] = ["teach", rig.image_path, "--corners", tmp_path / "mine" / "corners.yaml", *rig.options]
    assert run([*again, "--jaw-source", "zenoh", "--out", tmp_path / "again"], capsys)[0] == 0
    assert load_config(tmp_path / "again" / "config.yaml").settings.jaw == JawSettings(source="zenoh")
    # Nothing is replaced without a word.
    before = {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()}
    code, _, err = run(command, capsys)
    assert code == 2 and "there already" in err and len(err.splitlines()) == 1
    assert {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()} == before
    assert run([*command, "--force"], capsys)[0] == 0


def test_a_configuration_with_a_robot_s_hand_eye_result_is_taught_into(rig: Rig, tmp_path: Path, capsys):
    """Its file stands beside it, by its name."""
    rough = rough_file(rig, tmp_path / "rough.yaml")
    mine = tmp_path / "mine"
    assert run(["teach", rig.image_path, "--corners", rough, *rig.options, "--out", mine], capsys)[0] == 0
    values = yaml.safe_load((mine / "config.yaml").read_text())
    reference = load_config(mine / "config.yaml").settings.reference
    told = {"translation_m": list(reference.cam_T_grip.translation_m)}
    told["rotation_xyzw"] = list(reference.cam_T_grip.rotation_xyzw)
    (mine / "robot.yaml").write_text(yaml.safe_dump({"cam_T_grip": told}))
    (mine / "config.yaml").write_text(yaml.safe_dump({**values, "reference": {"hand_eye": "robot.yaml"}}))
    again: list[object] = ["teach", rig.image_path, "--config", mine / "config.yaml", "--corners", rough, "--force"]
    code, _, err = run(again, capsys)
    assert (code, err) == (0, "")
    assert load_config(mine / "config.yaml").taught is not None
    # Where no line can be added, within braces, nothing is written at all.
    (mine / "taught.yaml").unlink()
    (mine / "config.yaml").write_text(json.dumps({**values, "taught": None, "reference": {"hand_eye": "robot.yaml"}}))
    before = {path.name: path.read_bytes() for path in mine.iterdir() if path.is_file()}
    code, _, err = run(again, capsys)
    assert code == 3 and "the configuration would be refused: " in err and "not YAML" in err
    assert {path.name: path.read_bytes() for path in mine.iterdir() if path.is_file()} == before


def test_what_is_commented_out_is_what_holds(rig: Rig, tmp_path: Path, capsys):
    """Every # taken away, the file means the same."""
    rough = rough_file(rig, tmp_path / "rough.yaml")
    assert run(["teach", rig.image_path, "--corners", rough, *rig.options, "--out", tmp_path], capsys)[0] == 0
    text = (tmp_path / "config.yaml").read_text()
    head, mark, rest = text.partition("# Everything below")
    first, _, defaults = rest.partition("\n")
    (tmp_path / "whole.yaml").write_text(head + mark + first + "\n" + defaults.replace("\n# ", "\n").removeprefix("# "))
    assert len((tmp_path / "whole.yaml").read_text().splitlines()) == len(text.splitlines())
    assert load_config(tmp_path / "whole.yaml").settings == load_config(tmp_path / "config.yaml").settings
    assert all("  # " in line for line in defaults.splitlines() if ": " in line)


def test_a_calibration_with_a_plate_becomes_the_reference(rig: Rig, tmp_path: Path, capsys):
    made = HandEyeCalibration(
        camera=rig.camera.settings,
        gripper=CalibratedGripper(name=rig.gripper.name, sha256=gripper_digest(rig.gripper)),
        jaw_opening_m=OPENING_M,
        cam_T_grip=to_record(nominal_cam_T_grip()),
        covariance=tuple(np.diag([1e-9] * 3 + [1e-7] * 3).ravel().tolist()),
        residuals=HandEyeResiduals(rms_m=1e-5, rms_px=0.1, corners=4, images=1),
        provenance=Provenance(gripmon="0", time="2026-01-01T00:00:00+00:00", command="test"),
    )
    (tmp_path / "hand_eye.yaml").write_text(as_yaml(msgspec.to_builtins(made)))
    rough = rough_file(rig, tmp_path / "rough.yaml")
    gripper = ["--gripper", rig.folder / "gripper.yaml", "--reference", tmp_path / "hand_eye.yaml"]
    command: list[object] = ["teach", rig.image_path, "--corners", rough, *gripper, "--out", tmp_path / "mine"]
    code, out, err = run(command, capsys)
    assert (code, err) == (0, "") and "with a plate" not in out
    assert yaml.safe_load((tmp_path / "mine" / "config.yaml").read_text())["reference"] == "../hand_eye.yaml"
    config = load_config(tmp_path / "mine" / "config.yaml")
    np.testing.assert_allclose(config.cam_T_grip, nominal_cam_T_grip(), atol=1e-12)
    assert config.reference.covariance == made.covariance
    # Another gripper's calibration is none.
    other = msgspec.structs.replace(made, gripper=CalibratedGripper(name="other", sha256="0" * 64))
    (tmp_path / "hand_eye.yaml").write_text(as_yaml(msgspec.to_builtins(other)))
    code, out, err = run([*command, "--force"], capsys)
    assert (code, out) == (2, "") and "gripper: is other, the one given is" in err and len(err.splitlines()) == 1


def test_a_calibrated_camera_is_named_and_its_doubt_counts(rig: Rig, tmp_path: Path, capsys):
    made = CameraCalibration(
        camera=rig.camera.settings,
        parameters=("fx_px", "cx_px", "cy_px"),
        covariance=tuple(np.diag([25.0] * 3).ravel().tolist()),
        provenance=Provenance(gripmon="0", time="2026-01-01T00:00:00+00:00", command="test"),
    )
    (tmp_path / "camera.yaml").write_text(as_yaml(msgspec.to_builtins(made)))
    rough = rough_file(rig, tmp_path / "rough.yaml")
    given: list[object] = ["teach", rig.image_path, "--corners", rough, "--gripper", rig.folder / "gripper.yaml"]
    assert run([*given, "--camera", tmp_path / "camera.yaml", "--out", tmp_path / "mine"], capsys)[0] == 0
    assert run([*given, "--camera", rig.folder / "camera.yaml", "--out", tmp_path / "sure"], capsys)[0] == 0
    assert yaml.safe_load((tmp_path / "mine" / "config.yaml").read_text())["camera"] == "../camera.yaml"
    doubted, sure = (load_config(tmp_path / name / "config.yaml") for name in ("mine", "sure"))
    assert doubted.camera.settings == sure.camera.settings
    # 5 px of the principal point, at 115 mm and 962 px: 0.6 mm.
    assert np.sqrt(doubted.reference.covariance[0]) == pytest.approx(0.115 * 5.0 / 962.0, rel=0.3)
    assert np.sqrt(sure.reference.covariance[0]) < 1e-4


def test_bad_input_is_one_line_and_exit_2(rig: Rig, tmp_path: Path, capsys):
    image, camera, gripper = rig.image_path, rig.folder / "camera.yaml", rig.folder / "gripper.yaml"
    (tmp_path / "nothing").mkdir()
    (tmp_path / "broken.png").write_bytes(image.read_bytes()[:2000])
    cv2.imwrite(str(tmp_path / "small.png"), cv2.resize(rig.image, (320, 240)))
    (tmp_path / "no.yaml").write_text("camera: [")
    (tmp_path / "half.yaml").write_text("model: paper\nwidth_px: 768\n")
    bad = rough_file(rig, tmp_path / "nose.yaml", nose=[1.0, 2.0])
    (tmp_path / "flat.yaml").write_text("corners: {L_in_near: [1.0]}\n")
    rough = rough_file(rig, tmp_path / "rough.yaml")
    (two := tmp_path / "two.yaml").write_text("corners: {L_in_near: [1.0, 2.0], L_in_far: [1.0, 20.0]}\n")
    given: list[object] = ["--camera", camera, "--gripper", gripper, "--out", tmp_path / "out"]
    page: list[object] = ["--page", *given]
    for arguments, said in (
        ([tmp_path / "broken.png", *page], "truncated, damaged or not an image"),
        ([tmp_path / "none.png", *page], "the file is missing"),
        ([tmp_path / "nothing", *page], "no image in this folder"),
        ([tmp_path / "small.png", *page], "320x240 pixels; 768x576"),
        ([image, "--page", "--camera", camera, "--robot", "arm"], "--gripper: is missing; a gripper file"),
        ([image, image, "--page", "--camera", camera], "2 images, and no gripper; one image"),
        ([tmp_path / "small.png", "--page", "--camera", camera], "320 x 240 px; the camera's 768 x 576 px"),
        ([tmp_path / "broken.png", "--page"], "truncated, damaged or not an image"),
        ([image, "--page", "--gripper", gripper], "--camera: is missing; a file of gripmon calibrate intrinsics"),
        ([image, "--page", "--camera", camera, "--gripper", tmp_path / "none.yaml"], "there is no such file"),
        ([image, "--page", "--camera", tmp_path / "none.yaml", "--gripper", gripper], "there is no such file"),
        ([image, "--page", "--camera", tmp_path / "no.yaml", "--gripper", gripper], "not YAML"),
        ([image, "--page", "--camera", tmp_path / "half.yaml", "--gripper", gripper], "holds no calibration"),
        ([*page], "no image; image files, or --page --live DEVICE"),
        ([image, *page, "--live", "0"], "--live goes with --page, without images"),
        ([image, "--page", "--config", camera, "--jaw-source", "zenoh"], "--jaw-source: --config gives the source"),
        ([image, *page, "--live-wait", "3"], "--live-wait: goes with --live"),
        ([image, *given, "--corners", two], "2 of the gripper's corners; at least 3, hidden ones too"),
        ([image, *page, "--corners", rough], "--page and --corners"),
        ([image, *page, "--config", camera], "--config names camera, gripper and reference already"),
        ([image, *page, "--jaw-opening", "0.2"], "jaw opening 0.2 m; the gripper's 0 to 0.06 m"),
        ([image, *page, "--picture", "a.png"], "--picture: the page shows it; leave it out"),
        ([image, *given, "--corners", bad], "corners.nose: the gripper has no such corner; one of L_in_near"),
        ([image, *given, "--corners", tmp_path / "flat.yaml"], "corners.L_in_near: has 1 values"),
        ([image, *given, "--corners", tmp_path / "none.yaml"], "there is no such file"),
        ([image, *given, "--corners", gripper], "is a gripper file; a file with corners"),
        ([image, "--page", "--camera", camera, "--gripper", rough], "is a file with corners; a gripper file"),
        ([image, "--gripper", gripper], "teach: --config is missing"),
        ([image, "--config", rig.folder / "made_with.yaml", "--camera", camera], "--camera: goes with --page"),
        ([], "no image"),
    ):
        code, out, err = run(["teach", *arguments], capsys)
        assert (code, out) == (2, ""), (arguments, err)
        assert said in err and len(err.splitlines()) == 1, err
    code, out, err = run(["teach", image, "--page", "--port", "70000"], capsys)
    assert code == 2 and "isn't a port" in err
    assert run(["teach", image, "--page", "--robot", "a/b"], capsys)[0] == 2


def test_corners_without_fingers_fail_and_write_nothing(rig: Rig, tmp_path: Path, capsys):
    cv2.imwrite(str(tmp_path / "empty.png"), cv2.add(np.full_like(rig.image, 120), rig.image // 40))
    rough = rough_file(rig, tmp_path / "rough.yaml")
    blank = np.full(rig.image.shape[:2], 120, np.uint8)
    blank[::7, ::5] = 160
    cv2.imwrite(str(tmp_path / "empty.png"), blank)
    options = ["--jaw-opening", OPENING_M, "--out", tmp_path / "out"]
    code, out, err = run(["teach", tmp_path / "empty.png", "--corners", rough, *rig.options, *options], capsys)
    assert (code, out) == (3, "") and "no fingers are seen" in err
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_the_file_of_corners_is_as_the_contract_says(rig: Rig, tmp_path: Path, capsys):
    """A mapping of names to columns and rows, and nothing else."""
    rough = rough_file(rig, tmp_path / "rough.yaml")
    assert run(["teach", rig.image_path, "--corners", rough, *rig.options, "--out", tmp_path], capsys)[0] == 0
    values = read_yaml(tmp_path / "corners.yaml")
    assert list(values) == ["corners"]
    read = to_settings(values["corners"], dict[str, tuple[float, float]])
    assert set(INNER) <= set(read) and json.dumps(read)
