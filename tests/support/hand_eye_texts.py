"""One camera's pose in the frame ``tool0``, as each program writes it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SHIFT, TURN = (0.012, -0.063, -0.119), (-0.258819, 0.0, 0.0, 0.9659258)
GRIP_T_CAM = np.eye(4)
GRIP_T_CAM[:3, :3], GRIP_T_CAM[:3, 3] = Rotation.from_quat(TURN).as_matrix(), SHIFT
X, Y, Z = SHIFT
QX, QY, QZ, QW = TURN
ROLL, PITCH, YAW = Rotation.from_quat(TURN).as_euler("xyz")
FRAMES = "tool0", "camera_color_optical_frame"
EASY_1 = f"""parameters:
  eye_on_hand: true
  freehand_robot_movement: false
  move_group: manipulator
  move_group_namespace: /
  namespace: /ur_eye_on_hand/
  robot_base_frame: base_link
  robot_effector_frame: tool0
  tracking_base_frame: camera_color_optical_frame
  tracking_marker_frame: aruco_marker_frame
transformation:
  qw: {QW}
  qx: {QX}
  qy: {QY}
  qz: {QZ}
  x: {X}
  y: {Y}
  z: {Z}
"""
EASY_2 = f"""parameters:
  name: wrist
  calibration_type: eye_in_hand
  robot_base_frame: base_link
  robot_effector_frame: tool0
  tracking_base_frame: camera_color_optical_frame
  tracking_marker_frame: aruco_marker_0
  freehand_robot_movement: true
  move_group_namespace: /
  move_group: manipulator
transform:
  translation:
    x: {X}
    y: {Y}
    z: {Z}
  rotation:
    x: {QX}
    y: {QY}
    z: {QZ}
    w: {QW}
"""
MOVEIT_2 = f'''""" Static transform publisher acquired via MoveIt 2 hand-eye calibration """
""" EYE-IN-HAND: tool0 -> camera_color_optical_frame """
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    nodes = [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            output="log",
            arguments=[
                "--frame-id",
                "tool0",
                "--child-frame-id",
                "camera_color_optical_frame",
                "--x",
                "{X}",
                "--y",
                "{Y}",
                "--z",
                "{Z}",
                "--qx",
                "{QX}",
                "--qy",
                "{QY}",
                "--qz",
                "{QZ}",
                "--qw",
                "{QW}",
                # "--roll",
                # "9.9",
                # "--pitch",
                # "9.9",
            ],
        ),
    ]
    return LaunchDescription(nodes)
'''
MOVEIT_1 = f"""<launch>
  <!-- The rpy in the comment uses the extrinsic XYZ convention, which is the same as is used in a URDF. See
       http://wiki.ros.org/geometry2/RotationMethods and https://en.wikipedia.org/wiki/Euler_angles for more info. -->
  <!-- xyz="9 9 9" rpy="9 9 9" -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="camera_link_broadcaster"
      args="{X} {Y} {Z}   {QX} {QY} {QZ} {QW} tool0 camera_color_optical_frame" />
</launch>
"""
COMMAND = "ros2 run tf2_ros static_transform_publisher"
OPTIONS = f"--x {X} --y {Y} --z {Z} --qx {QX} --qy {QY} --qz {QZ} --qw {QW}"
FILES = {
    "easy_handeye": EASY_1,
    "easy_handeye2": EASY_2,
    "moveit 2": MOVEIT_2,
    "moveit 1": MOVEIT_1,
    "static transform, options": f"{COMMAND} {OPTIONS} --frame-id tool0 --child-frame-id camera_color_optical_frame\n",
    "static transform, over two lines": f"# calibrated on Monday\n{COMMAND} {OPTIONS} \\\n  --frame-id /tool0 "
    "--child-frame-id camera_color_optical_frame --ros-args -r __node:=a\n",
    "static transform, angles": f"{COMMAND} --x {X} --y {Y} --z {Z} --roll {ROLL} --pitch {PITCH} --yaw {YAW} "
    "--frame-id tool0 --child-frame-id camera_color_optical_frame\n",
    "static transform, with =": f"{COMMAND} --x={X} --y={Y} --z={Z} --qx={QX} --qy={QY} --qz={QZ} --qw={QW} "
    "--frame-id=tool0 --child-frame-id=camera_color_optical_frame 2>&1 >/dev/null &  # the wrist\n",
    "static transform, by place": f"{COMMAND} {X} {Y} {Z} {QX} {QY} {QZ} {QW} tool0 camera_color_optical_frame\n",
    "static transform, ROS 1's period": "rosrun tf static_transform_publisher "
    f"{X} {Y} {Z} {YAW} {PITCH} {ROLL} tool0 camera_color_optical_frame 100 __name:=a\n",
    "static transform, in YAML": f"launch:\n- node:\n    pkg: tf2_ros\n    exec: static_transform_publisher\n    args: "
    f'"{OPTIONS} --frame-id tool0 --child-frame-id camera_color_optical_frame"\n',
    "urdf": '<robot name="r"><joint name="a" type="revolute"><parent link="a"/><child link="b"/></joint>'
    f'<joint name="cam" type="fixed"><origin xyz="{X} {Y} {Z}" rpy="{ROLL} {PITCH} {YAW}"/><parent link="tool0"/>'
    '<child link="camera_color_optical_frame"/></joint></robot>',
}


# A name is no executable.
OTHERS = '''Node(package="a", executable="b", name="static_transform_publisher_b", arguments=["--x", f(1)]),
        Node(package="tf2_ros", name="static_transform_publisher_cam (\\")",'''
FILES["moveit 2, among other nodes"] = MOVEIT_2.replace("Node(\n", OTHERS, 1).replace(
    "        ),\n", '        ),\n        Node(executable="c", arguments=["static_transform_publisher", "--y"]),\n', 1
)
FILES["moveit 1, among other nodes"] = MOVEIT_1.replace(
    "  <node", '  <node pkg="a" type="b" name="static_transform_publisher_b" args="1 2 3" />\n  <node', 1
).replace("camera_link_broadcaster", "static_transform_publisher_camera_link_broadcaster")
FILES["static transform, in YAML with names"] = FILES["static transform, in YAML"].replace(
    "    pkg", "    name: static_transform_publisher cam\n    pkg"
).replace("launch:\n", "launch:\n- node: {pkg: a, exec: b, name: static_transform_publisher_b, args: 1 2 3}\n")
# What isn't run is no node, and a name may hold what ends a list, a tag or a comment.
_NOT_RUN = '''def before() -> None:
    """Node(executable="static_transform_publisher", arguments=["--frame-id", "tool0", "--child-frame-id", "a_cam"])"""


def generate'''
FILES["moveit 2, with an old node in its text"] = MOVEIT_2.replace("def generate", _NOT_RUN, 1).replace(
    '"--x",', '"--" "x",  # joined', 1
)
FILES["moveit 1, with a mark in a name"] = MOVEIT_1.replace("<node ", '<node if="$(eval 2 > 1)" ', 1)
