"""Hand/eye transforms as other programs write them, and those that gripmon wrote, read back."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.foreign_files import read_hand_eye
from support.hand_eye_texts import (
    COMMAND,
    EASY_1,
    EASY_2,
    FILES,
    FRAMES,
    GRIP_T_CAM,
    MOVEIT_1,
    MOVEIT_2,
    QW,
    QX,
    SHIFT,
    X,
    Y,
    Z,
)

from gripmon.calibrate.foreign import InterchangeError
from gripmon.calibrate.hand_eye_files import HAND_EYE_FORMATS, HandEye, write_hand_eye
from gripmon.calibrate.hand_eye_formats import TCP_FRAME
from gripmon.cli import main
from gripmon.daemon.calibrations import pose_in, read_calibrated
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.yaml_text import as_yaml

AT_TOOL0 = "flange_T_tcp: {translation_m: [0, 0, 0], rotation_xyzw: [0, 0, 0, 1]}"

@pytest.mark.parametrize("name", FILES)
def test_each_file_gives_the_camera_s_pose_in_the_gripper_s_frame(name: str, tmp_path: Path):
    found = read_hand_eye(FILES[name].encode(), "their.file")
    assert found is not None and (found.gripper_frame, found.camera_frame) == FRAMES
    np.testing.assert_allclose(found.grip_T_cam, GRIP_T_CAM, rtol=0.0, atol=1e-7)
    assert found.kind == name.partition(",")[0].rstrip(" 12") or found.kind == name
    # As an option takes it, and imported: where the TCP is in tool0 is asked for.
    path, out = tmp_path / "theirs.yaml", tmp_path / "reference.yaml"
    path.write_text(FILES[name])
    assert main(["calibrate", "import", str(path), "--out", str(out)]) == 0
    for file in (path, out):
        with pytest.raises(InputError, match=rf"{file}: flange_T_tcp: isn't said: where the TCP .* is in tool0; "):
            pose_in(file)
    assert main(["calibrate", "verify", str(path), str(out)]) == 0  # of one frame, wherever the TCP is
    assert "flange_T_tcp: null" in out.read_text()
    out.write_text(out.read_text().replace("flange_T_tcp: null", AT_TOOL0))
    np.testing.assert_allclose(pose_in(out)[0] @ GRIP_T_CAM, np.eye(4), rtol=0.0, atol=1e-7)
    assert main(["calibrate", "verify", str(path), str(out)]) == 2


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", HAND_EYE_FORMATS)
def test_what_is_exported_is_imported_as_it_was(kind: str, turned: bool, tmp_path: Path):
    if turned and kind == "easy_handeye2":
        pytest.skip("has one direction only")
    covariance = tuple((np.diag([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4]) ** 2).ravel().tolist())
    hand_eye = HandEye(to_record(invert(GRIP_T_CAM)), covariance, gripper_in_camera=turned)
    path, out = tmp_path / "written", tmp_path / "reference.yaml"
    path.write_text(write_hand_eye(hand_eye, kind, ["written 2026 by gripmon 1: gripmon calibrate export 'a--b.yaml'"]))
    assert main(["calibrate", "import", str(path), "--out", str(out)]) == 0
    for file in (path, out):
        back = read_calibrated(file)
        assert back.cam_T_grip is not None and not back.frame, "at the TCP"
        np.testing.assert_allclose(from_record(back.cam_T_grip) @ GRIP_T_CAM, np.eye(4), rtol=0.0, atol=1e-12)
        if kind == "json":  # the only one that holds it
            assert back.covariance == covariance


def body(frame: str) -> str:
    """The same camera's pose, of a frame with x forward, y left and z up."""
    optical_T_body = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    qx, qy, qz, qw = Rotation.from_matrix(GRIP_T_CAM[:3, :3] @ optical_T_body).as_quat()
    return f"{COMMAND} {X} {Y} {Z} {qx} {qy} {qz} {qw} tool0 {frame}\n"


@pytest.mark.parametrize("frame", ["camera_link", "zed_left_camera_frame", "wrist_optical_frame"])
def test_a_camera_link_is_recognised_by_its_axes_and_named(frame: str):
    said = rf"ends in {frame}, whose x points along the gripper: the axes of a ROS body such as camera_link \(x forward"
    with pytest.raises(InterchangeError, match=said):
        read_hand_eye(body(frame).encode(), "x")
    # A frame that is called a link, but has a camera's axes, is a camera's.
    assert read_hand_eye(FILES["moveit 1"].replace(FRAMES[1], "camera_link").encode(), "x") is not None


def along_x(frame: str, z: float) -> str:
    """An effector whose x points out of it, and a camera with the same axes 0.1 m behind it."""
    still = EASY_1.replace(f"qw: {QW}", "qw: 1").replace(f"qx: {QX}", "qx: 0").replace(f"x: {X}", "x: -0.1")
    return still.replace(f"y: {Y}", "y: 0").replace(f"z: {Z}", f"z: {z}").replace(FRAMES[1], frame)


def test_a_camera_link_of_an_effector_with_x_forward_is_recognised_by_its_name_or_doubted(tmp_path: Path, capsys):
    with pytest.raises(InterchangeError, match="ends in camera_link, whose x points along the gripper"):
        read_hand_eye(along_x("camera_link", -0.06).encode(), "x")
    sideways = read_hand_eye(along_x("camera_optical_frame", -0.06).encode(), "x")
    assert sideways is not None and not sideways.doubt
    path, out = tmp_path / "theirs.yaml", tmp_path / "reference.yaml"
    path.write_text(along_x("camera_link", -0.12))
    assert main(["calibrate", "import", str(path), "--out", str(out)]) == 0
    said = "camera_link may have the axes of a ROS body such as camera_link (x forward, y left, z up) instead"
    assert f"warning: {said}" in capsys.readouterr().out and f"# {said}" in out.read_text()
    assert main(["calibrate", "verify", str(path), str(path)]) == 2
    assert said in capsys.readouterr().err


REFUSED = [
    (EASY_1.replace("eye_on_hand: true", "eye_on_hand: false"), "robot's base to camera_color_optical_frame; is a"),
    (EASY_1.replace("eye_on_hand: true", "eye_on_hand: 'False'"), "robot's base to camera_color_optical_frame; is a"),
    (EASY_1.replace("eye_on_hand: true", "eye_on_hand: hardly"), "parameters.eye_on_hand: is 'hardly'; true or false"),
    (EASY_2.replace("eye_in_hand", "eye_on_base"), "is a fixed camera's pose; gripmon calibrate robot-world"),
    (MOVEIT_2.replace("EYE-IN-HAND", "EYE-TO-HAND"), "says EYE-TO-HAND; is a fixed camera's"),
    (MOVEIT_1.replace("tool0", "base_link"), "leads from base_link to camera_color_optical_frame; is a fixed"),
    (MOVEIT_1.replace("tool0", "panda_link0"), "leads from panda_link0 to"),
    (EASY_1.replace("  qw: 0.9", "  qw: 0.7"), "its quaternion has length 0.8"),
    (EASY_1.replace("  z: -0.119\n", ""), "transformation.z: is missing"),
    (EASY_2.replace("y: -0.063", "y: much"), "transform.translation.y: 'much' is not a number"),
    (FILES["static transform, options"].replace("--child-frame-id", "--other"), "'--other' is no option of it; --x"),
    (FILES["static transform, options"].replace("--child-frame-id", "--frame-id"), "'--frame-id' is there twice; --x"),
    (FILES["static transform, options"].replace("--x", "--x 0.1 --x"), "'--x' is there twice; --x"),
    (FILES["static transform, angles"].replace("--yaw", "--Yaw"), "'--Yaw' is no option of it; --x"),
    (FILES["static transform, angles"].replace("--yaw", "--qz"), "--roll and --qz are two rotations; angles or a quat"),
    (FILES["static transform, options"].replace("--x 0.012", "0.012"), "'0.012' is no option of it; --x"),
    (FILES["static transform, options"].replace("--child-frame-id camera_color_optical_frame", ""), "child-frame"),
    (FILES["static transform, options"].rstrip() + " --x", "'--x' is there twice"),
    (FILES["static transform, by place"].rstrip() + " 100 0.5", "'0.5' is more than it takes; --x"),
    (FILES["static transform, by place"].replace(FRAMES[1], "thing"), "which is the camera.s.* --camera thing, or"),
    (body("a_cam") + body("b_cam"), "holds 2 transforms; gripmon calibrate import with --camera a_cam or b_cam"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_what_is_no_hand_eye_transform_is_said_in_one_line(text: str, said: str):
    with pytest.raises(InterchangeError, match=said) as refused:
        read_hand_eye(text.encode(), "their.file")
    assert "\n" not in str(refused.value)


def test_a_name_says_which_frame_is_the_camera_s():
    text = FILES["static transform, by place"].replace("camera_color_optical_frame", "thing")
    for which, expected in (("thing", GRIP_T_CAM), ("tool0", invert(GRIP_T_CAM))):
        found = read_hand_eye(text.encode(), "x", which=which)
        assert found is not None
        np.testing.assert_allclose(found.grip_T_cam, expected, rtol=0.0, atol=1e-7)
    several = FILES["static transform, by place"] + f"{COMMAND} 1 0 0 0 0 0 1 world table\n"
    found = read_hand_eye(several.encode(), "x")
    assert found is not None and found.camera_frame == FRAMES[1]


def test_a_flange_behind_the_camera_is_imported_and_completed_by_hand(tmp_path: Path, capsys):
    """A flange is no TCP: where the TCP is in the flange's frame is one line of the file."""
    path, out = tmp_path / "theirs.calib", tmp_path / "reference.yaml"
    path.write_text(EASY_2.replace(f"z: {Z}", "z: 0.074"))
    assert main(["calibrate", "import", str(path), "--out", str(out)]) == 0
    assert "flange_T_tcp is to be filled in: where the TCP (between the fingertips" in capsys.readouterr().out
    text = out.read_text()
    out.write_text(text.replace("flange_T_tcp: null", AT_TOOL0))
    assert main(["calibrate", "verify", str(out), str(out)]) == 2
    assert "behind the camera" in capsys.readouterr().err
    out.write_text(text.replace("flange_T_tcp: null", AT_TOOL0.replace("[0, 0, 0]", "[0, 0, 0.2]")))
    assert main(["calibrate", "verify", str(out), str(out)]) == 0
    assert main(["calibrate", "import", str(path), "--model", "fisheye", "--out", str(tmp_path / "x.yaml")]) == 2
    assert "is a hand/eye transform (easy_handeye2)" in capsys.readouterr().err


def test_a_file_that_is_written_of_another_one_keeps_its_frame(tmp_path: Path):
    """Else tool0 would come back as the TCP."""
    path, out = tmp_path / "theirs.yaml", tmp_path / "again.calib"
    path.write_text(EASY_1)
    assert main(["calibrate", "export", str(path), "--format", "easy_handeye2", "--out", str(out)]) == 0
    again = read_hand_eye(out.read_bytes(), "x")
    assert again is not None and again.gripper_frame == "tool0" and not again.at_tcp
    np.testing.assert_allclose(again.grip_T_cam, GRIP_T_CAM, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("kind", HAND_EYE_FORMATS)
def test_only_a_file_of_ours_says_that_a_frame_is_at_the_tcp(kind: str, tmp_path: Path, capsys):
    """By its name in a file that we wrote; a robot's own frame of that name may be anywhere."""
    ours, theirs, again = (tmp_path / name for name in ("ours.yaml", "theirs.yaml", "again.x"))
    ours.write_text(as_yaml({"cam_T_grip": msgspec.to_builtins(to_record(invert(GRIP_T_CAM)))}))
    theirs.write_text(EASY_2.replace("tool0", TCP_FRAME))
    export = ["calibrate", "export", str(ours), "--format", kind, "--out", str(again)]
    assert main(export) == 0
    found = read_hand_eye(again.read_bytes(), "x")
    assert found is not None and found.gripper_frame == TCP_FRAME and found.at_tcp
    found = read_hand_eye(theirs.read_bytes(), "x")
    assert found is not None and found.gripper_frame == TCP_FRAME and not found.at_tcp
    export[2] = str(theirs)
    again.unlink()
    assert main(export) == 2 and not again.exists()
    assert "gripper_tcp isn't at the TCP, as it is in gripmon's files; another name" in capsys.readouterr().err
    assert main([*export, "--gripper-frame", "tool0"]) == 0
    found = read_hand_eye(again.read_bytes(), "x")
    assert found is not None and found.gripper_frame == "tool0" and not found.at_tcp
    with pytest.raises(InputError, match="flange_T_tcp: isn't said"):
        pose_in(again)


@pytest.mark.parametrize(
    ("factor", "said"), [(1e3, r"\(135.181 mm were meant\?\)"), (1e6, r"another unit was meant\?")]
)
def test_millimetres_are_asked_for(factor: float, said: str):
    text = EASY_1
    for value in SHIFT:
        text = text.replace(f": {value}\n", f": {factor * value}\n")
    said = rf"puts {FRAMES[1]} {factor * 0.135181:g} m from tool0; metres .*{said}"
    with pytest.raises(InterchangeError, match=said):
        read_hand_eye(text.encode(), "x")


def joint(parent: str, child: str, xyz: str, rpy: str = "0 0 0", more: str = "") -> str:
    return (
        f'<joint name="{parent}-{child}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{more}</joint>'
    )


def urdf(*joints: str) -> bytes:
    return f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{"".join(joints)}</robot>'.encode()


OPTICAL = "-1.5707963267948966 0 -1.5707963267948966"
MOUNT = joint("tool0", "camera_link", "0.05 0 -0.1", "0 -1.5707963267948966 0")
COLOR = joint("camera_link", "camera_color_frame", "0 0.015 0")
LENS = joint("camera_color_frame", "camera_color_optical_frame", "0 0 0", OPTICAL)
DEPTH = joint("camera_link", "camera_depth_optical_frame", "0 0 0", OPTICAL)
ARM = joint("wrist_3_link", "flange", "0 0 0") + joint("flange", "tool0", "0 0 0") + joint("tool0", "finger", "0 0 0.1")


@pytest.mark.parametrize("which", [None, "camera_color_optical_frame"])
def test_the_fixed_joints_of_a_camera_are_joined_up_to_its_mount(which: str | None):
    found = read_hand_eye(urdf(ARM, MOUNT, LENS, COLOR), "x", which=which)
    assert found is not None and (found.gripper_frame, found.camera_frame) == FRAMES
    # camera_link's x is tool0's z, its y tool0's y; the optical axes are right, down, forward.
    expected = np.array([[0.0, 1, 0, 0.05], [-1, 0, 0, 0.015], [0, 0, 1, -0.1], [0, 0, 0, 1]])
    np.testing.assert_allclose(found.grip_T_cam, expected, rtol=0.0, atol=1e-12)


def test_joints_that_lead_to_no_gripper_are_refused_and_only_ends_are_named():
    with pytest.raises(InterchangeError, match="both of them a camera's by their names; also how the camera is mount"):
        read_hand_eye(urdf(COLOR, LENS), "x", which="camera_color_optical_frame")
    several = urdf(MOUNT, COLOR, LENS, DEPTH)
    for which, wrong in ((None, "holds 4 transforms"), ("thing", "holds no frame thing")):
        with pytest.raises(InterchangeError) as refused:
            read_hand_eye(several, "x", which=which)
        right = "gripmon calibrate import with --camera camera_color_optical_frame or camera_depth_optical_frame"
        assert str(refused.value) == f"x: {wrong}; {right}"
    with pytest.raises(InterchangeError, match="camera_link, whose x points along the gripper"):
        read_hand_eye(several, "x", which="camera_link")
    with pytest.raises(InterchangeError, match="holds 2 transforms that lead to camera_link; one parent"):
        read_hand_eye(urdf(MOUNT, joint("flange", "camera_link", "0 0 0"), COLOR, LENS), "x")


def test_what_xacro_would_put_in_matters_in_the_camera_s_joints_only():
    other = joint("a", "b", "${x} 0 0")
    assert read_hand_eye(urdf(other, MOUNT, COLOR, LENS), "x") is not None
    with pytest.raises(InterchangeError, match="joint camera_link-camera_color_frame: xyz"):
        read_hand_eye(urdf(MOUNT, COLOR.replace("0.015", "${y}"), LENS), "x")
    inserted = joint("tool0", "camera_link", "", "", '<xacro:insert_block name="origin"/>')
    with pytest.raises(InterchangeError, match="holds parts of xacro; the URDF that xacro makes of it"):
        read_hand_eye(urdf(inserted, COLOR, LENS), "x")


@pytest.mark.parametrize("frame", ["base_link_inertia", "ur5_base_link", "torso_lift_link", "pedestal", "root"])
def test_a_fixed_camera_is_recognised_by_the_other_frame_and_overruled_by_name(frame: str):
    text = FILES["static transform, by place"].replace("tool0", frame)
    right = f"if {frame} moves with the camera: gripmon calibrate import with --camera {FRAMES[1]}"
    with pytest.raises(InterchangeError, match=f"is a fixed camera's pose; .*; {right}"):
        read_hand_eye(text.encode(), "x")
    found = read_hand_eye(text.encode(), "x", which=FRAMES[1])
    assert found is not None and found.gripper_frame == frame
    # Where the name had to choose, it says nothing about the other frame.
    for other in (text + text.replace("color", "depth"), text.replace(FRAMES[1], "thing")):
        with pytest.raises(InterchangeError, match=r"is a fixed camera's pose; .* a file with this transform alone"):
            read_hand_eye(other.encode(), "x", which="thing" if "thing" in other else FRAMES[1])


@pytest.mark.parametrize("frame", ["robotiq_85_base_link", "wsg50_base_link", "left/gripper_base", "panda_hand"])
def test_a_gripper_s_own_base_is_none_of_the_robot_s(frame: str):
    found = read_hand_eye(FILES["static transform, by place"].replace("tool0", frame).encode(), "x")
    assert found is not None and found.gripper_frame == frame


@pytest.mark.parametrize("variance", [-1.0, 0.0])
def test_a_covariance_that_is_none_is_not_imported(variance: float, tmp_path: Path, capsys):
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, variance])
    hand_eye = HandEye(to_record(invert(GRIP_T_CAM)), tuple(covariance.ravel().tolist()))
    path, out = tmp_path / "theirs.json", tmp_path / "reference.yaml"
    path.write_text(write_hand_eye(hand_eye, "json", []))
    for command in (["import", str(path), "--out", str(out)], ["verify", str(path), str(path)]):
        assert main(["calibrate", *command]) == 2
        said = capsys.readouterr().err
        assert "theirs.json: covariance: " in said and "a symmetric 6x6 matrix with positive eigen" in said
    assert not out.exists()


def test_a_camera_s_name_that_the_file_contradicts_is_refused():
    assert read_hand_eye(EASY_1.encode(), "x", which=FRAMES[1]) is not None
    for which, wrong in (("tool0", "tool0: isn't the camera's frame"), ("thing", "holds no frame thing")):
        with pytest.raises(InterchangeError, match=f"x: {wrong}; .*{FRAMES[1]}"):
            read_hand_eye(EASY_1.encode(), "x", which=which)
    for text in (FILES["static transform, by place"].encode(), urdf(MOUNT, COLOR, LENS)):
        with pytest.raises(InterchangeError, match="tool0: isn't the camera's frame; camera_"):
            read_hand_eye(text, "x", which="tool0")
