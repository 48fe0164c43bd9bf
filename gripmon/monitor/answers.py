"""From a decision to its record, and to the notes with the limits behind it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.drift import Baseline, MotionWatch
from gripmon.judge.policy import Evidence, Judgement
from gripmon.judge.smoothing import PoseAverage
from gripmon.judge.stream import StreamFault
from gripmon.model.poses import motion_between, to_record
from gripmon.model.records import (
    Alert,
    AlertKind,
    Array,
    Cause,
    CauseWeight,
    CornerFault,
    CornerRecord,
    Drift,
    Explanation,
    Frame,
    FrameRecord,
    Limits,
    MonitorNotes,
    Origin,
    ReferenceRecord,
    Refusal,
    Severity,
    Smoothed,
    ValidBy,
)
from gripmon.model.records.notes import SixNumbers
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import AtReferences, Named
from gripmon.monitor.standing import Standing
from gripmon.monitor.tracker import USUAL_SHARE
from gripmon.track.edges import Measurement
from gripmon.track.jaw import UNREPORTED_MOTION_SIGMAS

FINGER_ASTRAY = 0.35
"""Inlier ratio of a finger's search lines below which it is not where it should be; above the usual ratio it is."""


def flat(covariance: Array) -> tuple[float, ...]:
    """A covariance (6, 6) row by row."""
    return tuple(covariance.ravel().tolist())


def drift_between(ref_cam_T_grip: Array, cam_T_grip: Array) -> Drift:
    """Equation (14) for the motion from a reference to now, and the TCP's shift in the camera frame."""
    x, y, z = (cam_T_grip[:3, 3] - ref_cam_T_grip[:3, 3]).tolist()
    return Drift(*motion_between(ref_cam_T_grip, cam_T_grip), (x, y, z))


def smoothed_record(average: PoseAverage, more: Array, since: AtReferences) -> Smoothed | None:
    """The average, its covariance increased by ``more`` (6, 6), as ``since`` has it published; None before the first
    measurement.
    """
    if average.cam_T_grip is None:
        return None
    cam_T_grip, covariance = since.quantity(average.cam_T_grip, average.claimed_covariance + more)
    transform = to_record(cam_T_grip)
    return Smoothed(transform.translation_m, transform.rotation_xyzw, flat(covariance))


def corner_records(
    measurement: Measurement, names: tuple[str, ...], taken: NDArray[np.bool_]
) -> tuple[CornerRecord, ...]:
    """Each corner, where it was measured, and whether it is among those ``taken`` (c,)."""
    corners = measurement.corners
    each = zip(names, corners.uv_px.tolist(), corners.sigma_px.tolist(), corners.fault, taken.tolist(), strict=True)
    return tuple(
        [
            CornerRecord(name, None, None, False, fault)
            if fault is not None
            else CornerRecord(name, (u, v), sigma, used, None if used else CornerFault.LEFT_OUT)
            for name, (u, v), sigma, fault, used in each
        ]
    )


def measured_record(
    frame: Frame,
    reference: ReferenceRecord,
    judgement: Judgement,
    standing: Standing,
    named: Named,
    corners: tuple[CornerRecord, ...],
    origin: Origin,
    smoothed: Smoothed | None,
    drift: Drift,
    alerts: tuple[Alert, ...],
    has_jaw: bool,
    valid_by: ValidBy,
) -> FrameRecord:
    """The record of a frame with a measured pose."""
    measurement = standing.measurement
    return FrameRecord(
        seq=frame.seq,
        stamp_ns=frame.stamp_ns,
        verdict=judgement.verdict,
        state=judgement.state,
        source=origin,
        cam_T_grip=to_record(named.cam_T_grip),
        covariance=flat(named.covariance),
        smoothed=smoothed,
        drift=drift,
        reference_id=reference.reference_id,
        revision=reference.revision,
        rms_px=measurement.corner_rms_px(standing.cam_T_grip),
        jaw_opening_m=measurement.jaw_opening_m if has_jaw else None,
        corners=corners,
        alerts=alerts,
        reason=judgement.reason,
        name=frame.name,
        protection=named.protection,
        valid_by=valid_by,
        since_reference=named.since_reference,
        absolute=named.absolute,
    )


def unmeasured_corners(names: tuple[str, ...], fault: CornerFault) -> tuple[CornerRecord, ...]:
    """All corners unmeasured, for one reason."""
    return tuple(CornerRecord(name, None, None, False, fault) for name in names)


def after_restart(reference: ReferenceRecord, evidence: Evidence, worth_m: float) -> Alert:
    """The alert whether the picture fits the reference after a restart: without a drift, and with a shift of at most
    ``worth_m``, which is worth a warning (m), plus five standard deviations.
    """
    off_m = float(np.linalg.norm(evidence.shift[:3]))
    fits = not evidence.motion.present and off_m <= worth_m + 5.0 * float(np.linalg.norm(evidence.sigma[:3]))
    text = f"restarted from {reference.reference_id}, revision {reference.revision}; the picture " + (
        "fits it" if fits else "does not fit it: the camera has moved"
    )
    text += f" ({1e3 * evidence.d_m:.2f} mm, {np.degrees(evidence.delta_rad):.2f} degrees)"
    return Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.INFO if fits else Severity.WARNING, text)


def frozen(faults: tuple[StreamFault, ...]) -> tuple[Refusal, str] | None:
    """The refusal of an image that repeats an earlier one, with the reason; None if it doesn't."""
    for fault in faults:
        if fault.kind == "frozen":
            return Refusal.FROZEN, fault.text
    return None


def of_stream(faults: tuple[StreamFault, ...]) -> Explanation:
    """The stream's explanation of refused images: another camera, or repeated images."""
    for fault in faults:
        if fault.kind in ("replaced", "frozen"):
            known = CauseWeight(fault.cause, 1.0)
            return Explanation((known,), known, fault.text)
    return Explanation()


def gripper_astray(measurement: Measurement, shares: list[float]) -> bool:
    """Whether the gripper contradicts its model: one finger is where the transform has it and another, though sampled,
    is not (hidden or bent), or the measured jaw opening is not the reported one.  ``shares``: inlier ratio of each
    finger's search lines.
    """
    if abs(measurement.jaw_innovation) > UNREPORTED_MOTION_SIGMAS:
        return True
    return max(shares) > USUAL_SHARE and min(shares) < FINGER_ASTRAY


class NoteTaker:
    """Gathers notes; the limits, which change slowly, only when the drift test or the reference's error has changed."""

    def __init__(self, settings: MonitorSettings):
        self._policy, self._tolerated = settings.policy, _six(settings.drift.tolerated)
        self._limits: Limits | None = None
        self._of: tuple[int, Array | None] = (-1, None)

    def take(self, watch: MotionWatch, baseline: Baseline, average: PoseAverage, measured: bool) -> MonitorNotes:
        """``measured``: the newest frame was measured, so that it may have been tested."""
        refreshes, offset = watch.test.refreshes, baseline.error
        if self._limits is None or self._of[0] != refreshes or self._of[1] is not offset:
            self._of = refreshes, offset
            self._limits = self._read(watch, offset, average)
        return MonitorNotes(watch.statistic_share if measured else None, self._limits)

    def _read(self, watch: MotionWatch, offset: Array | None, average: PoseAverage) -> Limits:
        policy, noticed = self._policy, watch.test.noticed()
        known = watch.test.refreshes > 0
        return Limits(
            policy.warn_m,
            policy.warn_rad,
            policy.limit_m,
            policy.limit_rad,
            self._tolerated,
            None if noticed is None else _six(noticed),
            None if offset is None else _six(offset),
            _six(np.sqrt(watch.test.scatter.of_single_frames()[0].diagonal())) if known else None,
            _six(average.learnt.scatter),
            _six(np.sqrt(average.learnt.walk)),
            policy.alert_limit_m,
            policy.alert_limit_rad,
        )


def _six(values: Array) -> SixNumbers:
    x, y, z, about_x, about_y, about_z = values.tolist()
    return x, y, z, about_x, about_y, about_z
