"""A fixed camera and a laser pointer on the arm: calibration (``pointer``), its watch, and the pulses that it judges.

What programs call stands in :mod:`gripmon.laser.api`.
"""
