"""Calibrations from images and poses: camera, plane under the gripper, robot and world; their files and comparison.

What programs call is in :mod:`gripmon.calibrate.api`; other programs' files in :mod:`gripmon.calibrate.interchange`.
"""
