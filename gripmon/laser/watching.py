"""From a second camera's frames and a laser's pulses to the result of each pulse."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gripmon.calibrate.sighting import NotFound
from gripmon.judge.policy import AlertBook
from gripmon.laser.judgement import SpotJudgement, SpotSeen, SpotWatchSettings
from gripmon.laser.matching import Matcher, PulseSettings, ReportedPulse, Shown, mean_image
from gripmon.laser.setup import LaserCalibration, setup_of
from gripmon.laser.spots import SHARE_OF_PEAK, Spot, find_spots
from gripmon.laser.watch import SpotWatch
from gripmon.laser.world import LEAST_NOISE_PX
from gripmon.model.camera import make_camera
from gripmon.model.geometry import from_record, perturb, quaternion_xyzw, skew
from gripmon.model.records import (
    Alert,
    AlertKind,
    ArmPose,
    Array,
    CameraShift,
    Cause,
    Frame,
    Image,
    OpenAlert,
    PulseFault,
    Severity,
    SpotRecord,
    State,
    Verdict,
    to_json,
)

_IMAGE = "image"
_IMAGE_ALERT_AFTER_S = 1.0
_STILL = 3.0
"""Gate for the motion between a pulse's halves, in standard deviations; a half has at most twice a spot's own."""
_NO_BACKGROUND = (
    "; no frame to subtract, none since the pulse before had the laser off: a longer pause, by more than "
    "laser.frames.margin_s after a pulse and before the next one"
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a pulse; ``image`` is the one in which the spot was searched, None if there was none."""

    record: SpotRecord
    image: Image | None = None


class Displacement(NamedTuple):
    """Shift of the plane's point on the camera's axis, along the camera's axes (m): its position now less the
    calibrated one; and the shift's largest standard deviation (m).
    """

    shift_m: tuple[float, float, float]
    sigma_m: float


class PulsedWatch:
    """A pure function of the frames and pulses so far; it has no clock.  The ``matcher`` takes the pulses."""

    def __init__(self, calibration: LaserCalibration, watch: SpotWatchSettings, pulses: PulseSettings) -> None:
        """Raises CalibrationError for a calibration whose numbers make no set-up."""
        camera = make_camera(calibration.camera)
        self.reference_id = f"laser-{hashlib.sha256(to_json(calibration)).hexdigest()[:8]}"
        self.displacement: Displacement | None = None
        self.usable = 0
        self._watch = SpotWatch(calibration, watch)
        self.matcher = Matcher(pulses)
        self._size_px = camera.width_px, camera.height_px
        self._base_T_cam = from_record(calibration.base_T_cam)
        setup = setup_of(calibration)
        self._sigma_px = max(calibration.residuals.sigma_px, LEAST_NOISE_PX)
        self._axis_point_m = np.array([0.0, 0.0, setup.distance_m / setup.normal_cam[2]])
        self._book = AlertBook(update_s=np.inf, clear_s=0.0)
        self._refused_since_ns: int | None = None
        self._seq = -1

    @property
    def state(self) -> State:
        return State.LOST if self._book.open else self._watch.state

    @property
    def verdict(self) -> Verdict:
        return Verdict.UNKNOWN if self._book.open else self._watch.verdict

    @property
    def open_alerts(self) -> tuple[OpenAlert, ...]:
        return (*self._watch.book.open, *self._book.open)

    def acknowledge(self, alert_id: str = "") -> tuple[Alert, ...]:
        """Acknowledge an alert, or all; empty if there is none that isn't acknowledged."""
        return (*self._watch.book.acknowledge(alert_id), *self._book.acknowledge(alert_id))

    def reset(self) -> tuple[Alert, ...]:
        """Trust the calibration again, as after a repair."""
        self.displacement = None
        return self._watch.reset()

    def replayed(self, frames: Iterable[Frame], table: Sequence[ReportedPulse]) -> Iterator[SpotRecord]:
        """The records of a table's pulses, judged on recorded frames; the same input gives the same records."""
        self.matcher.load(table)
        for frame in frames:
            for shown in self.frame(frame)[0]:
                yield self.judge(shown).record
        for shown in self.matcher.finish():
            yield self.judge(shown).record

    def frame(self, frame: Frame) -> tuple[list[Shown], tuple[Alert, ...], str]:
        """Take a frame; return the pulses to be judged now, alerts about the image, and what is wrong with it."""
        fault = _fault(frame, self._size_px)
        self._seq = frame.seq
        alerts = self._image_alerts(frame, fault)
        return self.matcher.frame(replace(frame, image=None, fault=fault) if fault else frame), alerts, fault

    def judge(self, shown: Shown) -> Outcome:
        """Judge a pulse; pulses come in the order in which :meth:`frame` returned them."""
        if shown.fault is not None:
            return self.unjudged(shown, shown.fault, shown.reason)
        image = mean_image(shown.lit)
        found = find_spots(image, None if shown.dark is None else shown.dark.image)
        if not isinstance(found, NotFound) and (moving := self._moving(shown, found[0])):
            return replace(self.unjudged(shown, PulseFault.MOVING, moving), image=image)
        judged = self._watch.judge(SpotSeen(shown.pulse.stamp_ns, shown.pulse.base_T_ee, found))
        if shown.dark is None and judged.fault in (PulseFault.NO_SPOT, PulseFault.OUTLIER):
            judged = replace(judged, reason=judged.reason + _NO_BACKGROUND)
        self.usable += judged.used
        if judged.motion is not None:
            self.displacement = self._displacement(judged.motion.shift, judged.motion.covariance)
        elif judged.used:
            self.displacement = None
        return Outcome(self._record(shown, judged, 0 if isinstance(found, NotFound) else len(found)), image)

    def _moving(self, shown: Shown, brightest: Spot) -> str:
        """One line if the end-effector moved: the spot is then off by about its motion between the halves."""
        way = way_px(shown.lit, shown.dark, brightest)
        if way is None or not np.linalg.norm(way) > 2.0 * _STILL * self._sigma_px:
            return ""
        return (
            f"the spot moves by {float(np.linalg.norm(way)):.1f} px during the pulse; the laser on only while the hand "
            "stands still"
        )

    def unjudged(self, shown: Shown, fault: PulseFault, reason: str) -> Outcome:
        """The result for a pulse that can't be judged."""
        nothing = SpotJudgement(shown.pulse.stamp_ns, False, self.state, self.verdict, fault=fault, reason=reason)
        return Outcome(self._record(shown, nothing, 0))

    def _record(self, shown: Shown, judged: SpotJudgement, candidates: int) -> SpotRecord:
        pulse, motion = shown.pulse, judged.motion
        return SpotRecord(
            pulse=pulse.number,
            seq=shown.lit[-1].seq if shown.lit else self._seq,
            stamp_ns=pulse.stamp_ns,
            until_ns=pulse.until_ns,
            verdict=judged.verdict,
            state=judged.state,
            used=judged.used,
            fault=judged.fault,
            reason=judged.reason or None,
            base_T_ee=_pose(pulse.base_T_ee),
            frames=len(shown.lit),
            background=shown.dark is not None,
            candidates=candidates,
            uv_px=_numbers(judged.uv_px),
            foreseen_px=_numbers(judged.predicted_px),
            off_px=_numbers(judged.off_px),
            off_covariance_px2=_numbers(judged.covariance_px),
            square=judged.square,
            gaps=judged.disagreements,
            probability_moved=judged.probability_moved,
            shift=None
            if motion is None
            else CameraShift(
                _numbers(motion.shift[:3]),
                _numbers(motion.shift[3:]),
                _numbers(motion.covariance),
                motion.complete,
                motion.text,
            ),
            reference_id=self.reference_id,
            revision=0,
            alerts=judged.alerts,
        )

    def _displacement(self, shift: Array, covariance: Array) -> Displacement:
        turn = self._base_T_cam[:3, :3]
        moved = perturb(self._base_T_cam, shift) @ [*self._axis_point_m, 1.0]
        gap_m = turn.T @ (moved[:3] - self._base_T_cam[:3, :3] @ self._axis_point_m - self._base_T_cam[:3, 3])
        slope = turn.T @ np.hstack([np.eye(3), -skew(turn @ self._axis_point_m)])
        sigmas_m = np.sqrt(np.diag(slope @ covariance @ slope.T))
        return Displacement(_numbers(gap_m), float(sigmas_m.max()))

    def _image_alerts(self, frame: Frame, fault: str) -> tuple[Alert, ...]:
        now_s = 1e-9 * frame.stamp_ns
        if not fault:
            self._refused_since_ns = None
            return self._book.absent(_IMAGE, "images can be used again", now_s)
        since_ns = frame.stamp_ns if self._refused_since_ns is None else self._refused_since_ns
        self._refused_since_ns = since_ns
        if 0 <= frame.stamp_ns - since_ns < 1e9 * _IMAGE_ALERT_AFTER_S:
            return ()
        alert = Alert(AlertKind.IMAGE, Cause.IMAGE_BAD, Severity.ERROR, f"no usable image: {fault}")
        return self._book.present(_IMAGE, alert, now_s, frame.stamp_ns)


def _fault(frame: Frame, size_px: tuple[int, int]) -> str:
    """Why no spot can be searched in a frame; empty if it can.  A dark image is fine: the spot brightens it."""
    image = frame.image
    if image is None or not isinstance(image, np.ndarray):
        return frame.fault or "there is no image"
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        return f"shape {image.shape}; H x W, or H x W x 3 in the order BGR"
    if (image.shape[1], image.shape[0]) != size_px:
        return f"{image.shape[1]}x{image.shape[0]} pixels; {size_px[0]}x{size_px[1]} as the calibration says"
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        return f"pixels of type {image.dtype}; uint8, uint16 or float32"
    if image.dtype == np.float32 and not np.isfinite(image).all():
        return "pixels that are NaN or infinite"
    return ""


def _pose(base_T_ee: Array) -> ArmPose:
    return ArmPose(_numbers(base_T_ee[:3, 3]), quaternion_xyzw(base_T_ee[:3, :3]))


def _numbers(values: Array | None) -> Any:
    """The numbers of an array, row by row; None for None."""
    return None if values is None else tuple(np.asarray(values, float).ravel().tolist())


_REACH = 3.0
"""Half of the window's width, in radii of a disc with the spot's area."""
_LEAST_SHARE = 0.5
"""Minimum light in the dimmer half of a pulse, over the brighter half's: below it there is nothing to compare."""


def way_px(lit: tuple[Frame, ...], dark: Frame | None, spot: Spot) -> Array | None:
    """(2,) motion of ``spot``, found in the mean of ``lit``, from the first half of these frames to the second, px.  At
    a steady speed the end-effector moved about twice as far.  None if it can't be determined: a single frame, or a
    laser that wasn't on all the time.
    """
    if len(lit) < 2:
        return None
    reach = math.ceil(_REACH * math.sqrt(spot.area_px / math.pi))
    u, v = (round(float(value)) for value in spot.uv_px)
    window = (slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1))
    before = None if dark is None or dark.image is None else _light(dark.image, window)
    half = len(lit) // 2
    found = [_centre(frames, window, before) for frames in (lit[:half], lit[-half:])]
    (first, first_flux), (last, last_flux) = found
    if not min(first_flux, last_flux) > _LEAST_SHARE * max(first_flux, last_flux):
        return None
    out: Array = last - first
    return out


def _centre(frames: tuple[Frame, ...], window: tuple[slice, slice], before: Array | None) -> tuple[Array, float]:
    """Centroid (2,) in the window, column and row, and the light it is computed from."""
    images = [_light(frame.image, window) for frame in frames if frame.image is not None]
    mean = np.mean(images, axis=0)
    signal = mean - (np.median(mean) if before is None else before)
    weight = np.maximum(signal - SHARE_OF_PEAK * signal.max(), 0.0)
    flux = float(weight.sum())
    rows, columns = np.indices(weight.shape)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / max(flux, 1e-9), flux


def _light(image: Image, window: tuple[slice, slice]) -> Array:
    part = image[window].astype(float)
    return part if part.ndim == 2 else part.max(axis=2)
