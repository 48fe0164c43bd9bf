"""Hand/eye transforms as robots' software takes them, read back by its parsers."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from xml.dom import minidom

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import URDF

from gripmon.calibrate.hand_eye_files import HandEye, roll_pitch_yaw, write_hand_eye
from gripmon.model.geometry import to_record

COVARIANCE = tuple((np.diag([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4]) ** 2).ravel().tolist())
NOTES = ["gripmon calibrate export 'a--b.yaml' --format x", "± 0.01 mm\nmore"]


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    out[:3, 3] = rng.normal(0.0, [0.01, 0.05, 0.1])
    return out


POSES = [pose(seed) for seed in range(6)]
UPRIGHT = np.eye(4)
# A pitch of exactly, and of nearly, a right angle: roll and yaw are one there.
LOCKED = [UPRIGHT.copy() for _ in range(4)]
for _T, _pitch, _roll in zip(LOCKED, (90.0, -90.0, 90.0 - 1e-7, -90.0 + 1e-10), (20.0, -70.0, 170.0, 5.0), strict=True):
    _T[:3, :3] = Rotation.from_euler("xyz", [_roll, _pitch, 33.0], degrees=True).as_matrix()
    _T[:3, 3] = 0.01, -0.02, 0.3


def hand_eye(cam_T_grip: np.ndarray, **settings: object) -> HandEye:
    return HandEye(to_record(cam_T_grip), COVARIANCE, "tool0", "wrist_optical_frame", **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("cam_T_grip", [*POSES, *LOCKED])
def test_roll_pitch_yaw_give_the_rotation_back(cam_T_grip: np.ndarray):
    again = Rotation.from_euler("xyz", roll_pitch_yaw(cam_T_grip[:3, :3])).as_matrix()
    assert np.abs(again - cam_T_grip[:3, :3]).max() < 1e-12


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("cam_T_grip", [*POSES, *LOCKED])
def test_a_urdf_parser_finds_the_camera_where_it_is(cam_T_grip: np.ndarray, turned: bool):
    joint = write_hand_eye(hand_eye(cam_T_grip, gripper_in_camera=turned), "urdf", NOTES)
    text = f'<robot name="r"><link name="tool0"/><link name="wrist_optical_frame"/>{joint}</robot>'
    minidom.parseString(text)  # comments and all are XML
    (found,) = URDF.from_xml_string(text).joints
    assert found.type == "fixed"
    pair = ("tool0", "wrist_optical_frame")
    assert (found.parent, found.child) == (pair[::-1] if turned else pair)
    parent_T_child = np.eye(4)
    parent_T_child[:3, :3] = Rotation.from_euler("xyz", found.origin.rpy).as_matrix()
    parent_T_child[:3, 3] = found.origin.xyz
    expected = cam_T_grip if turned else np.linalg.inv(cam_T_grip)
    assert np.abs(parent_T_child - expected).max() < 1e-12


@pytest.mark.parametrize("cam_T_grip", [POSES[0], LOCKED[0]])
def test_pinocchio_places_the_camera_there(cam_T_grip: np.ndarray):
    pinocchio = pytest.importorskip("pinocchio")
    joint = write_hand_eye(hand_eye(cam_T_grip), "urdf", NOTES)
    text = f'<robot name="r"><link name="tool0"/><link name="wrist_optical_frame"/>{joint}</robot>'
    model = pinocchio.buildModelFromXML(text)
    placed = model.frames[model.getFrameId("wrist_optical_frame")].placement.homogeneous
    assert np.abs(placed @ cam_T_grip - np.eye(4)).max() < 1e-12


@pytest.mark.parametrize("cam_T_grip", POSES[:2])
def test_the_tf2_command_runs_with_the_options_of_its_program(cam_T_grip: np.ndarray, tmp_path: Path):
    """A shell runs it; in place of ROS stands a program that says what it was called with."""
    stub = tmp_path / "ros2"
    stub.write_text('#!/bin/sh\nfor word in "$@"; do printf "%s\\n" "$word"; done\n')
    stub.chmod(0o755)
    script = tmp_path / "tf.sh"
    script.write_text(write_hand_eye(hand_eye(cam_T_grip), "ros-static", NOTES))
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["sh", str(script)], capture_output=True, text=True, check=True, env=environment)
    words = done.stdout.splitlines()
    assert words[:3] == ["run", "tf2_ros", "static_transform_publisher"]
    options = dict(zip(words[3::2], words[4::2], strict=True))
    assert list(options)[-2:] == ["--frame-id", "--child-frame-id"]
    assert (options["--frame-id"], options["--child-frame-id"]) == ("tool0", "wrist_optical_frame")
    grip_T_cam = np.eye(4)
    quaternion = [float(options[f"--q{axis}"]) for axis in "xyzw"]
    grip_T_cam[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    grip_T_cam[:3, 3] = [float(options[f"--{axis}"]) for axis in "xyz"]
    assert np.abs(grip_T_cam @ cam_T_grip - np.eye(4)).max() < 1e-12


def test_easy_handeye2_loads_it_into_its_message():
    """The file's keys are the fields of the package's own messages, and YAML gives each the type that it wants."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    parameters = (
        "string name\nstring calibration_type\nstring robot_base_frame\nstring robot_effector_frame\n"
        "string tracking_base_frame\nstring tracking_marker_frame\nbool freehand_robot_movement\n"
        'string move_group_namespace "/"\nstring move_group "manipulator"\n'
    )
    whole = "easy_handeye2_msgs/HandeyeCalibrationParameters parameters\ngeometry_msgs/Transform transform\n"
    package = "easy_handeye2_msgs/msg"
    store.register(get_types_from_msg(parameters, f"{package}/HandeyeCalibrationParameters"))
    store.register(get_types_from_msg(whole, f"{package}/HandeyeCalibration"))
    types = store.types
    content = yaml.full_load(write_hand_eye(hand_eye(POSES[3], name="wrist"), "easy_handeye2", NOTES))
    message = types[f"{package}/HandeyeCalibration"](
        types[f"{package}/HandeyeCalibrationParameters"](**content["parameters"]),
        types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](**content["transform"]["translation"]),
            types["geometry_msgs/msg/Quaternion"](**content["transform"]["rotation"]),
        ),
    )
    kind = f"{package}/HandeyeCalibration"
    sent = store.deserialize_cdr(store.serialize_cdr(message, kind), kind)
    assert set(content) == {"parameters", "transform"}
    assert sent.parameters.name == "wrist" and sent.parameters.calibration_type == "eye_in_hand"
    assert (sent.parameters.robot_effector_frame, sent.parameters.tracking_base_frame) == (
        "tool0", "wrist_optical_frame",
    )  # fmt: skip
    # Its publisher sends this transform from the effector's frame to the tracking base, the camera.
    rotation, translation = sent.transform.rotation, sent.transform.translation
    effector_T_cam = np.eye(4)
    effector_T_cam[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    effector_T_cam[:3, 3] = translation.x, translation.y, translation.z
    assert np.abs(effector_T_cam @ POSES[3] - np.eye(4)).max() < 1e-12


def test_small_numbers_stay_numbers_in_yaml():
    cam_T_grip = np.eye(4)
    cam_T_grip[:3, 3] = 1e-5, -3e-9, 2.0
    content = yaml.full_load(write_hand_eye(hand_eye(cam_T_grip), "easy_handeye2", ()))
    assert content["transform"]["translation"] == {"x": -1e-5, "y": 3e-9, "z": -2.0}


@pytest.mark.parametrize("turned", [False, True])
def test_json_has_both_directions_and_the_covariance(turned: bool):
    content = json.loads(write_hand_eye(hand_eye(POSES[1], gripper_in_camera=turned), "json", NOTES))
    matrix = np.array(content["parent_T_child"]["matrix"])
    assert np.abs(matrix - (POSES[1] if turned else np.linalg.inv(POSES[1]))).max() < 1e-12
    rotation = Rotation.from_quat(content["cam_T_grip"]["rotation_xyzw"]).as_matrix()
    assert np.abs(rotation - POSES[1][:3, :3]).max() < 1e-12
    assert tuple(content["covariance"]) == COVARIANCE
    assert content["notes"][1] == "± 0.01 mm more"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"gripper_frame": "a frame"}, "gripper_frame: 'a frame' isn't a frame's name"),
        ({"gripper_frame": "/tool0"}, "gripper_frame: '/tool0'"),
        ({"camera_frame": 'x"/><evil'}, "camera_frame: "),
        ({"camera_frame": ""}, "camera_frame: ''"),
        ({"gripper_frame": "same", "camera_frame": "same"}, "both frames are called same; two names"),
    ],
)
def test_names_that_are_no_frames_are_refused(settings: dict[str, str], said: str):
    with pytest.raises(ValueError, match=said):
        HandEye(to_record(POSES[0]), COVARIANCE, **settings)


def test_an_easy_handeye2_file_has_one_direction_only():
    with pytest.raises(ValueError, match="without --gripper-in-camera"):
        write_hand_eye(hand_eye(POSES[0], gripper_in_camera=True), "easy_handeye2", ())
