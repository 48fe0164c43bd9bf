"""Formats of others: cameras and hand/eye transforms of ROS, Kalibr, OpenCV, mrcal, URDF and easy_handeye2."""
