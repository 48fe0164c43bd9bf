"""gripmon: watches whether a wrist camera still stands where its calibration says."""

__version__ = "0.1.0"
