"""The models of what may have moved, for one gripper: what each frees, and how probable each is beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.judge.causes.state import FINGERS, FOCAL, JAW, POSE, finger_lever_m, finger_slice
from gripmon.judge.causes.weighing import Model
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause

MOUNT_SIZES_M = np.geomspace(5e-5, 1e-2, 8)
FINGER_SIZES_M = np.geomspace(5e-5, 3e-3, 6)
JAW_SIZES_M = np.geomspace(5e-5, 3e-3, 6)
FOCAL_SIZES = np.geomspace(1e-3, 5e-2, 6)
"""How far things move when they move: shift of the TCP, of a finger, of the opening; relative focal length."""

JAW_UNREPORTED_SIGMA_M = 0.02
"""What is known about an opening that nobody reports."""

_MOUNT, _FINGER, _JAW, _LENS, _REPLACED, _NOTHING, _SEVERAL = 0.3, 0.25, 0.15, 0.1, 0.3, 0.1, 0.1


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Standard deviations of what holds while nothing has moved: ``pose`` (6,) of the reference, ``jaw_m`` of the
    opening; ``jaw_reported``: a robot reports it.
    """

    pose: Array
    jaw_m: float
    jaw_reported: bool


@dataclass(frozen=True, slots=True)
class Suspect:
    """One model: the cause that it stands for (``None``: nothing moved; ``UNKNOWN``: several things at once), the
    finger that it is about, its probability before anything is seen.
    """

    cause: Cause | None
    part: int | None
    prior: float
    model: Model


def suspects(gripper: Gripper, distance_m: float, known: Knowledge, interrupted: bool) -> list[Suspect]:
    """The models that exist for this gripper, ``distance_m`` from the camera to the TCP.

    A gripper of one finger has none for a bent finger, which looks like a motion of the camera; without a jaw, or
    where nobody reports its opening, there is none for a wrong report.  Nobody exchanges a camera without the stream
    being ``interrupted``.
    """
    fingers = len(gripper.finger_ids)
    held = np.zeros(FINGERS + 6 * fingers)
    held[POSE] = known.pose
    held[JAW] = 0.0 if not gripper.has_jaw else known.jaw_m if known.jaw_reported else JAW_UNREPORTED_SIGMA_M
    lever_m = finger_lever_m(gripper)

    def freed(*parts: tuple[int | slice, Array | float]) -> Array:
        out = np.zeros(len(held))
        for place, size in parts:
            out[place] = size
        return out

    def bent(finger: int) -> tuple[slice, Array]:
        return finger_slice(finger), np.array([1.0] * 3 + [1.0 / lever_m[finger]] * 3)

    pose = np.array([1.0] * 3 + [1.0 / distance_m] * 3)
    out = [
        Suspect(None, None, _NOTHING, Model(held, freed(), np.zeros(0))),
        Suspect(Cause.CAMERA_MOUNT, None, _MOUNT, Model(held, freed((POSE, pose)), MOUNT_SIZES_M)),
        Suspect(Cause.LENS, None, _LENS, Model(held, freed((FOCAL, 1.0)), FOCAL_SIZES)),
    ]
    if interrupted:
        # Another camera in its place: an image of another scale from nearly the same place.
        model = Model(held, freed((POSE, pose), (FOCAL, 5.0)), MOUNT_SIZES_M)
        out.append(Suspect(Cause.CAMERA_REPLACED, None, _REPLACED, model))
    if gripper.has_jaw and known.jaw_reported:
        out.append(Suspect(Cause.JAW_OPENING, None, _JAW, Model(held, freed((JAW, 1.0)), JAW_SIZES_M)))
    if fingers > 1:
        for finger in range(fingers):
            model = Model(held, freed(bent(finger)), FINGER_SIZES_M)
            out.append(Suspect(Cause.FINGER_BENT, finger, _FINGER / fingers, model))
    every = freed((POSE, pose), (FOCAL, 5.0), *(bent(finger) for finger in range(fingers)))
    out.append(Suspect(Cause.UNKNOWN, None, _SEVERAL, Model(held, every, MOUNT_SIZES_M)))
    return out
