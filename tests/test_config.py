"""Configuration: what is right loads to what it says; what is wrong is one line that names file, key and remedy."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats

from gripmon.daemon.config import ConfigError, builtin_config, load_config
from gripmon.judge.policy import PolicySettings

ROOT = Path(__file__).resolve().parent.parent
GRIPPERS = ROOT / "configs" / "grippers"

SOUND = """\
robot: arm1
camera_name: wrist
gripper: gripper.yaml
camera:
  model: paper
  width_px: 768
  height_px: 576
  fx_px: 962
  fy_px: 962
  cx_px: 383.5
  cy_px: 287.5
  kappa_per_px2: 1.9e-7
reference:
  cam_T_grip:
    translation_m: [0.0, 0.0014, 0.1188]
    rotation_xyzw: [0.25881905, 0.0, 0.0, 0.96592583]
source: {kind: live, device: 0}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "gripper.yaml").write_text((GRIPPERS / "two_box_fingers.yaml").read_text())
    (tmp_path / "config.yaml").write_text(SOUND)
    return tmp_path


def edited(folder: Path, pattern: str, replacement: str, file: str = "config.yaml") -> Path:
    path = folder / file
    text = path.read_text()
    changed = re.sub(pattern, replacement, text, count=1, flags=re.MULTILINE)
    assert changed != text, "the edit has to change something"
    path.write_text(changed)
    return folder / "config.yaml"


def test_a_sound_configuration_means_what_it_says(folder: Path):
    config = load_config(folder / "config.yaml")
    assert (config.settings.robot, config.settings.camera_name) == ("arm1", "wrist")
    assert config.camera.fx_px == 962.0
    assert config.jaw_opening_m == config.gripper.jaw_nominal_m == 0.034
    half = math.radians(30.0) / 2.0
    assert math.isclose(config.reference.cam_T_grip.rotation_xyzw[0], math.sin(half), rel_tol=1e-7)
    turn = np.array(
        [[1, 0, 0], [0, math.cos(2 * half), -math.sin(2 * half)], [0, math.sin(2 * half), math.cos(2 * half)]]
    )
    np.testing.assert_allclose(config.cam_T_grip[:3, :3], turn, atol=1e-7)
    np.testing.assert_allclose(config.cam_T_grip[:3, 3], [0.0, 0.0014, 0.1188])


FAULTS = [
    # pattern, replacement, key, what must be said
    ("^robot:", "robbot:", "robbot", "did you mean 'robot'"),
    ("^robot: arm1", "robot: a/b", "robot", "none of / "),
    ("^robot: arm1", "robot: a*", "robot", "none of / "),
    ("^robot: arm1", "robot: ''", "robot", "none of / "),
    ("^robot: arm1", "robot: 7", "robot", "text"),
    ("^robot: arm1", "robot: a\nrobot: b", "line 2", "twice"),
    ("^camera_name: .*\n", "", "camera_name", "is missing"),
    ("fx_px: 962", "fx_px: 0.9", "camera.fx_px", "metres"),
    ("fx_px: 962", "fx_px: nine", "camera.fx_px", "a number > 0"),
    ("fx_px: 962", "fx_px: .nan", "camera.fx_px", "a number > 0"),
    ("fx_px: 962", "fx_px: -962", "camera.fx_px", "a number > 0"),
    ("  fx_px: 962\n", "", "camera.fx_px", "is missing"),
    ("fx_px: 962", "fx: 962", "camera.fx", "did you mean 'fx_px'"),
    ("fx_px: 962", "fx_px: 962\n  fx_px: 963", "line 9", "twice"),
    ("model: paper", "model: papper", "camera.model", "did you mean 'paper'"),
    ("  model: paper\n", "", "camera.model", "paper, brown_conrady or fisheye"),
    ("kappa_per_px2: 1.9e-7", "kappa_per_px2: 0.2", "camera.kappa_per_px2", "right would be"),
    ("cx_px: 383.5", "cx_px: 38350", "camera.cx_px", "right would be"),
    ("gripper: gripper.yaml", "gripper: missing.yaml", "gripper", "there is no file"),
    (r"0.1188\]", "-0.1188]", "reference.cam_T_grip.translation_m", "behind the camera"),
    (r"0.1188\]", "30.0]", "reference.cam_T_grip.translation_m", "30 mm were meant"),
    (r"0.1188\]", "118.8]", "reference.cam_T_grip.translation_m", "metres"),
    (r"0.1188\]", "0.0001188]", "reference.cam_T_grip.translation_m", "metres"),
    (
        r"0.1188\]\n.*",
        "0.02]\n    rotation_xyzw: [0.0, 0.70710678, 0.0, 0.70710678]",
        "reference.cam_T_grip",
        "corner R_out_near behind",
    ),
    (r"\[0.0, 0.0014", "[0.5, 0.0014", "reference.cam_T_grip", "outside of the image"),
    (r"\[0.0, 0.0014", "[0.068, 0.0014", "reference.cam_T_grip", "shows 2 corners"),
    (r"rotation_xyzw: .*", "rotation_xyzw: [30.0, 0.0, 0.0]", "reference.cam_T_grip.rotation_xyzw", "4 values"),
    (
        r"rotation_xyzw: .*",
        "rotation_xyzw: [30.0, 0.0, 0.0, 0.0]",
        "reference.cam_T_grip.rotation_xyzw",
        "unit quaternion",
    ),
    (r"translation_m: .*", "translation_m: {x: 0}", "reference.cam_T_grip.translation_m", "a list of 3"),
    ("^source: .*", "source: {kind: folder, path: nowhere}", "source.path", "there is no folder"),
    ("^source: .*", "source: {kind: video, path: nowhere.mp4}", "source.path", "there is no file"),
    ("^source: .*", "source: {kind: foldr, path: .}", "source.kind", "did you mean 'folder'"),
    ("^source: .*", "source: {kind: folder, path: ., fsp: 3}", "source.fsp", "did you mean 'fps'"),
    ("^source: .*", "source: folder", "source", "a section with the key `kind`"),
    ("^source: .*", "source: {kind: live, device: 0, fps: 0}", "source.fps", "> 0"),
    ("^source:", "jaw: {source: frames}\nsource:", "jaw.source", "fixed or zenoh"),
    ("^source:", "jaw: {opening_m: 34}\nsource:", "jaw.opening_m", "<= 0.5"),
    ("^source:", "jaw: {opening_m: 0.07}\nsource:", "jaw.opening_m", "0 to 0.06 m"),
    ("^source:", "jaw: {source: zenoh, opening_m: 0.03}\nsource:", "jaw.opening_m", "no effect"),
    ("^source:", "jaw: {source: zenoh}\npublish: {enabled: false}\nsource:", "jaw.source", "publish.enabled: true"),
    ("^source: .*", "source: {kind: zenoh}\npublish: {enabled: false}", "source.kind", "publish.enabled: true"),
    ("^source: .*", "source: {kind: zenoh, key: a/*}", "source.key", "without wildcards"),
    ("^source: .*", "source: {kind: zenoh, format: bmp}", "source.format", "auto, jpeg, png or raw"),
    ("^source:", "jaw: {source: ros2_joint_state, topic: /j}\nsource:", "jaw.topic", "a source of kind ros2"),
    ("^source:", "publish: {listen: [localhost]}\nsource:", "publish.listen[0]", "tcp/127.0.0.1:7447"),
    ("^source:", "monitor: {corner: {}}\nsource:", "monitor.corner", "unknown key"),
    ("^source:", "recording: {image_rate_hz: -1}\nsource:", "recording.image_rate_hz", "(Hz)"),
    ("^source:", "reference_: 3\nsource:", "reference_", "did you mean 'reference'"),
    ("^reference:", "reference: [", "line 15", "not YAML"),
    ("^reference:", "\treference:", "line 13", "not YAML"),
    ("^  cam_T_grip:", "  position_sigma_m: 5\n  cam_T_grip:", "reference.position_sigma_m", "(m)"),
    ("^  cam_T_grip:", "  covariance: [1, 2]\n  cam_T_grip:", "reference.covariance", "36"),
    ("fx_px: 962", "fx_px: 9620", "camera.fx_px and fy_px", "9620 px and 962 px differ too much; "),
    ("^source:", "jaw: {opening: 0.034}\nsource:", "jaw.opening", "unknown key, did you mean 'opening_m'?; "),
    ("^source:", "ros2: {enabled: yes}\nsource:", "ros2.enabled", "is 'yes'; true or false (true: also a ROS 2 node"),
    (
        "^source: .*",
        "source: {kind: zenoh}\njaw: {source: zenoh}\npublish: {enabled: false}",
        "source.kind",
        "is zenoh, but publish.enabled is false; publish.enabled: true",
    ),
    (
        "^source:",
        "monitor: {policy: {warn_m: 0.003}}\nsource:",
        "monitor.policy.warn_m",
        "0.003 is above limit_m, 0.0025; at most limit_m, or a larger limit_m",
    ),
    ("^source:", "monitor: {policy: {limit_rad: 0.001}}\nsource:", "monitor.policy.warn_rad", "0.003 is above"),
    ("^source:", "monitor: {recalibration: {frames: 70}}\nsource:", "monitor.recalibration.frames", "70 is above"),
    (
        "^source:",
        "monitor: {recalibration: {sure_sigma_m: 0.001}}\nsource:",
        "monitor.recalibration.sure_sigma_m",
        "above largest_sigma_m",
    ),
    ("^source:", "publish: {retry_first_s: 5}\nsource:", "publish.retry_first_s", "5 is above retry_longest_s, 1; "),
    ("device: 0", "device: 0, retry_longest_s: 0.1", "source.retry_first_s", "0.5 is above retry_longest_s, 0.1; "),
]


@pytest.mark.parametrize(
    ("pattern", "replacement", "key", "said"), FAULTS, ids=[f"{f[2]}-{i}" for i, f in enumerate(FAULTS)]
)
def test_a_fault_is_one_line_with_file_key_and_remedy(
    folder: Path, pattern: str, replacement: str, key: str, said: str
):
    path = edited(folder, pattern, replacement)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: {key}: "), text
    assert said in text
    assert "\n" not in text
    assert ";" in text, "what would be right comes after a semicolon"


GRIPPER_FAULTS = [
    (r"nominal_m: 0.034", "nominal_m: 34", "jaw.nominal_m", "jaw opening (m)"),
    (
        r"  L_in_near: {finger: left, xyz_m: \[-0.017",
        "  L_in_near: {finger: left, xyz_m: [-17.0",
        "points.L_in_near.xyz_m",
        "millimetres",
    ),
    (r"  L_in_near: {finger: left", "  L_in_near: {finger: lefft", "points.L_in_near.finger", "left, right"),
    (r"corner: true}", "cornr: true}", "points.L_in_near.cornr", "did you mean 'corner'"),
    (r"xyz_m: \[-0.017, -0.008, 0.0\]", "xyz_m: [-0.017, -0.008]", "points.L_in_near.xyz_m", "3 values"),
    (r"from: L_in_near, to", "frm: L_in_near, to", "edges.L_tip_in.frm", "did you mean 'from'"),
    (r"from: L_in_near, to", "from: no one, to", "edges.L_tip_in.from", "there is no point"),
    (r"^name: .*", "name: a\nname: b", "line 5", "twice"),
    (
        r"motion: {axis: .*}",
        "motion: {table: [[0, 0, 0], [1, 0, 0]]}}",
        "fingers.left.motion.table[0]",
        "has 3 values; a list of 4 values",
    ),
    (r"axis: \[[^\]]*\]", "axis: [1, 0, 0, 0]", "fingers.left.motion.axis", "has 4 values; a list of 3 values"),
]


@pytest.mark.parametrize(("pattern", "replacement", "key", "said"), GRIPPER_FAULTS)
def test_a_fault_in_the_gripper_file_names_that_file(folder: Path, pattern: str, replacement: str, key: str, said: str):
    path = edited(folder, pattern, replacement, "gripper.yaml")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{folder / 'gripper.yaml'}: {key}: ")
    assert said in str(caught.value)


@pytest.mark.parametrize("kept", [("L_in_near", "L_in_far"), ("L_in_near", "R_in_near", "L_out_near")])
def test_a_gripper_with_corners_too_few_for_a_calibration_is_measured_by_its_edges(folder: Path, kept: tuple[str, ...]):
    """Two corners only; three corners on one line (in_near, out_near of both fingers lie on y = -8 mm, z = 0)."""
    model = yaml.safe_load((folder / "gripper.yaml").read_text())
    for name, point in model["points"].items():
        point["corner"] = name in kept
    (folder / "gripper.yaml").write_text(yaml.safe_dump(model))
    (note,) = load_config(folder / "config.yaml").gripper.notes
    assert note.startswith(f"{len(kept)} corners") and "too few for a calibration by corners" in note


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        (b"", "is empty"),
        (b"- 1\n", "holds a list"),
        (b"\xff\xfe\x00x", "not UTF-8"),
        (b"a: b: c", "not YAML"),
    ],
)
def test_files_that_are_no_configuration(tmp_path: Path, content: bytes | None, said: str):
    path = tmp_path / "config.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=said):
        load_config(path)
    with pytest.raises(ConfigError, match=f"^{path}: .*{said}"):
        load_config(tmp_path)  # a project's folder, which holds one of that name


def test_a_shipped_configuration_is_named_as_in_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=f"^configs/demo.yaml: there is no .* {builtin_config('demo.yaml')}$"):
        load_config("configs/demo.yaml")
    with pytest.raises(ConfigError, match="there is no such file; the path of a YAML file"):
        load_config("configs/other.yaml")


def test_covariance_comes_from_the_sigmas_or_as_it_is(folder: Path):
    path = edited(folder, "^  cam_T_grip:", "  position_sigma_m: 0.002\n  rotation_sigma_rad: 0.01\n  cam_T_grip:")
    matrix = np.array(load_config(path).reference.covariance).reshape(6, 6)
    np.testing.assert_allclose(matrix, np.diag([4e-6] * 3 + [1e-4] * 3))
    own = np.diag([1e-6, 2e-6, 3e-6, 1e-5, 2e-5, 3e-5])
    own[0, 5] = own[5, 0] = 1e-6
    path = edited(folder, "^  position_sigma_m: 0.002\n", f"  covariance: {own.ravel().tolist()}\n")
    np.testing.assert_allclose(np.array(load_config(path).reference.covariance).reshape(6, 6), own)


@pytest.mark.parametrize(
    ("i", "j", "value", "said"), [(0, 0, 0.0, "zero"), (0, 1, 1e-7, "symmetric"), (0, 0, -1e-6, "positive definite")]
)
def test_a_covariance_that_is_none_is_refused(folder: Path, i: int, j: int, value: float, said: str):
    matrix = np.diag([1e-6] * 3 + [1e-5] * 3)
    matrix[i, j] = value
    path = edited(folder, "^  cam_T_grip:", f"  covariance: {matrix.ravel().tolist()}\n  cam_T_grip:")
    with pytest.raises(ConfigError, match=said):
        load_config(path)


def test_the_reference_id_depends_on_the_calibration_only(folder: Path):
    first = load_config(folder / "config.yaml").reference.reference_id
    assert load_config(edited(folder, "robot: arm1", "robot: arm2")).reference.reference_id == first
    assert load_config(edited(folder, r"0.1188\]", "0.1189]")).reference.reference_id != first
    assert (
        load_config(edited(folder, "^  cam_T_grip:", "  id: cell-7\n  cam_T_grip:")).reference.reference_id == "cell-7"
    )


def test_only_a_live_camera_keeps_its_state_unless_told_where(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/var/state")
    path = folder / "config.yaml"
    text = path.read_text() + "state: {file: auto}\n"
    for name, changed, expected in (
        ("live", text, Path("/var/state/gripmon/arm1-wrist.json")),
        ("simulated", text.replace("kind: live, device: 0", "kind: simulator"), None),
        ("nowhere", text.replace("file: auto", "file: null"), None),
        ("told", text.replace("file: auto", "file: kept/arm.json"), folder / "kept" / "arm.json"),
        ("absolute", text.replace("file: auto", "file: /data/arm.json"), Path("/data/arm.json")),
    ):
        path.write_text(changed)
        assert load_config(path).state_path == expected, name
    assert load_config(builtin_config("live_camera.yaml")).state_path == Path("/var/state/gripmon/arm1-wrist.json")


def test_a_state_belongs_to_camera_gripper_and_reference_whatever_else_changes(folder: Path):
    owner = load_config(folder / "config.yaml").state_owner
    assert (owner.robot, owner.camera) == ("arm1", "wrist")
    same = load_config(edited(folder, "^camera:", "# a comment\ncamera:")).state_owner
    assert same == owner
    moved = load_config(edited(folder, r"0.1188\]", "0.1189]")).state_owner.calibration
    assert (moved.camera, moved.gripper) == (owner.calibration.camera, owner.calibration.gripper)
    assert moved.reference != owner.calibration.reference


# --- what earlier versions had ---


LOOK = "monitor.look: the look as a measurement is gone, and transforms come from the edges alone; remove the section"
RATE = "monitor.stream.rate_s: another frame rate than usual is no fault any more; remove the key"
SIGMA = "monitor.policy.suspect_sigma_m: is gone"


@pytest.mark.parametrize(
    ("section", "said", "used"),
    [
        ("look: {enabled: true}", LOOK, True),
        ("look: {enabled: false}", LOOK, False),
        ("stream: {rate_s: 3.0}", RATE, False),
        ("policy: {suspect_sigma_m: null}", SIGMA, False),
    ],
)
def test_what_is_gone_is_read_over_with_a_line(
    folder: Path, caplog: pytest.LogCaptureFixture, section: str, said: str, used: bool
):
    """In a recording, which nobody can edit, only where it decided something."""
    path = edited(folder, r"^source:", f"monitor: {{floor_m: 3e-6, {section}}}\nsource:")
    assert load_config(path).settings.monitor.floor_m == 3e-6
    assert caplog.messages == [f"{path}: {said}"]
    caplog.clear()
    load_config(path, say_gone=False)
    assert len(caplog.messages) == used


def test_a_largest_sigma_is_refused_and_the_line_says_what_it_stood_for(folder: Path):
    path = edited(folder, r"^source:", "monitor: {policy: {suspect_sigma_m: 0.003}}\nsource:")
    with pytest.raises(ConfigError, match=r"suspect_sigma_m: is gone; alert_limit_m, the error .* 4.42 times its"):
        load_config(path)
    # Of a normal distribution 1e-5 lies beyond 4.417 standard deviations, both tails together.
    assert stats.norm.isf(0.5 * PolicySettings().integrity_risk) == pytest.approx(4.42, abs=4e-3)


def test_a_second_cameras_configuration_is_told_what_to_use_now(tmp_path: Path):
    path = tmp_path / "second.yaml"
    path.write_text("robot: arm1\ncamera_name: second\nlaser: {calibration: laser.yaml}\n")
    with pytest.raises(ConfigError, match=r"laser: .* watched by the daemon any more; gripmon check --laser"):
        load_config(path)


@pytest.mark.parametrize("key", ["camera", "gripper", "reference"])
def test_a_file_name_that_is_too_long_is_one_line(tmp_path: Path, key: str):
    path = tmp_path / "arm.yaml"
    values = yaml.safe_load(builtin_config("demo.yaml").read_text()) | {key: "x" * 256 + ".yaml"}
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=rf"{key}: x{{40}}… can't be a file \(File name too long\); "):
        load_config(path)
