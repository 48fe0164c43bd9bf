"""How the camera has moved, as a belief has it, and which directions the pulses have shown."""

from __future__ import annotations

import math

import numpy as np

from gripmon.laser.watch.beliefs import MOVED, Beliefs
from gripmon.laser.watch.judgement import CameraMotion
from gripmon.laser.watch.motions import SCALES
from gripmon.laser.watch.world import CAMERA
from gripmon.model.records import Array

UNIT = np.array([0.01] * 3 + [0.01] * 3)
"""Metres and radians that count alike: half a metre off, 10 mrad move a point by 5 mm."""
OBSERVED = 0.3
"""Standard deviation, in units, below which a direction is observed."""
_NAMES = ("along x", "along y", "along z", "about x", "about y", "about z")
_TOLD = 0.4
"""Part of a direction from which an axis is named."""


def camera_motion(beliefs: Beliefs, k: int) -> CameraMotion:
    """Of belief ``k``.  What was assumed of a motion's size when it was looked for is taken back as far as it goes: it
    would pass for knowledge.
    """
    shift = beliefs.mean[k, MOVED][CAMERA].copy()
    covariance = beliefs.covariance[k, MOVED, MOVED][CAMERA, CAMERA].copy()
    if int(beliefs.motions[k]) == 1:
        shift, covariance = _widened(shift, covariance, beliefs.prior[k][CAMERA, CAMERA])
    values, axes = np.linalg.eigh(covariance / np.outer(UNIT, UNIT))
    known = np.sqrt(np.maximum(values, 0.0)) < OBSERVED
    complete = bool(known.all())
    return CameraMotion(shift, covariance, axes[:, known].T, complete, _text(shift, covariance, axes[:, ~known]))


def _widened(shift: Array, covariance: Array, assumed: Array) -> tuple[Array, Array]:
    """With the largest motions' prior in the assumed one's stead: its information is additive."""
    metres, radians = SCALES[-1]
    wide = np.diag(np.square([metres] * 3 + [radians] * 3))
    information = np.linalg.inv(covariance)
    new = information - np.linalg.inv(assumed) + np.linalg.inv(wide)
    new = 0.5 * (new + new.T)
    if float(np.linalg.eigvalsh(new * np.outer(UNIT, UNIT))[0]) <= 0.0:  # rounding: it was next to nothing
        return shift, covariance
    out = np.linalg.inv(new)
    return out @ information @ shift, out


def _text(shift: Array, covariance: Array, unknown: Array) -> str:
    sigma = np.sqrt(covariance.diagonal())
    place = ", ".join(f"{1e3 * v:+.2f} ± {1e3 * s:.2f}" for v, s in zip(shift[:3], sigma[:3], strict=True))
    turn = ", ".join(
        f"{math.degrees(v):+.3f} ± {math.degrees(s):.3f}" for v, s in zip(shift[3:], sigma[3:], strict=True)
    )
    text = f"by ({place}) mm, turned by ({turn}) degrees in the base"
    if not unknown.size:
        return text
    ways = []
    for direction in unknown.T[::-1]:
        names = [_NAMES[i] for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > _TOLD]
        ways.append(" and ".join(names) + " at once" * (len(names) > 1))
    untold = "; nor ".join(dict.fromkeys(ways))
    return f"{text}; pulses so far hardly tell a motion {untold}: others, from elsewhere or with the hand turned, would"
