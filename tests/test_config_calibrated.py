"""A configuration that names files of the off-line methods, and every way in which they don't belong to it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.hand_eye_texts import FILES, GRIP_T_CAM
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip

from gripmon.calibrate.documents import CalibratedGripper, CameraCalibration, HandEyeCalibration, HandEyeResiduals
from gripmon.calibrate.interchange import write_camera
from gripmon.daemon.calibrations import read_calibrated
from gripmon.daemon.config import ConfigError, load_config, read_gripper
from gripmon.daemon.config.recorded import from_recorded, to_recorded
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.judge.statefile import calibration_of
from gripmon.model.camera import BrownConradyLens
from gripmon.model.errors import InputError
from gripmon.model.geometry import to_record
from gripmon.model.provenance import provenance_of
from gripmon.model.yaml_text import as_yaml
from gripmon.track.edges.taught import gripper_digest

Written = Callable[[dict[str, Any]], dict[str, Any]]
ARM, CAM, HE = "arm.yaml", "camera.yaml", "hand_eye.yaml"
BROWN = BrownConradyLens(
    **{key: getattr(PAPER_LENS, key) for key in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")},
    coefficients=(-0.1, 0.01, 0.0, 0.0, 0.0),
)
COVARIANCE = tuple(np.diag([1e-10] * 3 + [1e-8] * 3).ravel().tolist())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    gripper = read_gripper(BOX_FINGERS)
    camera = CameraCalibration(
        camera=PAPER_LENS, parameters=("fx_px",), covariance=(0.01,), provenance=provenance_of("a")
    )
    hand_eye = HandEyeCalibration(
        camera=PAPER_LENS,
        gripper=CalibratedGripper(name=gripper.name, sha256=gripper_digest(gripper)),
        cam_T_grip=to_record(nominal_cam_T_grip()),
        covariance=COVARIANCE,
        residuals=HandEyeResiduals(rms_m=1e-5, rms_px=0.1, corners=4, images=1),
        provenance=provenance_of("b"),
    )
    for name, document in (("camera.yaml", camera), ("hand_eye.yaml", hand_eye)):
        (tmp_path / name).write_text(as_yaml(json.loads(msgspec.json.encode(document))))
    (tmp_path / "gripper.yaml").write_text(BOX_FINGERS.read_text())
    settings = {
        "robot": "arm",
        "camera_name": "wrist",
        "camera": "camera.yaml",
        "gripper": "gripper.yaml",
        "reference": "hand_eye.yaml",
        "source": {"kind": "folder", "path": "."},
    }
    (tmp_path / "arm.yaml").write_text(as_yaml(settings))
    return tmp_path


def change(path: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    values = read_yaml(path)
    edit(values)
    path.write_text(as_yaml(values))


def sections() -> dict[str, Any]:
    transform = to_record(nominal_cam_T_grip())
    reference = {"cam_T_grip": json.loads(msgspec.json.encode(transform)), "covariance": list(COVARIANCE)}
    return {"camera": json.loads(msgspec.json.encode(PAPER_LENS)), "reference": reference}


def test_files_and_sections_say_the_same(folder: Path):
    by_files = load_config(folder / "arm.yaml")
    change(folder / "arm.yaml", lambda v: v.update(sections()))
    by_sections = load_config(folder / "arm.yaml")
    assert by_files.settings == by_sections.settings and by_files.reference == by_sections.reference
    assert by_files.calibrated.paths == {"camera": folder / "camera.yaml", "reference": folder / "hand_eye.yaml"}
    assert by_sections.calibrated.paths == {}
    assert by_files.reference.covariance == COVARIANCE and not by_files.reference.with_gripper


@pytest.mark.parametrize("written", [lambda lens: lens, lambda lens: {"camera": lens}], ids=["bare", "as the section"])
def test_a_camera_as_a_configuration_has_it_may_stand_in_a_file_of_its_own(folder: Path, written: Written):
    by_calibration = load_config(folder / "arm.yaml")
    lens = {**sections()["camera"], "model": "paper"}
    (folder / "lens.yaml").write_text(as_yaml(written(lens)))
    change(folder / "arm.yaml", lambda v: v.update(camera="lens.yaml"))
    assert load_config(folder / "arm.yaml").settings == by_calibration.settings
    assert read_calibrated(folder / "lens.yaml").lens == by_calibration.settings.camera  # as an option names it
    (folder / "lens.yaml").write_text(as_yaml(written({**lens, "fx_px": "wide"})))
    with pytest.raises(ConfigError, match=r"lens\.yaml: fx_px: "):
        load_config(folder / "arm.yaml")


def test_a_projects_folder_is_its_configuration(folder: Path):
    (folder / ARM).rename(folder / "config.yaml")
    assert load_config(folder).path == folder / "config.yaml"


def test_the_response_that_a_references_images_show_holds_where_nothing_else_is_said(folder: Path):
    def response() -> tuple[str, bool]:
        config = load_config(folder / "arm.yaml")
        return config.settings.monitor.corners.edges.response, config.knows_response

    assert response() == ("linear", False)
    change(folder / "hand_eye.yaml", lambda v: v.update(response="unknown"))
    assert response() == ("unknown", True)
    said = {"corners": {"edges": {"response": "srgb"}}}
    change(folder / "arm.yaml", lambda v: v.setdefault("monitor", {}).update(said))
    assert response() == ("srgb", True)


def test_a_reference_of_the_gripper_files_own_images_stays_one(folder: Path):
    """Through a configuration's file or section, to what is taught."""
    change(folder / "hand_eye.yaml", lambda v: v.update(with_gripper=True))
    by_files = load_config(folder / "arm.yaml")
    change(folder / "arm.yaml", lambda v: v.update(sections()))
    change(folder / "arm.yaml", lambda v: v["reference"].update(with_gripper=True))
    by_sections = load_config(folder / "arm.yaml")
    assert by_files.reference == by_sections.reference and by_files.reference.with_gripper
    for file in ("hand_eye.yaml", "arm.yaml"):
        assert read_calibrated(folder / file).with_gripper


@pytest.mark.parametrize(
    ("file", "edit", "line"),
    [
        (ARM, lambda v: v.update(camera="none.yaml"), "arm.yaml: camera: there is no file"),
        (ARM, lambda v: v.update(reference="none.yaml"), "or another program's hand/eye result, its path"),
        (ARM, lambda v: v.update(camera="hand_eye.yaml"), "hand_eye.yaml: is a file of gripmon calibrate plane; "),
        (ARM, lambda v: v.update(gripper="camera.yaml"), "is a file of gripmon calibrate intrinsics; a gripper file"),
        (ARM, lambda v: v.update(taught="gripper.yaml"), "gripper.yaml: is a gripper file; a taught model"),
        (CAM, lambda v: v.update(schema="gripmon.camera_calibration/2"), "schema: is 'gripmon.camera_calibration/2'; "),
        (ARM, lambda v: v.update(reference="gripper.yaml"), "gripper.yaml: is a gripper file; a file of gripmon "),
        (CAM, lambda v: v.update(covariance=[1.0, 2.0]), "camera.yaml: covariance: has 2 values for 1 parameters"),
        (CAM, lambda v: v["camera"].update(fx_px=-1.0), "camera.yaml: camera.fx_px: "),
        (CAM, lambda v: v["camera"].update(focal=9.0), "camera.yaml: camera.focal: unknown key"),
        (CAM, lambda v: v["camera"].update(fx_px=970.0), "hand_eye.yaml: camera: isn't the camera that is given"),
        ("gripper.yaml", lambda v: v["points"]["L_in_far"].update(xyz_m=[-0.0171, 0.008, 0.0]),
         "hand_eye.yaml: gripper: is two_box_fingers with other contents"),
        (HE, lambda v: v["gripper"].update(name="other", sha256="0" * 64), "gripper: is other, the"),
        ("gripper.yaml", lambda v: v.update(name="renamed"),
         ("gripper: is two_box_fingers, the one given is renamed, the same except for its name; "
          "name: two_box_fingers in the gripper file")),
        (HE, lambda v: v["cam_T_grip"].update(translation_m=[0.0, 0.0, -0.1]),
         "hand_eye.yaml: cam_T_grip.translation_m: puts the TCP behind the camera"),
        (HE, lambda v: v["cam_T_grip"].update(translation_m=[0.2, 0.0, 0.05]),
         "puts all corners outside of the image, along the camera's x: the axes of a ROS body such as camera_link"),
        (HE, lambda v: v["cam_T_grip"].update(translation_m=[0.2, 0.0, 0.001]),
         "puts the TCP along the camera's x: the axes of a ROS body such as camera_link"),
        (HE, lambda v: v.update(covariance=[0.0] * 36), "hand_eye.yaml: covariance: has a variance of zero"),
        (HE, lambda v: v.update(covariance=[0.0] * 35), "hand_eye.yaml: covariance: has 35 values"),
        (HE, lambda v: v.pop("provenance"), "hand_eye.yaml: provenance: is missing"),
    ],
)  # fmt: skip
def test_what_doesnt_belong_together_is_one_clear_line(
    folder: Path, file: str, edit: Callable[[dict[str, Any]], object], line: str
):
    change(folder / file, edit)
    with pytest.raises(ConfigError) as caught:
        load_config(folder / "arm.yaml")
    assert line in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "kind", "key"),
    [
        (CAM, "a file of gripmon calibrate intrinsics", "camera"),
        (HE, "a file of gripmon calibrate plane", "reference"),
        ("gripper.yaml", "a gripper file", "gripper"),
    ],
)
def test_a_file_that_belongs_into_a_configuration_is_named_and_where(
    folder: Path, file: str, kind: str, key: str
):
    with pytest.raises(ConfigError) as caught:
        load_config(folder / file)
    right = f"a configuration, such as gripmon teach writes; this file belongs there under {key}"
    assert str(caught.value) == f"{folder / file}: is {kind}; {right}"


def listed(transform: np.ndarray) -> dict[str, Any]:
    return json.loads(msgspec.json.encode(to_record(transform)))


@pytest.mark.parametrize("name", FILES)
def test_another_program_s_hand_eye_result_is_a_reference(folder: Path, name: str):
    """Of the flange; where the TCP is in it says the configuration."""
    (folder / "theirs").write_text(FILES[name])
    tcp = listed(GRIP_T_CAM @ nominal_cam_T_grip())
    section = {"hand_eye": "theirs", "flange_T_tcp": tcp, "position_sigma_m": 0.002}
    change(folder / "arm.yaml", lambda v: v.update(reference=section))
    config = load_config(folder / "arm.yaml")
    np.testing.assert_allclose(config.cam_T_grip, nominal_cam_T_grip(), rtol=0.0, atol=1e-7)
    assert config.reference.covariance[0] == 0.002**2 and config.calibrated.hand_eye is None
    kept = from_recorded(to_recorded(config), empty(folder / "again"))
    assert kept.reference == config.reference


def empty(folder: Path) -> Path:
    folder.mkdir()
    return folder


def test_where_the_tcp_is_may_stand_in_the_robot_s_own_file(folder: Path):
    flange = {"flange_T_cam": listed(GRIP_T_CAM), "flange_T_tcp": listed(GRIP_T_CAM @ nominal_cam_T_grip())}
    (folder / "robot.yaml").write_text(as_yaml(flange))
    change(folder / "arm.yaml", lambda v: v.update(reference="robot.yaml"))
    config = load_config(folder / "arm.yaml")
    np.testing.assert_allclose(config.cam_T_grip, nominal_cam_T_grip(), rtol=0.0, atol=1e-7)
    (folder / "robot.yaml").write_text(as_yaml({"flange_T_cam": flange["flange_T_cam"]}))
    change(
        folder / "arm.yaml",
        lambda v: v.update(reference={"hand_eye": "robot.yaml", "flange_T_tcp": flange["flange_T_tcp"]}),
    )
    np.testing.assert_allclose(
        load_config(folder / "arm.yaml").cam_T_grip, nominal_cam_T_grip(), rtol=0.0, atol=1e-7
    )
    (folder / "robot.yaml").write_text(as_yaml({"flange_T_cam": flange["flange_T_cam"], "flange_frame": ""}))
    change(folder / "arm.yaml", lambda v: v.update(reference="robot.yaml"))
    with pytest.raises(InputError, match=r"flange_T_tcp: isn't said: where the TCP .* is in flange"):
        load_config(folder / "arm.yaml")
    for tcp in (None, listed(np.eye(4))):  # beside one that is there, it would be said twice
        section = {"hand_eye": "robot.yaml", "flange_T_tcp": listed(np.eye(4))} if tcp else "robot.yaml"
        (folder / "robot.yaml").write_text(as_yaml({**flange, "flange_T_tcp": tcp}))
        change(folder / "arm.yaml", lambda v, section=section: v.update(reference=section))
        with pytest.raises(InputError, match="is said by .*robot.yaml, too" if tcp else "flange_T_tcp: isn't said"):
            load_config(folder / "arm.yaml")


@pytest.mark.parametrize(
    ("section", "line"),
    [
        ("theirs", "theirs: flange_T_tcp: isn't said: where the TCP (between the fingertips, x across the jaws, z out"),
        ("theirs", "arm.yaml: reference: {hand_eye: theirs, flange_T_tcp: …} {translation_m: [x, y, z], rotation_xyzw"),
        ({"hand_eye": 3}, "arm.yaml: reference.hand_eye: is 3; a file of gripmon calibrate plane or another program's"),
        ({"hand_eye": "theirs", "flange_T_tcp": {"translation_m": [0, 0, 1], "rotation_xyzw": [1, 1, 0, 0]}},
         "arm.yaml: reference.flange_T_tcp.rotation_xyzw: has length 1.414; a unit quaternion"),
        ({"hand_eye": "theirs", "flange_T_tcp": {"translation_m": [0, 0, 120.0], "rotation_xyzw": [0, 0, 0, 1]}},
         "theirs: cam_T_grip.translation_m: puts the TCP 120.119 m from the camera; metres"),
        ({"hand_eye": "theirs", "cam_T_grip": {}}, "arm.yaml: reference.cam_T_grip: has no place beside hand_eye"),
        ({"hand_eye": HE, "id": "a"}, "arm.yaml: reference.id: stands beside hand_eye.yaml, a file of gripmon's that"),
        (CAM, "camera.yaml: is a file of gripmon calibrate intrinsics; a file of gripmon calibrate plane"),
        ({"hand_eye": ARM, "flange_T_tcp": {}}, "arm.yaml: is a configuration; a file of gripmon calibrate plane, a"),
    ],
)  # fmt: skip
def test_a_reference_that_says_too_little_or_too_much_is_one_line(folder: Path, section: Any, line: str):
    (folder / "theirs").write_text(FILES["easy_handeye"])
    change(folder / "arm.yaml", lambda v: v.update(reference=section))
    with pytest.raises(InputError) as caught:
        load_config(folder / "arm.yaml")
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_another_program_s_file_is_opened_once(folder: Path, monkeypatch: pytest.MonkeyPatch):
    (folder / "theirs").write_text(FILES["easy_handeye"])
    lens = CameraCalibration(camera=BROWN, parameters=(), covariance=(), provenance=provenance_of("a"))
    (folder / "camera_info").write_bytes(write_camera(lens.camera, "ros", (), name="wrist", file="x").data)
    tcp = listed(GRIP_T_CAM @ nominal_cam_T_grip())
    section = {"hand_eye": "theirs", "flange_T_tcp": tcp}
    change(folder / "arm.yaml", lambda v: v.update(camera="camera_info", reference=section))
    opened: list[str] = []
    real = Path.open

    def counted(path: Path, *args: Any, **options: Any) -> Any:
        opened.append(path.name)
        return real(path, *args, **options)

    monkeypatch.setattr(Path, "open", counted)
    load_config(folder / "arm.yaml")
    read_calibrated(folder / "camera_info")
    assert [opened.count(name) for name in ("theirs", "camera_info")] == [1, 2]


def test_a_file_of_corners_or_of_the_set_up_is_no_configuration_either(tmp_path: Path):
    for text, kind in (("corners: {a: [1, 2]}", "a file with corners"), ("accepted: {}", "the entries of gripmon")):
        (tmp_path / "a.yaml").write_text(text)
        with pytest.raises(ConfigError, match=f"a.yaml: is {kind}"):
            load_config(tmp_path / "a.yaml")


def test_where_a_gripper_file_comes_from_changes_no_digest(folder: Path):
    before = load_config(folder / "arm.yaml")
    values = json.loads(msgspec.json.encode(provenance_of("elsewhere")))
    change(folder / "gripper.yaml", lambda v: v.update(provenance=values))
    after = load_config(folder / "arm.yaml")
    assert after.gripper.model.provenance is not None and before.gripper.model.provenance is None
    assert gripper_digest(after.gripper) == gripper_digest(before.gripper)
    lens, reference = before.camera.settings, before.reference
    assert calibration_of(lens, after.gripper.model, reference) == calibration_of(lens, before.gripper.model, reference)
