"""From what was decided to the record that says so."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.corners import Measurement
from gripmon.geometry import invert, rotation_angle, to_record
from gripmon.records import Array, CornerFault, CornerRecord, Drift, Smoothed
from gripmon.smoothing import PoseAverage


def flat(covariance: Array) -> tuple[float, ...]:
    """(6, 6) row by row."""
    return tuple(covariance.ravel().tolist())


def drift_between(ref_cam_T_grip: Array, cam_T_grip: Array) -> Drift:
    """Equation (14) for the motion from a reference to now, and the TCP's way in the camera frame."""
    motion = cam_T_grip @ invert(ref_cam_T_grip)
    x, y, z = (cam_T_grip[:3, 3] - ref_cam_T_grip[:3, 3]).tolist()
    return Drift(float(np.sqrt(motion[:3, 3] @ motion[:3, 3])), rotation_angle(motion[:3, :3]), (x, y, z))


def smoothed_record(average: PoseAverage, more: Array) -> Smoothed | None:
    """The average with its covariance and ``more`` (6, 6) on top; None before the first measurement."""
    if average.cam_T_grip is None:
        return None
    transform = to_record(average.cam_T_grip)
    return Smoothed(transform.translation_m, transform.rotation_xyzw, flat(average.claimed_covariance + more))


def corner_records(
    measurement: Measurement, names: tuple[str, ...], taken: NDArray[np.bool_]
) -> tuple[CornerRecord, ...]:
    """Each corner, where it was measured, and whether it is among those ``taken`` (c,)."""
    corners = measurement.corners
    return tuple(
        CornerRecord(name, None, None, False, fault)
        if fault is not None
        else CornerRecord(name, (u, v), sigma, used, None if used else CornerFault.LEFT_OUT)
        for name, (u, v), sigma, fault, used in zip(
            names, corners.uv_px.tolist(), corners.sigma_px.tolist(), corners.fault, taken.tolist(), strict=True
        )
    )


def unmeasured_corners(names: tuple[str, ...], fault: CornerFault) -> tuple[CornerRecord, ...]:
    """None of them was measured, for one reason."""
    return tuple(CornerRecord(name, None, None, False, fault) for name in names)
