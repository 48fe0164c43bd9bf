"""Does a laser calibration still hold?  Fresh spots, and what they say has moved since.

The sum of the evidences of all motions (:mod:`~gripmon.laser.explanations`), weighted by their prior shares, over the
evidence of no motion exceeds 1 / alpha with a probability of at most alpha while nothing has moved: its mean is one
then (Markov's inequality).  That holds whatever the explanations are, and however much the errors of spots from one
pose have in common (Hölder's inequality).  Alpha is the stated rate of false alarms times the number of spots.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.special import expit

from gripmon.calibrate.sighting import NotFound
from gripmon.laser.documents import Calibrated
from gripmon.laser.explanations import KINDS, SCALES, Evidence, Fit, Foreseen, foresee
from gripmon.laser.refinement import PoseNoise
from gripmon.laser.setup import CAMERA, spots_on_plane, spots_on_rays
from gripmon.laser.spots import Spot
from gripmon.laser.ways import SpotGap, disagreements, three_ways
from gripmon.model.records import Array, Cause, CauseWeight

MAYBE = 0.05
"""Probability above which what may have moved is reported."""
LEAST_SPOTS = 3
"""Minimum number of spots that a motion explains: two wrong spots may look like one."""
MOST_UNCERTAIN = 0.1
"""Largest standard deviation of a predicted spot, over the image's diagonal; above it there is no prediction."""
_WHAT = {
    Cause.CAMERA_MOUNT: "the camera",
    Cause.PLANE_MOVED: "the plane",
    Cause.LASER_MOVED: "the laser pointer",
    Cause.UNKNOWN: "several of them, or the arm's base",
}


@dataclass(frozen=True, slots=True)
class CheckSettings:
    """Accepted false alarms, per 1000 spots of an unmoved set-up; standard deviations of the arm's poses (m, rad; each
    axis); share of spots that may be a reflection or no spot at all; probability from which a cause is named.
    """

    false_alarms_per_1000_spots: float = 0.1
    arm_noise_m: float = 1e-4
    arm_noise_rad: float = 2e-4
    wrong_spots: float = 0.2
    probable: float = 0.9

    @property
    def arm_covariance(self) -> Array:
        """Covariance (6, 6) of a pose that the arm reports, position then rotation."""
        return PoseNoise(self.arm_noise_m, self.arm_noise_rad).covariance()

    def false_alarm_chance(self, spots: int) -> float:
        """The probability that this many spots show a motion though nothing has moved."""
        return 1e-3 * self.false_alarms_per_1000_spots * spots


class SpotFault(StrEnum):
    """Why a spot was not judged, or not believed."""

    NO_SPOT = "no_spot"
    OUTLIER = "outlier"
    NOT_FORESEEN = "not_foreseen"


class JudgedSpot(msgspec.Struct, frozen=True, kw_only=True):
    """One sample.  ``uv_px``: the candidate taken for the spot; ``foreseen_px``: the calibration's; ``off_px``: their
    difference, and ``sigmas``, its length in standard deviations of calibration, arm and spot together;
    ``spots_base_m`` (3, 3): the spot in the base frame by beam and plane, by ray and plane, by beam and ray;
    ``disagreements`` of these.  ``used``: the spot is believed; otherwise ``fault`` and ``reason`` say why not.
    """

    name: str
    used: bool
    fault: SpotFault | None = None
    reason: str = ""
    uv_px: tuple[float, ...] | None = None
    foreseen_px: tuple[float | None, ...] | None = None
    off_px: tuple[float, ...] | None = None
    sigmas: float | None = None
    spots_base_m: tuple[tuple[float | None, ...], ...] | None = None
    disagreements: tuple[SpotGap, ...] = ()


class CameraMotion(msgspec.Struct, frozen=True, kw_only=True):
    """Motion of ``base_T_cam`` since the calibration, position (m) then rotation vector (rad), base axes, with its
    ``covariance`` (36, row by row): wide along directions that the spots don't show.
    """

    position_m: tuple[float, ...]
    rotation_rad: tuple[float, ...]
    covariance: tuple[float, ...]
    text: str


class LaserCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a laser calibration still holds: ``verdict`` is "same", "moved", or "unclear" if at most half of the
    spots can be believed; ``text`` gives the result in words.  ``cause``: what moved, "unknown" where two explain it
    alike; ``causes``: all that were weighed, the most probable first.  ``motion`` of the camera, if it may have moved.
    """

    verdict: str
    text: str
    cause: Cause | None = None
    causes: tuple[CauseWeight, ...] = ()
    probability_moved: float = 0.0
    motion: CameraMotion | None = None
    spots_judged: tuple[JudgedSpot, ...] = ()


class Sample(NamedTuple):
    """A fresh sample: its name, the arm's pose (4, 4), and the candidates for the spot, or why there is none."""

    name: str
    base_T_ee: Array
    candidates: Sequence[Spot] | NotFound


def check_spots(known: Calibrated, samples: Sequence[Sample], settings: CheckSettings) -> LaserCheck:
    """Compare fresh spots with a calibration."""
    arm = settings.arm_covariance
    foreseen = foresee(known, np.stack([sample.base_T_ee for sample in samples]), arm)
    judged = [_unseen(known, foreseen, k, sample) for k, sample in enumerate(samples)]
    shown = [k for k, spot in enumerate(judged) if spot.fault is None]
    spots = [candidates for k in shown if not isinstance(candidates := samples[k].candidates, NotFound)]
    if not shown:
        return _without_motion(judged)
    evidence = Evidence(known, np.stack([samples[k].base_T_ee for k in shown]), spots, arm, settings.wrong_spots)
    still = evidence.of(None)
    fits = [[evidence.of((kind, scale)) for scale in range(len(SCALES))] for kind in range(len(KINDS))]
    shares = [share for _, _, share in KINDS]
    weights = np.array([[_log_weight(fit, share) for fit in row] for row, share in zip(fits, shares, strict=True)])
    total = float(np.logaddexp.reduce(weights, axis=None)) - still.evidence
    probability = float(expit(total + math.log(settings.false_alarm_chance(len(shown)))))
    moved = probability >= 0.5
    kind, scale = np.unravel_index(int(weights.argmax()), weights.shape)
    best = fits[kind][scale] if moved else still
    for k, spot in zip(shown, _judged(known, evidence, best, [judged[k] for k in shown]), strict=True):
        judged[k] = spot
    if not moved or 2 * int(best.used.sum()) <= len(samples):
        return _without_motion(judged, probability)
    probable = np.exp(weights - weights.max()).sum(axis=1)
    probable /= probable.sum()
    order = [int(k) for k in np.argsort(-probable, kind="stable") if probable[k] > 1e-6]
    causes = tuple(CauseWeight(KINDS[k][0], round(float(probable[k]), 6)) for k in order)
    named = causes[0].probability >= settings.probable
    # What moved, and how far, without much of an assumption about its size.
    change, _ = evidence.motion(order[0], fits[order[0]][-1])
    camera = _camera_motion(*evidence.motion(0, fits[0][-1])) if probable[0] > MAYBE else None
    text = _cause_text(known, evidence, causes[0].cause, change, camera) if named else _causes_text(causes)
    return LaserCheck(
        verdict="moved",
        text=_shift_text(known, evidence, best) + text,
        cause=causes[0].cause if named else Cause.UNKNOWN,
        causes=causes,
        probability_moved=probability,
        motion=camera,
        spots_judged=tuple(judged),
    )


def _log_weight(fit: Fit, share: float) -> float:
    """The logarithm of a motion's evidence times its prior share; minus infinity if hardly a spot shows it."""
    return fit.evidence + math.log(share / len(SCALES)) if fit.used.sum() >= LEAST_SPOTS else -math.inf


def _without_motion(judged: Sequence[JudgedSpot], probability: float = 0.0) -> LaserCheck:
    used, count = sum(spot.used for spot in judged), len(judged)
    verdict, text = "same", f"{used} of {count} spots are where the calibration has them"
    if 2 * used <= count:
        verdict = "unclear"
        text = f"only {used} of {count} spots can be believed, too few or too different to tell a motion by"
    return LaserCheck(verdict=verdict, text=text, probability_moved=probability, spots_judged=tuple(judged))


def _unseen(known: Calibrated, foreseen: Foreseen, k: int, sample: Sample) -> JudgedSpot:
    """A sample with the fault for which it can't be judged, if it has one."""
    fault, reason = _fault(known, foreseen, k, sample) or (None, "")
    return JudgedSpot(
        name=sample.name, used=False, fault=fault, reason=reason, foreseen_px=_values(foreseen.uv_px[k])
    )  # fmt: skip


def _fault(known: Calibrated, foreseen: Foreseen, k: int, sample: Sample) -> tuple[SpotFault, str] | None:
    camera, uv_px, spread = known.camera, foreseen.uv_px[k], foreseen.by_calibration[k] + foreseen.by_arm[k]
    if not np.isfinite(spots_on_plane(known.setup, sample.base_T_ee[None])).all():
        return SpotFault.NOT_FORESEEN, "the beam runs along the plane"
    if not (np.isfinite(uv_px).all() and np.isfinite(spread).all()):
        return SpotFault.NOT_FORESEEN, "the beam meets the plane behind the camera or outside of its lens"
    largest = math.sqrt(float(np.linalg.eigvalsh(spread)[-1]))
    if largest > MOST_UNCERTAIN * math.hypot(camera.width_px, camera.height_px):
        text = f"the beam nearly runs along the plane: the spot can't be predicted to better than {largest:.0f} px"
        return SpotFault.NOT_FORESEEN, text
    if not isinstance(sample.candidates, NotFound):
        return None
    margin = 3.0 * np.sqrt(spread.diagonal() + known.sigma_px**2)
    if (uv_px < margin).any() or (uv_px > np.array([camera.width_px, camera.height_px]) - 1.0 - margin).any():
        where = f"the spot should be at ({uv_px[0]:.0f}, {uv_px[1]:.0f}) px, not safely within the image"
        return SpotFault.NOT_FORESEEN, f"{where}, and was not seen"
    return SpotFault.NO_SPOT, sample.candidates.reason


def _judged(known: Calibrated, evidence: Evidence, fit: Fit, before: Sequence[JudgedSpot]) -> list[JudgedSpot]:
    """Each sample against the calibration, and whether a fit believes it."""
    taken = evidence.first + fit.candidate
    uv_px, foreseen_px = evidence.uv_px[taken], evidence.foreseen_px[taken]
    off = uv_px - foreseen_px
    sigmas = np.sqrt(np.einsum("ni,ni->n", off, np.linalg.solve(evidence.spread[taken], off[:, :, None])[:, :, 0]))
    spots = three_ways(known, known.setup, evidence.base_T_ee, uv_px)[0]
    apart = disagreements(known, evidence.base_T_ee, uv_px, evidence.noise[taken])
    out = []
    for k, spot in enumerate(before):
        far = f"{float(np.linalg.norm(off[k])):.1f} px from where it should be ({sigmas[k]:.1f} sigma)"
        fault, reason = (None, "") if fit.used[k] else (SpotFault.OUTLIER, f"{far}: a reflection, or something moved")
        out.append(
            msgspec.structs.replace(
                spot,
                used=bool(fit.used[k]),
                fault=fault,
                reason=reason,
                uv_px=_values(uv_px[k]),
                off_px=_values(off[k]),
                sigmas=float(sigmas[k]),
                spots_base_m=_values(spots[k]),
                disagreements=apart[k],
            )
        )
    return out


def _values(array: Array) -> Any:
    """Nested tuples, with None for values that aren't finite."""
    if array.ndim:
        return tuple(_values(part) for part in array)
    return float(array) if np.isfinite(array) else None


def _camera_motion(change: Array, covariance: Array) -> CameraMotion:
    shift, covariance = change[CAMERA], covariance[CAMERA, CAMERA]
    sigma = np.sqrt(covariance.diagonal())
    place = ", ".join(f"{1e3 * v:+.2f} ± {1e3 * s:.2f}" for v, s in zip(shift[:3], sigma[:3], strict=True))
    turn = ", ".join(f"{v:+.3f} ± {s:.3f}" for v, s in zip(np.degrees(shift[3:]), np.degrees(sigma[3:]), strict=True))
    return CameraMotion(
        position_m=tuple(shift[:3].tolist()),
        rotation_rad=tuple(shift[3:].tolist()),
        covariance=tuple(covariance.ravel().tolist()),
        text=f"by ({place}) mm, turned by ({turn}) degrees in the base",
    )


def _shift_text(known: Calibrated, evidence: Evidence, fit: Fit) -> str:
    """How far the calibration now misplaces a spot, the largest over the poses."""
    now = spots_on_rays(known.setup, known.camera.undistort(evidence.predicted_px(fit.setup)))
    sizes = np.linalg.norm(now - spots_on_plane(known.setup, evidence.base_T_ee), axis=1)
    if not np.isfinite(sizes).any():
        return "spots are nowhere near where the calibration has them"
    return f"spots are {1e3 * float(np.nanmax(sizes)):.2f} mm from where the calibration has them"


def _causes_text(causes: Sequence[CauseWeight]) -> str:
    likely = [f"{_WHAT[w.cause]} ({100.0 * w.probability:.0f} %)" for w in causes if w.probability > MAYBE]
    return f"; spots don't tell what moved: {' or '.join(likely)}"


def _cause_text(
    known: Calibrated, evidence: Evidence, cause: Cause, change: Array, camera: CameraMotion | None
) -> str:
    if cause is Cause.CAMERA_MOUNT and camera is not None:
        return f": the camera moved {camera.text}"
    if cause is Cause.PLANE_MOVED:
        spots = spots_on_plane(known.setup.moved(change), evidence.base_T_ee)
        away_m = float(np.nanmedian(spots @ known.setup.normal_base - known.setup.distance_base_m))
        way = "away from" if away_m > 0.0 else "towards"
        tilt = math.degrees(float(np.hypot(*change[6:8])))
        return f": the plane moved {1e3 * abs(away_m):.2f} mm {way} the camera, tilted by {tilt:.3f} degrees"
    if cause is Cause.LASER_MOVED:
        turn, shift = math.degrees(float(np.hypot(*change[9:11]))), 1e3 * float(np.hypot(*change[11:13]))
        return f": the laser pointer moved on the arm, turned by {turn:.3f} degrees, shifted by {shift:.2f} mm"
    return "; neither the camera nor the plane nor the laser pointer explains it alone"
