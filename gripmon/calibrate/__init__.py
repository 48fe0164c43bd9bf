"""Calibrations from images and poses: camera, plane under the gripper, robot and world; their files and comparison.

The functions for programs are in :mod:`gripmon.calibrate.api`; the files of other programs are read in
:mod:`gripmon.calibrate.camera_files` and :mod:`gripmon.calibrate.hand_eye_formats`.
"""
