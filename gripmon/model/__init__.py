"""The base: cameras and lenses, the gripper, SE(3), the records that leave the monitor."""
