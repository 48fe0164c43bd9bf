"""A fixed camera, a plane and a laser pointer on the arm: their calibration, and whether it still holds.

The functions for programs are in :mod:`gripmon.laser.api`.
"""
