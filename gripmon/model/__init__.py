"""The base room: cameras and lenses, the gripper model, SE(3), and the records that leave the monitor."""
