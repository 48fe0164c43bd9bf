"""The monitor's settings, its judgement of a pulse, and what has moved: how far, and the alert about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.calibrate.sighting import NotFound
from gripmon.laser.beliefs import KINDS, MOVED, SCALES, Beliefs, MotionTest
from gripmon.laser.spots import Spot
from gripmon.laser.world import CAMERA, Calibrated, SpotGap, World, predict, predict_moved
from gripmon.model.records import (
    Alert,
    AlertKind,
    Array,
    Cause,
    CauseWeight,
    Severity,
    State,
    Verdict,
)


class SpotFault(StrEnum):
    """Why a spot was not judged, or was rejected."""

    NO_SPOT = "no_spot"
    OUTLIER = "outlier"
    NOT_FORESEEN = "not_foreseen"
    NOT_FINITE = "not_finite"


class SpotWatchSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The test's false-alarm rate, the noise of the arm and rate of wrong spots, and the severity of motions."""

    false_alarms_per_1000_pulses: Annotated[
        float, Meta(gt=0.0, le=10.0, description="false alarms per 1000 pulses of an unmoved set-up (1/1000)")
    ] = 0.1
    arm_noise_m: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="standard deviation of the arm's reported positions, per axis (m)"),
    ] = 1e-4
    arm_noise_rad: Annotated[
        float,
        Meta(ge=0.0, le=0.5, description="standard deviation of the arm's reported rotations, per axis (rad)"),
    ] = 2e-4
    wrong_spots: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.5,
            description="expected fraction of pulses whose detected spot is a reflection or no spot at all",
        ),
    ] = 0.2
    probable: Annotated[
        float,
        Meta(gt=0.5, lt=1.0, description="probability from which a cause is named; below it the cause is unknown"),
    ] = 0.9
    warn_m: Annotated[
        float, Meta(gt=0.0, le=1.0, description="shift of the spots at which a motion becomes a warning (m)")
    ] = 1e-3
    limit_m: Annotated[
        float, Meta(gt=0.0, le=1.0, description="shift of the spots at which a motion becomes an error (m)")
    ] = 5e-3
    lost_pulses: (
        Annotated[
            int,
            Meta(ge=2, le=1000, description="pulses in a row without the spot after which it is lost"),
        ]
        | None
    ) = None
    """Absent: enough that wrong spots alone reach it less often than the false-alarm rate."""
    confirm_pulses: Annotated[
        int,
        Meta(ge=1, le=1000, description="good pulses after a start or a loss before the calibration counts as valid"),
    ] = 2
    update_alert_s: Annotated[
        float, Meta(ge=0.0, le=3600.0, description="shortest time between two updates of an open alert (s)")
    ] = 2.0

    @property
    def pulses_until_lost(self) -> int:
        """Number of successive pulses."""
        if self.lost_pulses is not None:
            return self.lost_pulses
        return max(math.ceil(math.log(1e-3 * self.false_alarms_per_1000_pulses) / math.log(self.wrong_spots)), 2)

    @property
    def arm_covariance(self) -> Array:
        """Covariance (6, 6) of a pose that the arm reports, position then rotation."""
        return np.diag(np.square([self.arm_noise_m] * 3 + [self.arm_noise_rad] * 3))


@dataclass(frozen=True, slots=True)
class SpotSeen:
    """A pulse: its time (Unix ns), the reported pose of the end-effector (4, 4), and the candidates for the spot, as
    :func:`~gripmon.laser.spots.find_spots` returns them.
    """

    stamp_ns: int
    base_T_ee: Array
    candidates: Sequence[Spot] | NotFound


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """The camera's motion.  ``shift`` (6,): motion of ``base_T_cam`` since the calibration, position (m) then rotation
    vector (rad), base axes, with ``covariance`` (6, 6): ``base_T_cam' = perturb(base_T_cam, shift)``.  Along directions
    that the pulses don't observe, the shift follows from correlations, and the covariance is wide.  ``observed`` (k,
    6): the directions that are much better known than before, unit rows in ``shift`` divided by :data:`UNIT`.
    ``complete``: all six are observed.  ``text`` describes the motion in words.
    """

    shift: Array
    covariance: Array
    observed: Array
    complete: bool
    text: str


@dataclass(frozen=True, slots=True)
class SpotJudgement:
    """The judgement of one pulse.

    ``uv_px`` (2,): the candidate taken for the spot; ``predicted_px`` (2,) by the calibration; ``off_px`` (2,):
    innovation, measured less predicted, whose ``covariance_px`` (2, 2) covers the calibration, the spot and the arm;
    ``square``: normalised innovation squared, two degrees of freedom.  ``spots_base_m`` (3, 3): the spot in the base
    frame by beam and plane, by ray and plane, by beam and ray; ``disagreements`` of these.  ``used``: the spot was
    accepted; otherwise ``fault`` and ``reason`` say why not.  ``probability_moved``: that anything has moved;
    ``causes``: what, each with its probability.  ``motion`` of the camera, if the camera moved or may have.
    None means unknown.
    """

    stamp_ns: int
    used: bool
    state: State
    verdict: Verdict
    uv_px: Array | None = None
    predicted_px: Array | None = None
    off_px: Array | None = None
    covariance_px: Array | None = None
    square: float | None = None
    spots_base_m: Array | None = None
    disagreements: tuple[SpotGap, ...] = ()
    fault: SpotFault | None = None
    reason: str = ""
    probability_moved: float = 0.0
    causes: tuple[CauseWeight, ...] = ()
    motion: CameraMotion | None = None
    alerts: tuple[Alert, ...] = ()


MAYBE = 0.05
"""Probability above which a motion of the camera is reported."""
RELIEF = 0.8
"""Hysteresis: fraction of a limit that the shift must fall below before the severity is lowered."""
UNIT = np.array([0.01] * 3 + [0.01] * 3)
"""Metres and radians that are weighted alike: at half a metre, 10 mrad move a point by 5 mm."""
OBSERVED = 0.3
"""Standard deviation, in :data:`UNIT`, below which a direction counts as observed."""
_NAMES = ("along x", "along y", "along z", "about x", "about y", "about z")
_TOLD = 0.4
"""Component of a direction above which its axis is named."""


def camera_motion(beliefs: Beliefs, k: int) -> CameraMotion:
    """The camera's motion under belief ``k``.  For a single motion, the prior on its size is removed as far as
    possible: it would pass for knowledge.
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
    """The estimate with the prior of the largest motions in place of the assumed one: information is additive."""
    metres, radians = SCALES[-1]
    wide = np.diag(np.square([metres] * 3 + [radians] * 3))
    information = np.linalg.inv(covariance)
    new = information - np.linalg.inv(assumed) + np.linalg.inv(wide)
    new = 0.5 * (new + new.T)
    if float(np.linalg.eigvalsh(new * np.outer(UNIT, UNIT))[0]) <= 0.0:  # rounding: there was next to no information
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
    return f"{text}; pulses so far hardly show a motion {untold}: others, from elsewhere or with the hand turned, would"


@dataclass(frozen=True, slots=True)
class Moved:
    """What has moved.  ``shift_m``: how far the calibration now misplaces a spot, the largest over the last poses
    (infinite if the camera sees none of them any more), and that shift in camera axes (3,); ``change`` (13,): best
    estimate of the motion; ``plane_m``: how far the plane has moved away from the camera, at the last pose's spot;
    ``causes``, the most probable first; ``motion`` of the camera, if it may have moved.
    """

    shift_m: float
    shift_cam_m: Array | None
    change: Array
    plane_m: float
    causes: tuple[CauseWeight, ...]
    motion: CameraMotion | None


def how(test: MotionTest, calibrated: Calibrated, poses: Sequence[Array]) -> Moved:
    """What has moved, according to the reigning beliefs."""
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
    """The shift between the spots now and before, both from camera ray and plane as calibrated."""
    world, largest, found = calibrated.world, 0.0, None
    missed = 0
    for pose in poses:
        before, after = predict(world, calibrated.camera, pose), predict_moved(calibrated, change, pose)
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
    lit, spot = calibrated.world.lit, predict_moved(calibrated, change, pose).spot_base_m
    off = float(lit.normal_cam @ spot) - lit.distance_m
    behind = lit.distance_m - float(lit.normal_cam @ calibrated.world.base_T_cam[:3, 3])
    return math.copysign(off, off * behind)


def on_plane(world: World, calibrated: Calibrated, uv_px: Array) -> Array:
    """Where the calibration places a spot (2,), base frame (3,); NaN where its ray misses the plane."""
    ray = world.base_T_cam[:3, :3] @ np.array([*calibrated.camera.undistort(uv_px[None])[0], 1.0])
    normal = world.lit.normal_cam
    steep = float(normal @ ray)
    depth = (world.lit.distance_m - float(normal @ world.base_T_cam[:3, 3])) / (steep if steep else np.nan)
    return world.base_T_cam[:3, 3] + (depth if depth > 0.0 else np.nan) * ray


def alert_of(moved: Moved, settings: SpotWatchSettings, before: Alert | None) -> Alert:
    """The alert about a motion; ``before``: the open alert about it."""
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
        _moved_text(moved.shift_m, moved.causes, cause, moved.change, moved.plane_m, moved.motion),
        causes=moved.causes,
        tcp_shift_m=None if shift is None else (float(shift[0]), float(shift[1]), float(shift[2])),
        rotation_rad=turn,
    )


def _severity(shift_m: float, settings: SpotWatchSettings, said: Severity | None) -> Severity:
    """Severity with hysteresis: an open alert keeps its severity until the shift is clearly smaller."""
    if shift_m >= settings.limit_m * (RELIEF if said is Severity.ERROR else 1.0):
        return Severity.ERROR
    eased = RELIEF if said in (Severity.WARNING, Severity.ERROR) else 1.0
    return Severity.WARNING if shift_m >= settings.warn_m * eased else Severity.INFO


_WHAT = {
    Cause.CAMERA_MOUNT: "the camera",
    Cause.PLANE_MOVED: "the plane",
    Cause.LASER_MOVED: "the laser pointer",
    Cause.UNKNOWN: "several of them, or the arm's base",
}


def _moved_text(
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
    """The alert after too many successive pulses without an accepted spot."""
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


def outlier_text(off_px: Array, square: float) -> str:
    """Why a spot was rejected."""
    return (
        f"{float(np.linalg.norm(off_px)):.1f} px from where it should be ({math.sqrt(square):.1f} sigma): "
        "a reflection, or something has moved"
    )
