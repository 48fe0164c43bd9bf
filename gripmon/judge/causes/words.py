"""Causes in words: how far what moved, and what one camera can't tell apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from gripmon.judge.causes.comparing import Comparison, Key
from gripmon.judge.causes.state import FOCAL, JAW, POSE, finger_slice
from gripmon.judge.causes.weighing import Weighed
from gripmon.model.gripper import Gripper
from gripmon.model.records import Cause


def sentence(
    shares: Mapping[Key, float], comparison: Comparison, absent: Sequence[int], probable: float, gripper: Gripper
) -> str:
    """One sentence for the alert; ``shares``: probability of each model."""
    ranked = sorted(shares, key=lambda key: -shares[key])
    best = ranked[0]
    names = gripper.finger_ids
    gone = f"finger {', '.join(names[f] for f in absent)} is not seen near where it should be" if absent else ""
    named = best[0] not in (None, Cause.UNKNOWN)
    if named and shares[best] >= probable:
        text = _of(best, comparison.fits[best], comparison.blur_change_px, gripper)
        return f"{text}; {gone}" if gone and best[0] is not Cause.VIEW_BLOCKED else text
    if gone:
        return f"{gone}: hidden, or bent by more than edges are looked for; one image doesn't tell which"
    if best[0] is None and shares[best] >= 0.5:
        return "every finger and the camera stand where they did"
    if best[0] is Cause.UNKNOWN and shares[best] >= 0.5:
        return "no single cause explains what is seen: several things may have changed at once"
    said = " or ".join(
        f"{_name(key, gripper)} ({100.0 * shares[key]:.0f} %)" for key in ranked[:3] if shares[key] > 0.05
    )
    return f"this camera can't tell the causes apart: {said}"


def _of(key: Key, fit: Weighed, blur_change_px: float | None, gripper: Gripper) -> str:
    cause, part = key
    motion = fit.motion
    match cause:
        case Cause.CAMERA_MOUNT:
            shift_mm = 1e3 * float(np.linalg.norm(motion[POSE][:3]))
            turn_deg = math.degrees(float(np.linalg.norm(motion[POSE][3:])))
            also = "all fingers bent alike" if len(gripper.finger_ids) > 1 else "a finger bent so"
            return (
                f"the camera moved against the gripper: TCP by {shift_mm:.3f} mm, turned by {turn_deg:.3f} degrees; "
                f"{also} would look the same"
            )
        case Cause.CAMERA_REPLACED:
            return (
                f"the image has another scale ({100.0 * math.expm1(float(motion[FOCAL])):+.2f} %) and is seen from "
                f"elsewhere ({1e3 * float(np.linalg.norm(motion[POSE][:3])):.2f} mm at the TCP): another camera, or a "
                "lens that changed as the mount moved"
            )
        case Cause.FINGER_BENT:
            assert part is not None
            own = motion[finger_slice(part)]
            shift_mm = 1e3 * float(np.linalg.norm(own[:3]))
            return (
                f"finger {gripper.finger_ids[part]} is bent: its middle stands {shift_mm:.3f} mm away, turned by "
                f"{math.degrees(float(np.linalg.norm(own[3:]))):.2f} degrees, the rest where it was"
            )
        case Cause.JAW_OPENING:
            return (
                f"the jaws stand {1e3 * float(motion[JAW]):+.3f} mm from what is reported, the camera where it was; "
                "fingers bent apart alike would look the same"
            )
        case Cause.LENS:
            parts = []
            if abs(float(motion[FOCAL])) > 5e-4:
                parts.append(f"the focal length changed by {100.0 * math.expm1(float(motion[FOCAL])):+.2f} %")
            if blur_change_px is not None and abs(blur_change_px) > 0.3:
                parts.append(f"the edges' blur changed by {blur_change_px:+.1f} px")
            what = " and ".join(parts) or "the image's scale or sharpness changed"
            return f"{what}; a camera that moved along its axis would show nearly so"
        case _:
            return "the view of the gripper is blocked"


def _name(key: Key, gripper: Gripper) -> str:
    cause, part = key
    if cause is None:
        return "nothing moved"
    named = {
        Cause.CAMERA_MOUNT: "the camera moved",
        Cause.FINGER_BENT: f"finger {'' if part is None else gripper.finger_ids[part]} is bent",
        Cause.JAW_OPENING: "the opening is reported wrong",
        Cause.LENS: "focal length or focus changed",
        Cause.CAMERA_REPLACED: "the camera was replaced",
        Cause.VIEW_BLOCKED: "the view is blocked",
        Cause.UNKNOWN: "several things at once",
    }
    return named.get(cause, str(cause))
