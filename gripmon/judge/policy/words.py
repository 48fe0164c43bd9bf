"""Texts of alerts about a motion, a vibration, and a gripper whose place nothing proves."""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.records import AlertKind, Array, Motion
from gripmon.model.units import in_time

_MOTION_KINDS = {AlertKind.STEP: "a step", AlertKind.CREEP: "a creep", AlertKind.DRIFT: "a drift"}


def motion_text(motion: Motion, since_first: bool, stamp_ns: int) -> str:
    """How it moved last, and by how much it was off in all at that time: of a step after a creep that is more than the
    step.  Alerts are read later, when it may be elsewhere.
    """
    x, y, z = (1e3 * motion.shift[:3]).tolist()
    sx, sy, sz = (1e3 * motion.sigma[:3]).tolist()
    turn = math.degrees(float(np.linalg.norm(motion.shift[3:])))
    return (
        f"{_MOTION_KINDS[motion.kind]}: at {in_time(stamp_ns)} the TCP was {x:+.3f} {y:+.3f} {z:+.3f} mm from where "
        f"{'the first frames' if since_first else 'the reference'} had it "
        f"(1 sigma {sx:.3f} {sy:.3f} {sz:.3f}), turned by {turn:.3f} degrees"
    )


def creep_text(rate_m_per_min: float | None, left_s: float | None) -> str:
    if rate_m_per_min is None:
        return ""
    text = f"{1e3 * rate_m_per_min:.3f} mm/min"
    if left_s is None:
        return text
    return f"{text}, {_duration(left_s)} to the limit" if left_s > 0.0 else f"{text}, past the limit"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.0f} h"


def frequency_text(hertz: float) -> str:
    """With two digits below ten; nothing where there is none, as among frames with one stamp."""
    if hertz <= 0.0:
        return ""
    return f" at about {hertz:.0f} Hz" if hertz >= 9.95 else f" at about {hertz:.2g} Hz"


def unproven_text(since_ns: int, shift: Array | None, stamp_ns: int) -> str:
    """Text about a place that nothing has proven since a time, Unix ns.  An image can't distinguish the causes.
    ``shift`` (6,): where the gripper is seen, against the reference, at ``stamp_ns``; None where it was.
    """
    if shift is None:
        return (
            f"the fingers' ends have not been seen where they should be since {in_time(since_ns)}: something hides "
            "them, or the camera has moved along the fingers; nothing proves where the gripper is"
        )
    x, y, z = (1e3 * shift[:3]).tolist()
    return (
        f"the gripper has been seen elsewhere since {in_time(since_ns)}, which nothing proves: at {in_time(stamp_ns)} "
        f"the TCP was {x:+.3f} {y:+.3f} {z:+.3f} mm from where the reference has it; the camera has moved, or "
        "something beside the fingers looks like them"
    )
