"""The per-frame method: predict, measure, update, judge, and past the limit recalibrate.

A pure function of the frames so far: no clock, no I/O, no threads.  Time is the frames' own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.camera import Camera
from gripmon.corners import (
    Effort,
    FingertipMeter,
    Measurement,
    MeasurementSettings,
    Patience,
    TaughtEdges,
    agreeing_fingers,
    edge_sums,
    finger_shares,
    trace_of,
)
from gripmon.differential import DegenerateGeometry, Update, differential_update
from gripmon.geometry import (
    from_record,
    invert,
    perturb,
    perturbation_between,
    rotation_angle,
    to_record,
)
from gripmon.gripper import Gripper
from gripmon.inspection import inspect
from gripmon.jaw import JawKnowledge
from gripmon.policy import Evidence, Judgement, Policy, PolicySettings
from gripmon.recalibrate import Proposal, RecalibrationSettings, Recalibrator, Refusal, StillFrame
from gripmon.records import (
    Alert,
    AlertKind,
    Array,
    Cause,
    Command,
    CommandName,
    CommandReply,
    CornerFault,
    CornerRecord,
    Drift,
    Frame,
    FrameRecord,
    MeasurementTrace,
    MonitorState,
    Origin,
    ReferenceRecord,
    Severity,
    Smoothed,
    State,
    Verdict,
    unmeasured_record,
)
from gripmon.references import CommandRefused, ReferenceBook
from gripmon.smoothing import PoseAverage, SmoothingSettings

USUAL_SHARE = 0.6
"""Share of agreeing profiles that is expected before anything is known about this gripper."""

USUAL_RATES = (0.02, 0.1)
"""How fast the usual share follows a smaller and a larger one, per frame: trust is not lowered by a few bad frames."""

FINGER_SEEN, FINGER_ASTRAY = 0.6, 0.35
"""Shares of a finger's profiles that agree: above the first it is where it should be, below the second it is not."""

CORNER_COUNTS = {"all": None, "3P": 3, "4P": 4, "5P": 5}
"""Most corners that a variant takes; named as in the paper."""

JAW_SURPRISE = 5.0
"""Standard deviations of the reported jaw opening by which the seen one must differ to be the cause of a drift."""


class MonitorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole method, a section for each step."""

    measurement: Annotated[
        Literal["edges", "corners"],
        Meta(description="what the update rests on: all agreed edge points, or the corners of equation (17)"),
    ] = "edges"
    update_corners: Annotated[
        Literal["all", "3P", "4P", "5P"],
        Meta(
            description="with measurement: corners, which ones: all that are usable, or so many of them next to the TCP"
        ),
    ] = "all"
    recalibrate_corners: Annotated[
        Literal["all", "4P", "5P"],
        Meta(
            description="which corners a recalibration takes: all that are usable, or so many of them next to the TCP"
        ),
    ] = "all"
    jaw_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the part of the reported jaw opening's error that changes as the jaw "
            "moves; 0: the report is exact (m)",
        ),
    ] = 5e-5
    jaw_offset_sigma_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.05,
            description="standard deviation of the part that never changes; no effect where the report is exact (m)",
        ),
    ] = 2e-4
    floor_m: Annotated[
        float,
        Meta(ge=0.0, le=0.01, description="systematic error of the position that no averaging removes, each axis (m)"),
    ] = 2e-6
    floor_rad: Annotated[
        float,
        Meta(ge=0.0, le=0.1, description="systematic error of the rotation that no averaging removes, each axis (rad)"),
    ] = 5e-5
    corners: MeasurementSettings = MeasurementSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    policy: PolicySettings = PolicySettings()
    recalibration: RecalibrationSettings = RecalibrationSettings()


class Monitor:
    """Watches one camera on one gripper, starting from a reference calibration."""

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        settings: MonitorSettings,
        reference: ReferenceRecord,
        taught: TaughtEdges | None = None,
        state: MonitorState | None = None,
    ):
        """``state``, where given, is what :meth:`state` said before a restart: its newest reference counts then.

        Raises ValueError for a state that doesn't hold together.
        """
        self._camera, self._gripper, self._settings = camera, gripper, settings
        # What was taught belongs to the gripper's edges: a new reference doesn't change it.
        self._jaw = JawKnowledge(settings.jaw_sigma_m, settings.jaw_offset_sigma_m)
        self._meter = FingertipMeter(camera, gripper, settings.corners, self._jaw.report_sigma_m, taught)
        self._book = (
            ReferenceBook(reference) if state is None else ReferenceBook.restored(state.references, state.proposal)
        )
        reference_sigma = np.sqrt(np.reshape(self.reference.covariance, (6, 6)).diagonal())
        self._policy = Policy(settings.policy, reference_sigma)
        self._average = PoseAverage(settings.smoothing)
        self._floor = np.diag(np.square([settings.floor_m] * 3 + [settings.floor_rad] * 3))
        most_corners = CORNER_COUNTS[settings.recalibrate_corners]
        self._recalibrator = Recalibrator(settings.recalibration, gripper, self._floor, most_corners)
        self._outcome: Proposal | Refusal | None = None
        self._ref_cam_T_grip = from_record(self.reference.cam_T_grip)
        last = None if state is None else state.cam_T_grip
        self._cam_T_grip = self._ref_cam_T_grip if last is None else from_record(last)
        self._restarted = state is not None  # and not yet said whether the picture fits
        self._due: list[Alert] = []  # of commands, for the next record
        self._covariance: Array | None = None
        self._jaw_opening_m = gripper.jaw_nominal_m
        self._now_s = 0.0  # time that has passed since the first frame
        self._measured_s: float | None = None
        self._stamp_s: float | None = None
        self._usual_share = USUAL_SHARE
        self._credit = float(settings.corners.search.eager_frames)
        self._untrusted = 0
        self._newest: Measurement | None = None

    @property
    def reference(self) -> ReferenceRecord:
        """The calibration that drift is measured against now."""
        return self._book.current

    @property
    def proposal(self) -> ReferenceRecord | None:
        """A new reference that waits for an operator."""
        return self._book.proposal

    @property
    def recalibration(self) -> Proposal | Refusal | None:
        """What came of the newest attempt at a new reference; None before the first one."""
        return self._outcome

    @property
    def state_revision(self) -> int:
        """Grows with each change of what :meth:`state` gives, the last transform aside."""
        return self._book.changes

    def state(self) -> MonitorState:
        """What has to survive a restart."""
        last = None if self._covariance is None else to_record(self._cam_T_grip)
        return MonitorState(self._book.history, self._book.proposal, cam_T_grip=last)

    def command(self, command: Command, stamp_ns: int) -> CommandReply:
        """Do what an operator asks, between two frames; what can't be done is refused and changes nothing."""
        done = True
        try:
            text = self._obey(command, stamp_ns)
        except CommandRefused as refusal:
            done, text = False, str(refusal)
        state = self.state() if command.name is CommandName.STATE else None
        return CommandReply(command.name, done, text, self.reference.reference_id, self.reference.revision, state)

    def _obey(self, command: Command, stamp_ns: int) -> str:
        name, argument = command.name, command.argument
        if name is CommandName.STATE:
            return f"{self._policy.state}, {self.reference.reference_id} in force, revision {self.reference.revision}"
        if name is CommandName.ACKNOWLEDGE:
            raise CommandRefused("no alert is open")
        if name is CommandName.REJECT:
            return f"{self._book.reject(argument).reference_id} is rejected"
        if name is CommandName.RECALIBRATE:
            if self._newest is None or not self._newest.trusted:
                raise CommandRefused("nothing was measured in the newest frame")
            before, told = self.reference, self._recalibrate(stamp_ns)
            if self.reference is before:
                raise CommandRefused("not calibrated anew now" if told is None else told.text)
            return f"calibrated anew: {self.reference.reference_id}"
        if name is CommandName.ACCEPT:
            self._book.accept(argument)
        elif name is CommandName.UNDO:
            self._book.undo(stamp_ns, argument)
        else:
            self._book.reset(stamp_ns)
        self._ref_cam_T_grip = from_record(self.reference.cam_T_grip)
        restored = self.reference.restores
        text = f"{self.reference.reference_id} is in force" + (f" and restores {restored}" if restored else "")
        kind = AlertKind.RESTORED if restored else AlertKind.RECALIBRATED
        self._due.append(msgspec.structs.replace(self._policy.recalibrated(text), kind=kind))
        return text

    def process(self, frame: Frame) -> FrameRecord:
        """One frame in, one decision out.  Never raises for a bad frame: that is a record with a reason."""
        self._tick(frame)
        refusal = inspect(frame, self._camera, self._gripper)
        if refusal is not None:
            self._newest = None
            return self._unmeasured(frame, f"{refusal[0]}: {refusal[1]}", CornerFault.FRAME_REFUSED, refusal[0])
        measurement = self._newest = self._measure(frame)
        if not measurement.trusted:
            return self._unmeasured(frame, "too few edges of the gripper agree", CornerFault.NO_FIT, None)
        before_T = self._cam_T_grip
        measurement = self._newest = self._with_known_jaw(measurement, frame.jaw_opening_m)
        self._cam_T_grip, self._covariance = self.update(measurement)
        self._jaw_opening_m, self._measured_s = measurement.jaw_opening_m, self._now_s
        drift = self._drift()
        evidence = self._evidence(measurement, before_T, drift)
        if evidence.jumped:
            self._average.forget()
        self._average.add(self._cam_T_grip, self._covariance)
        judgement = self._policy.measured(evidence)
        origin, alerts = Origin.UPDATE, judgement.alerts
        if self._restarted and judgement.state is not State.ACQUIRING:
            self._restarted = False
            alerts = (self._after_restart(evidence), *alerts)
        if judgement.state is not State.RECALIBRATING or self._policy.still_frames <= 1:
            self._recalibrator.forget()
        if judgement.state is State.RECALIBRATING:
            self._recalibrator.add(self._still(measurement, frame))
        if judgement.recalibrate:
            revision = self.reference.revision
            told = self._recalibrate(frame.stamp_ns)
            alerts = alerts if told is None else (*alerts, told)
            if self.reference.revision != revision:
                origin, drift = Origin.RECALIBRATION, self._drift()
        return self._record(frame, judgement, origin, alerts, measurement, drift)

    def trace(self) -> MeasurementTrace | None:
        """The pixels behind the newest record; None if its frame was refused."""
        if self._newest is None:
            return None
        return trace_of(self._newest, self._camera, self._gripper)

    def _tick(self, frame: Frame) -> None:
        """Time passes to the frame's stamp; a clock that was set back stops it for this one frame only."""
        stamp_s = 1e-9 * frame.stamp_ns
        elapsed_s = max(stamp_s - self._stamp_s, 0.0) if self._stamp_s is not None else 0.0
        self._stamp_s = stamp_s
        self._now_s += elapsed_s
        self._average.wander(elapsed_s)

    def _measure(self, frame: Frame) -> Measurement:
        """Measure where the gripper is expected; look further when clearly fewer edge points agree than usually.

        A doubtful fit pays for looking further from a credit that good frames refill slowly; a lost gripper is
        searched for in the first frames, then in one of several.
        """
        search = self._settings.corners.search
        reported_m = frame.jaw_opening_m
        assert frame.image is not None
        measurement = self._meter.measure(
            frame.image,
            self._cam_T_grip,
            self._jaw_opening_m if reported_m is None else reported_m,
            self._usual_share,
            Patience(
                when_doubtful=self._credit >= 1.0,
                when_lost=self._untrusted < search.eager_frames or self._untrusted % search.patient_every == 0,
            ),
            jaw_reported=reported_m is not None,
        )
        share = measurement.consensus.share
        earned = -1.0 if measurement.looked_far else 1.0 / search.refill_frames
        self._credit = min(max(self._credit + earned, 0.0), float(search.eager_frames))
        self._untrusted = 0 if measurement.trusted else self._untrusted + 1
        if measurement.trusted:
            self._usual_share += USUAL_RATES[int(share > self._usual_share)] * (share - self._usual_share)
        return measurement

    def _with_known_jaw(self, measurement: Measurement, reported_m: float | None) -> Measurement:
        """The same with the opening's error as earlier frames have shown it."""
        if reported_m is None or not self._gripper.has_jaw:
            return measurement
        fused = self._jaw.fuse(measurement.jaw_reported_m, measurement.jaw_opening_m, measurement.covariance)
        covariance = measurement.covariance.copy()
        covariance[:6, :6] = fused.covariance
        covariance[6, 6] = fused.sigma_m**2
        return replace(
            measurement,
            cam_T_grip=perturb(measurement.cam_T_grip, fused.xi),
            jaw_opening_m=min(max(fused.jaw_opening_m, self._gripper.jaw_min_m), self._gripper.jaw_max_m),
            covariance=covariance,
            jaw_surprise=max(measurement.jaw_surprise, fused.surprise, key=abs),
        )

    def update(self, measurement: Measurement) -> tuple[Array, Array]:
        """The corrected transform and its covariance: by all agreed edge points, or by the corners and equation
        (17).
        """
        cam_T_grip, covariance = measurement.cam_T_grip, measurement.covariance[:6, :6]
        taken = self._taken(measurement, self._settings.update_corners)
        if self._settings.measurement == "corners" and np.count_nonzero(taken) >= 3:
            covariance_xy = measurement.corners.joint_covariance_xy(taken)
            try:
                update = self._corner_update(measurement, taken, covariance_xy, measurement.jaw_opening_m)
                cam_T_grip = perturb(measurement.prediction.cam_T_grip, update.xi)
                covariance = update.covariance
                if self._gripper.has_jaw:
                    # The corners take the opening as known: what its uncertainty does to the motion comes on top.
                    jaw_sigma_m = float(np.sqrt(measurement.covariance[6, 6]))
                    opened_m = measurement.jaw_opening_m + jaw_sigma_m
                    opened = self._corner_update(measurement, taken, covariance_xy, opened_m)
                    covariance = covariance + np.outer(opened.xi - update.xi, opened.xi - update.xi)
            except DegenerateGeometry:
                pass  # The corners that are left lie on a line: the edges still determine the motion.
        return cam_T_grip, covariance + self._floor

    @staticmethod
    def _corner_update(
        measurement: Measurement, taken: NDArray[np.bool_], covariance_xy: Array, jaw_opening_m: float
    ) -> Update:
        """Equation (17) on the corners ``taken`` (c,), with the jaw at an opening."""
        return differential_update(
            measurement.corners_at(jaw_opening_m)[taken],
            measurement.corners.xy[taken],
            covariance_xy,
            measurement.prediction.cam_T_grip[:3, 3],
        )

    def _taken(self, measurement: Measurement, variant: str) -> NDArray[np.bool_]:
        """(c,) the usable corners that a variant takes."""
        return self._gripper.innermost_corners(measurement.corners.usable, CORNER_COUNTS[variant])

    def _evidence(self, measurement: Measurement, before_T: Array, drift: Drift) -> Evidence:
        assert self._covariance is not None
        shift = perturbation_between(self._ref_cam_T_grip, self._cam_T_grip)
        # Motion that the profiles can follow from frame to frame is no jump.
        looked_far = measurement.effort is not Effort.NARROW
        jumped = looked_far and self._meter.moved_px(measurement, before_T) > self._settings.corners.sampling.reach_px
        cause = self._cause(measurement) if jumped or self._policy.wants_cause else Cause.UNKNOWN
        sigma = np.sqrt(self._covariance.diagonal())
        astray = self._gripper_astray(measurement)
        return Evidence(shift, sigma, drift.translation_m, drift.rotation_rad, jumped, cause, astray)

    def _gripper_astray(self, measurement: Measurement) -> bool:
        """Whether the gripper contradicts its model: one finger is where the transform says and another, though
        sampled, is not (hidden, or bent), or the seen jaw opening is not the reported one.
        """
        if abs(measurement.jaw_surprise) > JAW_SURPRISE:
            return True
        shares = agreeing_fingers(measurement, self._gripper)
        return max(shares) > FINGER_SEEN and min(shares) < FINGER_ASTRAY

    def _drift(self) -> Drift:
        """Equation (14) for the motion from the reference to now, and the TCP's way in the camera frame."""
        motion = self._cam_T_grip @ invert(self._ref_cam_T_grip)
        x, y, z = (self._cam_T_grip[:3, 3] - self._ref_cam_T_grip[:3, 3]).tolist()
        return Drift(float(np.sqrt(motion[:3, 3] @ motion[:3, 3])), rotation_angle(motion[:3, :3]), (x, y, z))

    def _cause(self, measurement: Measurement) -> Cause:
        """A finger that left the reference alone is bent; when all have left it, the camera has moved."""
        shares = finger_shares(measurement, self._gripper, self._ref_cam_T_grip)
        known = shares[np.isfinite(shares)]
        if len(known) >= 2 and known.max() > 0.6 and known.min() < 0.3:
            return Cause.FINGER_BENT
        if abs(measurement.jaw_surprise) > JAW_SURPRISE:
            return Cause.JAW_OPENING
        return Cause.CAMERA_MOUNT if len(known) and known.max() < 0.6 else Cause.UNKNOWN

    def _still(self, measurement: Measurement, frame: Frame) -> StillFrame:
        """What this frame has to say of a new reference."""
        assert self._covariance is not None
        corners = measurement.corners
        points_grip_m = self._gripper.points_grip_m(measurement.jaw_opening_m)[self._gripper.corner_points]
        return StillFrame(
            frame.seq,
            frame.stamp_ns,
            self._cam_T_grip,
            self._covariance,
            points_grip_m,
            corners.usable,
            corners.xy,
            corners.joint_covariance_xy(corners.usable),
            edge_sums(measurement, self._gripper, self._cam_T_grip, measurement.jaw_opening_m),
        )

    def _recalibrate(self, stamp_ns: int) -> Alert | None:
        """The frames since the camera came to rest become the reference, or a proposal, or neither.

        Returns what there is to say of it; later frames may try again.
        """
        outcome = self._outcome = self._recalibrator.outcome(self.reference)
        if isinstance(outcome, Refusal):
            return None if outcome.wait else self._policy.not_recalibrated(outcome.text)
        if outcome.wait:
            return None
        before = self._drift()
        moved = (
            f"the camera moved by {1e3 * before.translation_m:.2f} mm and {np.degrees(before.rotation_rad):.2f} degrees"
        )
        draft = self._book.draft(outcome.cam_T_grip, outcome.covariance, stamp_ns, inputs=outcome.inputs)
        if outcome.needs_person is not None:
            if self._book.proposal is not None:
                return None
            self._book.propose(draft)
            text = f"{moved}; a new reference waits to be accepted: {outcome.needs_person}"
            return Alert(AlertKind.PROPOSED, Cause.UNKNOWN, Severity.WARNING, text)
        self._book.adopt(draft)
        self._ref_cam_T_grip = outcome.cam_T_grip
        return self._policy.recalibrated(
            f"{moved}; it was calibrated anew from {len(outcome.inputs.corners)} corners in {outcome.inputs.frames} "
            f"frames: revision {self.reference.revision}"
        )

    def _after_restart(self, evidence: Evidence) -> Alert:
        """Whether the picture fits the reference from which the monitor went on."""
        sigma = np.sqrt(np.reshape(self.reference.covariance, (6, 6)).diagonal())
        allowed = np.maximum(self._policy.test.smallest, 4.0 * np.hypot(sigma, evidence.sigma))
        fits = bool((np.abs(evidence.shift) <= allowed).all())
        text = f"restarted from {self.reference.reference_id}, revision {self.reference.revision}; the picture " + (
            "fits it" if fits else "does not fit it: the camera has moved"
        )
        text += f" ({1e3 * evidence.d_m:.2f} mm, {np.degrees(evidence.delta_rad):.2f} degrees)"
        return Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.INFO if fits else Severity.WARNING, text)

    def _unmeasured(self, frame: Frame, reason: str, fault: CornerFault, refusal: str | None) -> FrameRecord:
        """The last transform held with a covariance that grows, or none when it is too old."""
        judgement = self._policy.unmeasured(self._now_s, refusal, self._measured_s)
        corners = tuple(CornerRecord(name, None, None, False, fault) for name in self._gripper.corner_ids)
        blank = unmeasured_record(
            frame,
            self.reference,
            reason,
            verdict=judgement.verdict,
            state=judgement.state,
            corners=corners,
            alerts=(*self._noted(), *judgement.alerts),
        )
        if judgement.verdict is Verdict.UNKNOWN or self._covariance is None or self._measured_s is None:
            return blank
        growth = np.diag(self._policy.hold_variance(self._now_s - self._measured_s))
        return msgspec.structs.replace(
            blank,
            cam_T_grip=to_record(self._cam_T_grip),
            covariance=_flat(self._covariance + growth),
            smoothed=self._smoothed(growth),
            drift=self._drift(),
        )

    def _record(
        self,
        frame: Frame,
        judgement: Judgement,
        origin: Origin,
        alerts: tuple[Alert, ...],
        measurement: Measurement,
        drift: Drift,
    ) -> FrameRecord:
        assert self._covariance is not None
        return FrameRecord(
            seq=frame.seq,
            stamp_ns=frame.stamp_ns,
            verdict=judgement.verdict,
            state=judgement.state,
            source=origin,
            cam_T_grip=to_record(self._cam_T_grip),
            covariance=_flat(self._covariance),
            smoothed=self._smoothed(),
            drift=drift,
            reference_id=self.reference.reference_id,
            revision=self.reference.revision,
            rms_px=measurement.corner_rms_px(self._cam_T_grip),
            jaw_opening_m=measurement.jaw_opening_m if self._gripper.has_jaw else None,
            corners=_corner_records(
                measurement, self._gripper.corner_ids, self._taken(measurement, self._settings.update_corners)
            ),
            alerts=(*self._noted(), *alerts),
            name=frame.name,
        )

    def _noted(self) -> list[Alert]:
        noted, self._due = self._due, []
        return noted

    def _smoothed(self, growth: Array | float = 0.0) -> Smoothed | None:
        if self._average.cam_T_grip is None:
            return None
        transform = to_record(self._average.cam_T_grip)
        covariance = self._average.claimed_covariance + self._floor + growth
        return Smoothed(transform.translation_m, transform.rotation_xyzw, _flat(covariance))


def _flat(covariance: Array) -> tuple[float, ...]:
    return tuple(covariance.ravel().tolist())


def _corner_records(
    measurement: Measurement, names: tuple[str, ...], taken: NDArray[np.bool_]
) -> tuple[CornerRecord, ...]:
    corners = measurement.corners
    return tuple(
        CornerRecord(name, None, None, False, fault)
        if fault is not None
        else CornerRecord(name, (u, v), sigma, used, None if used else CornerFault.LEFT_OUT)
        for name, (u, v), sigma, fault, used in zip(
            names, corners.uv_px.tolist(), corners.sigma_px.tolist(), corners.fault, taken.tolist(), strict=True
        )
    )
