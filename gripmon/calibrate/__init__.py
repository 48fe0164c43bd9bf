"""Calibrations from images and poses: camera, plane under the gripper, robot and world; their files and comparison.

What programs call stands in :mod:`gripmon.calibrate.api`; the files of other programs in
:mod:`gripmon.calibrate.interchange`.
"""
