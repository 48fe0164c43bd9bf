"""What has moved, how far, and the alert about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.laser.watch import words
from gripmon.laser.watch.beliefs import MOVED, Beliefs
from gripmon.laser.watch.judgement import CameraMotion
from gripmon.laser.watch.motions import KINDS, SCALES
from gripmon.laser.watch.sequential import MotionTest
from gripmon.laser.watch.settings import SpotWatchSettings
from gripmon.laser.watch.world import CAMERA, Calibrated, World, foresee, foresee_moved
from gripmon.model.records import Alert, AlertKind, Array, Cause, CauseWeight, Severity

MAYBE = 0.05
"""Probability from which a motion of the camera is told."""
RELIEF = 0.8
"""Part of a limit below which what was said to be past it no longer is."""
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


@dataclass(frozen=True, slots=True)
class Moved:
    """``shift_m``: how far the calibration now puts a spot from where it is, the largest over the last poses (infinite
    where the camera sees none of them any more), and that shift in camera axes (3,); ``change`` (13,) the best guess
    of the motion; ``plane_m`` how far the plane then is behind where it was, seen from the camera, at the last pose's
    spot; ``causes`` the most probable first; ``motion`` of the camera, if it may be that.
    """

    shift_m: float
    shift_cam_m: Array | None
    change: Array
    plane_m: float
    causes: tuple[CauseWeight, ...]
    motion: CameraMotion | None


def how(test: MotionTest, calibrated: Calibrated, poses: Sequence[Array]) -> Moved:
    """What the reigning beliefs say."""
    beliefs, best = test.reigning, test.best
    weights = np.exp(beliefs.weight)
    shares = [float(weights[beliefs.kind == kind].sum()) for kind in range(len(KINDS))]
    causes = [CauseWeight(KINDS[kind][0], round(shares[kind], 6)) for kind in range(len(KINDS)) if shares[kind] > 1e-6]
    change = beliefs.mean[best, MOVED].copy()
    motion = None
    camera = np.flatnonzero(beliefs.kind == 0)
    if shares[0] > MAYBE:
        motion = camera_motion(beliefs, int(camera[beliefs.weight[camera].argmax()]))
    shift_m, shift_cam_m = _shift(calibrated, change, poses)
    plane_m = _plane(calibrated, change, poses[-1]) if poses else math.nan
    return Moved(shift_m, shift_cam_m, change, plane_m, tuple(sorted(causes, key=lambda w: -w.probability)), motion)


def _shift(calibrated: Calibrated, change: Array, poses: Sequence[Array]) -> tuple[float, Array | None]:
    """Camera ray and plane, as calibrated, of where spots are now and of where they were."""
    world, largest, found = calibrated.world, 0.0, None
    missed = 0
    for pose in poses:
        before, after = foresee(world, calibrated.camera, pose), foresee_moved(calibrated, change, pose)
        if not before.finite:
            continue
        shift = on_plane(world, calibrated, after.uv_px) - before.spot_base_m
        if not np.isfinite(shift).all():
            missed += 1
        elif (size := float(np.linalg.norm(shift))) >= largest:
            largest, found = size, shift
    if found is None:
        return (float("inf") if missed else 0.0), None
    return largest, world.base_T_cam[:3, :3].T @ found


def _plane(calibrated: Calibrated, change: Array, pose: Array) -> float:
    lit, spot = calibrated.world.lit, foresee_moved(calibrated, change, pose).spot_base_m
    off = float(lit.normal_cam @ spot) - lit.distance_m
    behind = lit.distance_m - float(lit.normal_cam @ calibrated.world.base_T_cam[:3, 3])
    return math.copysign(off, off * behind)


def on_plane(world: World, calibrated: Calibrated, uv_px: Array) -> Array:
    """Where the camera takes a spot (2,) to be, base frame (3,); NaN where its ray misses the plane."""
    ray = world.base_T_cam[:3, :3] @ np.array([*calibrated.camera.undistort(uv_px[None])[0], 1.0])
    normal = world.lit.normal_cam
    steep = float(normal @ ray)
    depth = (world.lit.distance_m - float(normal @ world.base_T_cam[:3, 3])) / (steep if steep else np.nan)
    return world.base_T_cam[:3, 3] + (depth if depth > 0.0 else np.nan) * ray


def alert_of(moved: Moved, settings: SpotWatchSettings, before: Alert | None) -> Alert:
    """``before``: what is open about it."""
    likely = moved.causes[0] if moved.causes else CauseWeight(Cause.UNKNOWN, 1.0)
    cause = likely.cause if likely.probability >= settings.probable else Cause.UNKNOWN
    shift = moved.shift_cam_m
    turn = None
    if moved.motion is not None and cause is Cause.CAMERA_MOUNT:
        turn = float(np.linalg.norm(moved.change[CAMERA][3:]))
    return Alert(
        AlertKind.DRIFT,
        cause,
        _severity(moved.shift_m, settings, None if before is None else before.severity),
        words.moved(moved.shift_m, moved.causes, cause, moved.change, moved.plane_m, moved.motion),
        causes=moved.causes,
        tcp_shift_m=None if shift is None else (float(shift[0]), float(shift[1]), float(shift[2])),
        rotation_rad=turn,
    )


def _severity(shift_m: float, settings: SpotWatchSettings, said: Severity | None) -> Severity:
    """What is open stays as severe until it is clearly less."""
    if shift_m >= settings.limit_m * (RELIEF if said is Severity.ERROR else 1.0):
        return Severity.ERROR
    eased = RELIEF if said in (Severity.WARNING, Severity.ERROR) else 1.0
    return Severity.WARNING if shift_m >= settings.warn_m * eased else Severity.INFO
