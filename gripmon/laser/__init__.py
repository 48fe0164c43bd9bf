"""A fixed camera and a laser pointer on the arm: calibration, a monitor of that calibration, and its laser pulses.

The functions for programs are in :mod:`gripmon.laser.api`.
"""
