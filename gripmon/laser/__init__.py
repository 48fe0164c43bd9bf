"""A fixed camera and a laser pointer on the arm: calibration, the camera's watch, and the pulses that it judges.

What programs call stands in :mod:`gripmon.laser.api`.
"""
