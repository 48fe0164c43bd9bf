"""What a person is told."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gripmon.laser.watch.judgement import CameraMotion, SpotFault
from gripmon.model.records import Alert, AlertKind, Array, Cause, CauseWeight, Severity

_WHAT = {
    Cause.CAMERA_MOUNT: "the camera",
    Cause.PLANE_MOVED: "the plane",
    Cause.LASER_MOVED: "the laser pointer",
    Cause.UNKNOWN: "several of them, or the arm's base",
}


def moved(
    shift_m: float,
    causes: Sequence[CauseWeight],
    cause: Cause,
    change: Array,
    plane_m: float,
    motion: CameraMotion | None,
) -> str:
    """Text of an alert; ``change`` (13,) is the motion of what moved, ``plane_m`` the plane's, away from the camera."""
    text = f"spots are {1e3 * shift_m:.2f} mm from where the calibration has them"
    if not np.isfinite(shift_m):
        text = "spots are nowhere near where the calibration has them"
    if cause is Cause.UNKNOWN and causes and causes[0].cause is Cause.UNKNOWN and causes[0].probability > 0.5:
        return f"{text}; neither the camera nor the plane nor the laser pointer explains it alone"
    if cause is Cause.UNKNOWN:
        likely = [f"{_WHAT[w.cause]} ({100.0 * w.probability:.0f} %)" for w in causes if w.probability > 0.05]
        return f"{text}; pulses don't tell what moved: {' or '.join(likely)}"
    if cause is Cause.CAMERA_MOUNT and motion is not None:
        return f"{text}: the camera moved {motion.text}"
    if cause is Cause.PLANE_MOVED:
        tilt = math.degrees(float(np.hypot(*change[6:8])))
        way = "away from" if plane_m > 0.0 else "towards"
        return f"{text}: the plane moved {1e3 * abs(plane_m):.2f} mm {way} the camera, tilted by {tilt:.3f} degrees"
    turn = math.degrees(float(np.hypot(*change[9:11])))
    shift = 1e3 * float(np.hypot(*change[11:13]))
    return f"{text}: the laser pointer moved on the arm, turned by {turn:.3f} degrees, shifted by {shift:.2f} mm"


def lost_alert(faults: Sequence[SpotFault]) -> Alert:
    """No pulse could be believed for so long."""
    return Alert(AlertKind.LOST, Cause.UNKNOWN, Severity.ERROR, _lost(len(faults), faults))


def _lost(pulses: int, faults: Sequence[SpotFault]) -> str:
    seen = sum(fault is SpotFault.OUTLIER for fault in faults)
    if seen == 0:
        return (
            f"no spot in the last {pulses} pulses: the laser off, the beam or the camera's view blocked, or the camera "
            "turned away"
        )
    if seen == len(faults):
        return (
            f"spots of the last {pulses} pulses are not where they should be, and no motion of camera, plane or laser "
            "pointer explains them all: reflections, or poses that are not those of the pulses"
        )
    return (
        f"the last {pulses} pulses show no spot ({len(faults) - seen}) or one that is not where it should be ({seen}), "
        "and no motion explains these: the view partly blocked, reflections, or the laser off"
    )


def outlier(off_px: Array, square: float) -> str:
    """Why a spot isn't believed."""
    return (
        f"{float(np.linalg.norm(off_px)):.1f} px from where it should be ({math.sqrt(square):.1f} sigma): "
        "a reflection, or something has moved"
    )
