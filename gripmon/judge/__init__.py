"""Measured poses to decisions: filter, drift test, causes, policy, references, recalibration."""
