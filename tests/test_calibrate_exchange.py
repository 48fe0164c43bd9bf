"""``gripmon calibrate import``, ``export`` and ``verify`` as a user calls them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.plate_fingers import DISCS, OPENING_M, standing
from support.plates import Look
from support.sample_messages import MEASURED, NOTHING
from support.simulated import PAPER_LENS, nominal_cam_T_grip, plain_scenario, sharp_gripper, simulator
from urdf_parser_py.urdf import URDF

from gripmon.calibrate.documents import (
    CalibratedGripper,
    CameraCalibration,
    CameraResiduals,
    HandEyeCalibration,
    HandEyeResiduals,
)
from gripmon.cli import main
from gripmon.daemon.config import load_config
from gripmon.daemon.config.calibrated import read_camera
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.judge.statefile import Calibration, Owner, pack
from gripmon.model.camera import BrownConradyLens, LensSettings
from gripmon.model.geometry import perturb, to_record
from gripmon.model.gripper import contents_of
from gripmon.model.provenance import provenance_of, sha256_of
from gripmon.model.records import Cause, MonitorState, ReferenceRecord, to_json
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.scenario import Sensor
from gripmon.track.edges.taught import gripper_digest

TRUE = nominal_cam_T_grip()
BROWN = BrownConradyLens(
    width_px=640, height_px=480, fx_px=600.0, fy_px=601.0, cx_px=320.0, cy_px=240.5, coefficients=(-0.1, 0.02, 0.0, 0.0)
)
SIGMAS = np.array([2e-5, 2e-5, 5e-5, 3e-4, 3e-4, 3e-4])
CONFIG = {
    "robot": "arm", "camera_name": "wrist", "gripper": "gripper.yaml", "reference": "hand_eye.yaml",
    "source": {"kind": "folder", "path": "."}, "jaw": {"opening_m": OPENING_M},
}  # fmt: skip


def write(path: Path, values: object) -> Path:
    path.write_text(as_yaml(json.loads(msgspec.json.encode(values))))
    return path


def camera_file(path: Path, lens: LensSettings, sigmas: dict[str, float]) -> Path:
    return write(
        path,
        CameraCalibration(
            camera=lens,
            parameters=tuple(sigmas),
            covariance=tuple(np.diag(np.square(list(sigmas.values()))).ravel().tolist()),
            residuals=CameraResiduals(rms_px=0.031, views=9, points=500, outliers=0),
            target="chequerboard:9x6:0.025",
            provenance=provenance_of("gripmon calibrate intrinsics x.png"),
        ),
    )


def hand_eye_file(path: Path, xi: np.ndarray | None = None, sigmas: np.ndarray = SIGMAS) -> Path:
    return write(
        path,
        HandEyeCalibration(
            camera=PAPER_LENS,
            gripper=CalibratedGripper(name=sharp_gripper().name, sha256=gripper_digest(sharp_gripper())),
            jaw_opening_m=OPENING_M,
            cam_T_grip=to_record(TRUE if xi is None else perturb(TRUE, xi)),
            covariance=tuple(np.diag(sigmas**2).ravel().tolist()),
            residuals=HandEyeResiduals(rms_m=1e-5, rms_px=0.05, corners=8, images=1),
            provenance=provenance_of("gripmon calibrate plane p.png"),
        ),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration with its files, and images: of the gripper on a plate, of it anywhere, of nothing."""
    folder = tmp_path_factory.mktemp("made")
    cv2.imwrite(str(folder / "plate.png"), standing(DISCS, look=Look(supersampling=3)))
    for seed in (1, 2):
        view = simulator(plain_scenario(sensor=Sensor()), seed=seed, cam_T_grip=TRUE)
        assert view.truth(0).jaw_opening_m == OPENING_M
        cv2.imwrite(str(folder / f"free{seed}.png"), view.render(0))
    cv2.imwrite(str(folder / "empty.png"), np.full((576, 768), 128, np.uint8))
    write(folder / "gripper.yaml", contents_of(sharp_gripper().model))
    hand_eye_file(folder / "hand_eye.yaml")
    camera_file(folder / "camera.yaml", BROWN, {"fx_px": 0.4, "fy_px": 0.4, "coefficients.0": 1e-3})
    write(folder / "config.yaml", {**CONFIG, "camera": msgspec.to_builtins(PAPER_LENS)})
    return folder


def gripmon(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        code = main(["calibrate", *map(str, arguments)])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, said.out, said.err


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("ros", ".yaml"), ("kalibr", ".yaml"), ("opencv", ".xml"), ("opencv", ".json"), ("mrcal", ".cameramodel")],
)
def test_a_camera_goes_out_and_comes_back(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, suffix: str
):
    theirs, back = tmp_path / f"theirs{suffix}", tmp_path / "back.yaml"
    assert gripmon(capsys, "export", made / "camera.yaml", "--format", kind, "--out", theirs)[0] == 0
    text = theirs.read_text()
    for part in ("calibrate export", sha256_of(made / "camera.yaml"), "calibrate intrinsics x.png", "fx_px 600 ± 0.4"):
        assert part in text
    assert gripmon(capsys, "import", theirs, "--out", back)[0] == 0
    found = read_camera(back)
    assert found.camera.coefficients[:4] == BROWN.coefficients and found.camera.fx_px == BROWN.fx_px
    assert found.parameters == () and found.residuals is None and "imported from" in found.warnings[0]
    assert found.provenance.inputs[0].sha256 == sha256_of(theirs)
    code, out, _ = gripmon(capsys, "verify", made / "camera.yaml", back)
    assert code == 0 and out.splitlines()[-1].startswith("same")


def test_an_imported_camera_serves_a_configuration(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    theirs = tmp_path / "theirs.yaml"
    code, _, said = gripmon(capsys, "export", made / "hand_eye.yaml", "--format", "ros", "--fit", "--out", theirs)
    assert code == 0 and "nearest Brown-Conrady" in said
    assert gripmon(capsys, "import", theirs, "--out", tmp_path / "camera.yaml")[0] == 0
    (tmp_path / "gripper.yaml").write_bytes((made / "gripper.yaml").read_bytes())
    pose = msgspec.to_builtins(to_record(TRUE))
    reference = {"cam_T_grip": pose, "position_sigma_m": 1e-4, "rotation_sigma_rad": 1e-3}
    values = {**CONFIG, "camera": "camera.yaml", "reference": reference}
    config = load_config(write(tmp_path / "config.yaml", values), check_source=False)
    assert config.camera.settings.coefficients == read_camera(tmp_path / "camera.yaml").camera.coefficients


def test_the_hand_eye_of_every_source_is_the_same(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    record = ReferenceRecord(
        "r-1", 3, 5, "recalibration", to_record(TRUE), tuple(np.diag(SIGMAS**2).ravel().tolist()), cause=Cause.UNKNOWN
    )
    state = tmp_path / "arm-wrist.json"
    state.write_bytes(pack(Owner("arm", "wrist", Calibration("a", "b", "c")), MonitorState(references=(record,))))
    seen = []
    for source in (made / "hand_eye.yaml", made / "config.yaml", state):
        code, out, _ = gripmon(capsys, "export", source, "--format", "urdf", "--gripper-frame", "tool0")
        assert code == 0
        text = f'<robot name="r"><link name="tool0"/><link name="camera_optical_frame"/>{out}</robot>'
        (joint,) = URDF.from_xml_string(text).joints
        seen.append([*joint.origin.xyz, *joint.origin.rpy])
        for other in (made / "hand_eye.yaml", state):
            assert gripmon(capsys, "verify", source, other)[0] == 0
    assert np.allclose(seen, seen[0], rtol=0.0, atol=1e-15)
    assert "revision 3, recalibration" in gripmon(capsys, "export", state, "--format", "ros-static")[1]
    easy = gripmon(capsys, "export", state, "--format", "easy_handeye2", "--name", "wrist")[1]
    assert yaml.full_load(easy)["parameters"]["name"] == "wrist"


def test_a_projects_folder_stands_for_the_calibration_that_is_meant(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Its camera or its hand/eye calibration, by the format; beside --config, a folder is one of images."""
    for kind, file in (("ros", "camera.yaml"), ("urdf", "hand_eye.yaml")):
        of_file, of_folder = (gripmon(capsys, "export", each, "--format", kind) for each in (made / file, made))
        assert of_file[0] == 0 and _undated(of_folder[1]) == _undated(of_file[1])
    hand_eye_file(tmp_path / "hand_eye.yaml", np.array([0.0, 3e-4, 0.0, 0.0, 0.0, 0.0]))
    by_file = gripmon(capsys, "verify", made / "hand_eye.yaml", tmp_path / "hand_eye.yaml", "--json")
    assert gripmon(capsys, "verify", made, tmp_path, "--json") == by_file and by_file[0] == 3
    code, _, said = gripmon(capsys, "verify", made, tmp_path, "--config", made)
    assert code == 2 and f"{tmp_path}: no image in this folder" in said


def _undated(text: str) -> str:
    return "\n".join(line for line in text.splitlines() if "written " not in line)


def test_the_last_valid_estimate_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = msgspec.structs.replace(MEASURED, cam_T_grip=to_record(TRUE), seq=1)
    path = tmp_path / "estimates.jsonl"
    path.write_bytes(b"\n".join(map(to_json, (other, MEASURED, NOTHING))) + b"\n\n")
    code, out, _ = gripmon(capsys, "export", path, "--format", "json")
    content = json.loads(out)
    assert code == 0 and content["cam_T_grip"] == json.loads(to_json(MEASURED.cam_T_grip))
    assert f"frame {MEASURED.seq} (line 2)" in " ".join(content["notes"])
    # Of a daemon that was killed, or writes just now; a broken line before others is none of its.
    path.write_bytes(to_json(MEASURED) + b"\n" + to_json(other)[:200])
    code, out, _ = gripmon(capsys, "export", path, "--format", "json")
    assert code == 0 and f"frame {MEASURED.seq} (line 1), line 2 is unfinished" in ", ".join(json.loads(out)["notes"])
    path.write_bytes(to_json(MEASURED) + b"\n" + to_json(other)[:200] + b"\n")
    assert gripmon(capsys, "export", path, "--format", "json")[0] == 2
    path.write_bytes(to_json(NOTHING))
    code, _, said = gripmon(capsys, "export", path, "--format", "json")
    assert code == 2 and "no line has a valid transform" in said


def test_verify_tells_equal_hand_eyes_from_different_ones(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    near = hand_eye_file(tmp_path / "near.yaml", 0.5 * SIGMAS)
    far = hand_eye_file(tmp_path / "far.yaml", np.array([0.0, 3e-4, 0.0, 0.0, 0.0, 0.0]))
    code, out, _ = gripmon(capsys, "verify", made / "hand_eye.yaml", near)
    assert code == 0 and out.splitlines()[-1] == "same (not distinguished at a level of 0.01)"
    code, out, _ = gripmon(capsys, "verify", made / "hand_eye.yaml", far)
    assert code == 3 and re.search(r"\ny +0\.3 +0\.02828 +0 ", out) and "TCP 0.3 mm, turn 0°" in out
    assert out.splitlines()[-1] == "different (at a level of 0.01)"
    code, out, _ = gripmon(capsys, "verify", made / "hand_eye.yaml", far, "--json")
    values = json.loads(out)
    assert code == 3 and values["same"] is False and values["kind"] == "hand_eye"
    assert values["chi2"] == pytest.approx((3e-4) ** 2 / (2 * (2e-5) ** 2), rel=1e-6)
    bounds = ("--tolerance-mm", 0.5, "--tolerance-deg", 0.1)
    code, out, _ = gripmon(capsys, "verify", made / "hand_eye.yaml", far, *bounds)
    assert code == 0 and out.splitlines()[-1] == "same: within the tolerance"


def test_verify_of_cameras_needs_an_uncertainty_or_a_tolerance(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other = msgspec.structs.replace(BROWN, fx_px=605.0)
    certain = camera_file(tmp_path / "certain.yaml", other, {"fx_px": 0.4})
    code, out, _ = gripmon(capsys, "verify", made / "camera.yaml", certain, "--json")
    values = json.loads(out)
    assert code == 3 and values["kind"] == "camera" and values["p_value"] < 0.001
    assert values["largest_px"] == pytest.approx(5.0 / 600.0 * 320.0, rel=0.02)
    unknown = [camera_file(tmp_path / f"{n}.yaml", lens, {}) for n, lens in enumerate((BROWN, other))]
    code, _, said = gripmon(capsys, "verify", *unknown)
    assert code == 2 and "neither says how certain it is; --tolerance-px" in said
    assert gripmon(capsys, "verify", *unknown, "--tolerance-px", 3)[0] == 0
    code, out, _ = gripmon(capsys, "verify", *unknown, "--tolerance-px", 2)
    assert code == 3 and out.splitlines()[-1] == "different: beyond the tolerance"


@pytest.mark.parametrize("target", [True, False])
def test_fresh_images_confirm_a_calibration_and_contradict_a_moved_camera(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], target: bool
):
    options = ("--target", "circles:12x10:0.008:0.004") if target else ()
    images = [made / "plate.png"] if target else [made / "free1.png", made / "free2.png"]
    last = (*images, "--config", made / "config.yaml", *options, "--json")
    code, out, said = gripmon(capsys, "verify", made / "hand_eye.yaml", *last)
    assert code == 0, (out, said)
    assert np.linalg.norm(json.loads(out)["position_m"]) < 3e-4
    shift = np.array([8e-4, -5e-4, 0.0, 0.0, 0.0, 0.0])
    moved = hand_eye_file(tmp_path / "moved.yaml", shift)
    code, out, said = gripmon(capsys, "verify", moved, *last)
    assert code == 3, (out, said)
    values = json.loads(out)
    assert np.allclose(values["position_m"], -shift[:3], atol=4e-4) and values["position_p_value"] < 0.001


def test_images_of_another_pose_are_left_out_unless_they_are_half(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    moved = perturb(TRUE, np.array([1.5e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for seed in (3, 4):
        view = simulator(plain_scenario(sensor=Sensor()), seed=seed, cam_T_grip=moved)
        cv2.imwrite(str(tmp_path / f"other{seed}.png"), view.render(0))
    same = (made / "hand_eye.yaml", made / "free1.png", made / "free2.png")
    last = ("--config", made / "config.yaml")
    code, out, said = gripmon(capsys, "verify", *same, tmp_path / "other3.png", *last)
    assert code == 0 and "other3.png: contradicts the other images" in out, (out, said)
    code, out, said = gripmon(capsys, "verify", *same, tmp_path / "other3.png", tmp_path / "other4.png", *last)
    assert code == 3 and not out and "only 2 of 4 images agree" in said and said.count("\n") == 1
    code, out, said = gripmon(capsys, "verify", *same[:2], tmp_path / "other3.png", *last)
    assert code == 3 and not out and "no two of 2 images agree" in said
    code, out, _ = gripmon(capsys, "verify", *same[:2], *last)
    assert code == 0 and "free1.png alone: nothing confirms" in out


BAD: list[tuple[tuple[object, ...], str]] = [
    (("export", "camera.yaml", "--format", "urdf"), "camera.yaml: is a camera calibration, which has no hand/eye"),
    (("export", "hand_eye.yaml", "--format", "ros"), "hand_eye.yaml: camera.model: ros has no lens like this"),
    (("export", "hand_eye.yaml", "--format", "urdf", "--fit"), "--fit: has no meaning with --format urdf"),
    (("export", "camera.yaml", "--format", "ros", "--camera-frame", "x"), "--camera-frame: has no meaning"),
    (("export", "hand_eye.yaml", "--format", "json", "--robot-base-frame", "x"), "--robot-base-frame: has no meaning"),
    (("export", "hand_eye.yaml", "--format", "urdf", "--camera-frame", "a b"), "camera_frame: 'a b' isn't a frame's"),
    (("export", "hand_eye.yaml", "--format", "urdf", "--name", "a b"), "--name: a b: isn't a plain name"),
    (("export", "camera.yaml", "--format", "ros", "--out", "camera.yaml"), "camera.yaml: is there already"),
    (("export", "nothing.yaml", "--format", "ros"), "nothing.yaml: there is no such file"),
    (("export", "gripper.yaml", "--format", "ros"), "gripper.yaml: holds no calibration"),
    (("export", "plate.png", "--format", "ros"), "plate.png: is not text"),
    (("export", "estimates.jsonl", "--format", "json"), "estimates.jsonl: line 1: isn't an estimate"),
    (("import", "gripper.yaml", "--out", "new.yaml"), "gripper.yaml: is in no format that is recognised"),
    (("import", "gripper.yaml", "--out", "new.yaml", "--model", "omni"), "'omni'"),
    (("import", "gripper.yaml", "--out", "new.yaml", "--size", "big"), "'big' isn't an image size"),
    (("verify", "camera.yaml", "hand_eye.yaml"), "640 x 480 px and of 768 x 576 px"),
    (("verify", "hand_eye.yaml", "hand_eye.yaml", "hand_eye.yaml"), "hand_eye.yaml: a third calibration"),
    (("verify", "hand_eye.yaml", "hand_eye.yaml", "--config", "config.yaml"), "--config: applies only"),
    (("verify", "hand_eye.yaml", "hand_eye.yaml", "--tolerance-mm", "1"), "--tolerance-deg: one without the other"),
    (("verify", "hand_eye.yaml", "hand_eye.yaml", "--level", "2"), "'2' isn't a probability of a false alarm"),
    (("verify", "hand_eye.yaml", "free1.png"), "--config: is missing"),
    (("verify", "camera.yaml", "free1.png", "--config", "config.yaml"), "camera.yaml: is a camera calibration"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "said"), BAD)
def test_bad_input_is_one_clear_line(
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[object, ...],
    said: str,
):
    for file in made.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "estimates.jsonl").write_text('{"seq": 1}\n')
    monkeypatch.chdir(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    code, out, error = gripmon(capsys, *arguments)
    assert code == 2 and said in error and not out
    assert error.startswith("usage:") or error.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_the_plate_in_another_size_is_refused(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    of_a_plate = read_yaml(made / "hand_eye.yaml")
    of_a_plate["provenance"]["command"] = "gripmon calibrate plane a.png --target circles:12x10:0.016:0.008"
    (tmp_path / "hand_eye.yaml").write_text(as_yaml(of_a_plate))
    images = made / "plate.png", "--config", made / "config.yaml", "--target", "circles:12x10:0.008:0.004"
    code, out, said = gripmon(capsys, "verify", tmp_path / "hand_eye.yaml", *images)
    assert code == 2 and not out and said.count("\n") == 1
    assert "hand_eye.yaml was made with circles:12x10:0.016:0.008, the same pattern in another size" in said
    assert gripmon(capsys, "verify", tmp_path / "hand_eye.yaml", *images, "--other-target")[0] == 0


def test_images_that_show_nothing_fail_with_the_reason(made: Path, capsys: pytest.CaptureFixture[str]):
    for options in ((), ("--target", "circles:12x10:0.008:0.004")):
        code, out, said = gripmon(
            capsys, "verify", made / "hand_eye.yaml", made / "empty.png", "--config", made / "config.yaml", *options
        )
        assert code == 3 and not out and "empty.png: " in said and said.count("\n") == 1
