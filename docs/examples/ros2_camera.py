"""A camera of ROS 2 to try with: FOLDER with images and timestamps.csv, sent for ever at 10 images/s, with joints."""

import csv
import sys
import time
from pathlib import Path

import cv2
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState


def main(folder: str) -> None:
    rows = list(csv.DictReader((Path(folder) / "timestamps.csv").open()))
    rclpy.init()
    node = rclpy.create_node("wrist_camera")
    images = node.create_publisher(Image, "/wrist/image_raw", qos_profile_sensor_data)
    joints = node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
    while True:
        for row in rows:
            pixels = cv2.imread(str(Path(folder) / row["file"]), cv2.IMREAD_GRAYSCALE)
            image = Image(height=pixels.shape[0], width=pixels.shape[1], encoding="mono8", step=pixels.shape[1])
            image.data.frombytes(pixels.tobytes())
            image.header.stamp = node.get_clock().now().to_msg()
            state = JointState(name=["finger_joint"], position=[0.5 * float(row["jaw_opening_m"])])
            state.header.stamp = image.header.stamp
            joints.publish(state)
            images.publish(image)
            time.sleep(0.1)


main(sys.argv[1])
