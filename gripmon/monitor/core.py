"""The per-frame method: predict, measure, update, judge, and past the limit recalibrate.

A pure function of the frames so far: no clock, no I/O, no threads.  Time is the frames' own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from gripmon.judge.inspection import inspect
from gripmon.judge.policy import Evidence, Judgement, Policy
from gripmon.judge.recalibrate import Proposal
from gripmon.judge.recalibrate import Refusal as Refused
from gripmon.judge.references import CommandRefused, Keep
from gripmon.judge.smoothing import PoseAverage
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import in_full_scale
from gripmon.model.poses import to_record
from gripmon.model.records import (
    Alert,
    Array,
    Beside,
    Command,
    CommandName,
    CommandReply,
    CornerFault,
    Explanation,
    Frame,
    FrameRecord,
    MeasurementTrace,
    MonitorNotes,
    MonitorState,
    Motion,
    Origin,
    ReferenceRecord,
    Refusal,
    State,
    Verdict,
    unmeasured_record,
)
from gripmon.monitor.analysis import FrameAnalysis
from gripmon.monitor.answers import (
    NoteTaker,
    after_restart,
    corner_records,
    drift_between,
    flat,
    frozen,
    measured_record,
    of_stream,
    smoothed_record,
    unmeasured_corners,
)
from gripmon.monitor.renewal import Renewal
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.standing import Standing
from gripmon.monitor.tracker import Tracker
from gripmon.monitor.trust import Integrity
from gripmon.track.edges import Measurement, TaughtEdges, trace_of

if TYPE_CHECKING:
    from gripmon.monitor.shadow import Shadow


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
        keep: Keep = lambda _: "",
        shadow: bool = False,
    ):
        """``state``: of :meth:`state` before a restart; its newest reference counts then.
        ``keep`` is called before any other reference comes into force: one that can't be kept is only proposed, or
        refused.
        ``shadow``: the belief is asked beside the rules, for benchmarks.

        Raises ValueError for an inconsistent state.
        """
        self._camera, self._gripper, self._settings = camera, gripper, settings
        # Taught offsets belong to the gripper's edges: a new reference doesn't change them.
        self._tracker = Tracker(camera, gripper, settings, taught)
        self.shadow = self._shadowed_by_belief(camera, reference) if shadow else None
        self._policy = Policy(settings.policy, settings.recalibration.mode != "off")
        self._average = PoseAverage(settings.smoothing)
        self._notes = NoteTaker(settings)
        self._due: list[Alert] = []  # of commands, for the next record
        self._covariance: Array | None = None
        self._trust = Integrity(camera, self._tracker, gripper, settings, reference)
        self._standing: Standing | None = None
        self._now_s = 0.0  # time that has passed since the first frame
        self._measured_s: float | None = None
        self._stamp_s: float | None = None
        self._newest: Measurement | None = None
        self._jumped = False  # since the last frame that was believed
        self._live = self._repeats = False  # frames wait for nothing; the newest one repeats a recorded one
        self._restarted = state is not None  # and not yet known whether the picture fits
        self._renewal = Renewal(settings, gripper, self._tracker.floor, reference, self._policy, state, keep)
        error = None if state is None or state.reference_error is None else np.array(state.reference_error)
        configured = self._renewal.book.configured
        self._analysis = FrameAnalysis(camera, gripper, settings, self._tracker, configured, error)
        self._begin()
        last = None if state is None else state.cam_T_grip
        self._located = last is not None  # here, or before a restart
        self._cam_T_grip = self._ref_cam_T_grip if last is None else from_record(last)
        self._trust.resume(None if last is None else self._cam_T_grip, self._renewal.book.in_force, state)
        if state is not None:
            self._policy.alerts.restore(state.alerts, state.alerts_raised, self._now_s)
            self._analysis.watch.resume(moved=self._policy.drifting)

    def _shadowed_by_belief(self, camera: Camera, reference: ReferenceRecord) -> Shadow:
        from gripmon.monitor.shadow import Shadow  # which no other run loads, or compiles

        return Shadow(camera, self._gripper, self._tracker, reference, self._settings)

    @property
    def reference(self) -> ReferenceRecord:
        """The calibration that drift is measured against now."""
        return self._renewal.book.current

    @property
    def displaced_at_start(self) -> bool:
        """Whether the gripper was first seen elsewhere than expected, and no operator has accepted a new reference."""
        return self._trust.unexplained is not None

    @property
    def strips_refused(self) -> str | None:
        """Why the strips that were kept over a restart aren't used; None where they are, or none were kept."""
        return self._trust.strips_refused

    @property
    def since_refused(self) -> str | None:
        """Why what a state has of the reference's frames isn't used; None where it is, or there was no state."""
        return self._trust.since_refused

    @property
    def proposal(self) -> ReferenceRecord | None:
        """A new reference that waits for an operator."""
        return self._renewal.book.proposal

    @property
    def recalibration(self) -> Proposal | Refused | None:
        """Outcome of the newest attempt at a new reference; None before the first one."""
        return self._renewal.outcome

    @property
    def state_revision(self) -> int:
        """Grows with each change of :meth:`state`, except of the last transform and the strips."""
        known = int(self._analysis.of_configured.error is not None) + int(self._trust.question is not None)
        known += self._trust.since.changes
        return self._renewal.book.changes + self._policy.alerts.changes + known

    def state(self) -> MonitorState:
        """What has to survive a restart."""
        error, question = self._analysis.of_configured.error, self._trust.question
        answered = None if question is None else question.answered
        return MonitorState(
            self._renewal.book.history,
            self._renewal.book.proposal,
            alerts=self._policy.alerts.open,
            alerts_raised=self._policy.alerts.raised,
            cam_T_grip=to_record(self._trust.last_known(self._cam_T_grip)) if self._located else None,
            reference_error=None if error is None else tuple(error.tolist()),
            unexplained=msgspec.UNSET if question is None else tuple(question.away.tolist()),
            explained_from=msgspec.UNSET if answered is None else answered,
            strips=self._trust.strips_state(),
            at_reference=self._trust.since.state() or msgspec.UNSET,
        )

    def run_live(self) -> None:
        """From now on no frame waits for what :meth:`run_pending` does: it counts from the frame on that follows its
        end, which :attr:`beside` tells.
        """
        self._live = True
        self._tracker.searching.live = self._analysis.causes.live = True

    @property
    def beside(self) -> Beside | None:
        """What the newest frame had to do with :meth:`run_pending`, to be recorded with it; None where it waits."""
        if not (self._live or self._repeats):
            return None
        searching = self._tracker.searching
        search = (False, None) if self._newest is None else (searching.searches, searching.searched_seq)
        return Beside(*search, self._analysis.causes.analysed)

    def process(self, frame: Frame, then: Beside | None = None) -> FrameRecord:
        """One frame in, one decision out.  Never raises for a bad frame: that is a record with a reason.  The image
        isn't used afterwards.  ``then``: :attr:`beside` as recorded of this frame, of which this is a replay.
        """
        self.learn()
        self._repeats = then is not None
        if self._settings.bit_depth < 16:
            frame = in_full_scale(frame, self._settings.bit_depth)
        opening: object = frame.jaw_opening_m
        if isinstance(opening, np.generic):
            frame = replace(frame, jaw_opening_m=opening.item())  # NumPy's own numbers can't be written to files
        self._tick(frame)
        faults = self._analysis.begin_frame(frame, self._now_s, then)
        self._due += self._policy.stream(faults, self._now_s, frame.stamp_ns)
        refusal = inspect(frame, self._camera, self._gripper, self._analysis.stream.pixels) or frozen(faults)
        if refusal is not None:
            self._newest = None
            reason = f"{refusal[0]}: {refusal[1]}"
            return self._unmeasured(frame, reason, CornerFault.FRAME_REFUSED, of_stream(faults), refusal[0])
        # Where the gripper is, and by how much that may be off.
        before_T, rivals = self._cam_T_grip, self._trust.rivals(self._ref_cam_T_grip)
        self._newest = self._tracker.measure(frame, before_T, self._now_s, rivals, then)
        if self.shadow is not None:
            self.shadow.see(frame, self._newest, self._now_s)
        standing = self._trust.judge(frame, self._newest, self._now_s)
        if standing is None:
            explanation = self._analysis.explain(frame, self._newest, wrong=True, usual=False, now_s=self._now_s)
            return self._unmeasured(frame, "too few edges of the gripper agree", CornerFault.NO_FIT, explanation)
        standing = self._analysis.checked(frame, standing, self._now_s)
        self._standing, self._newest = standing, standing.measurement
        self._cam_T_grip, self._covariance = standing.cam_T_grip, standing.covariance
        self._measured_s, self._located = self._now_s, True
        # Whether that is still the reference, and what has moved if it isn't.
        since = self._trust.since
        named = since.named(self._cam_T_grip, self._covariance, standing.bounds)
        drift = drift_between(self._ref_cam_T_grip, named.cam_T_grip)
        swing, doubtful = self._trust.swing, bool(faults)
        evidence = self._analysis.evidence(frame, standing, drift, before_T, swing, doubtful, self._now_s)
        self._jumped = self._jumped or evidence.jumped
        if standing.believed:
            self._follow(standing, evidence.motion)
        judgement = self._policy.measured(evidence, self._now_s, frame.stamp_ns)
        if self._restarted and judgement.state is not State.ACQUIRING:
            judgement = self._after_restart(judgement, evidence)
        alerts = judgement.alerts
        # Past the limit, or when an operator wants it, the still frames become a new reference.
        origin = Origin.UPDATE
        if self._renewal.collect(frame, standing, judgement):
            book, cause = self._renewal.book, evidence.explanation
            before, proposed = book.current, book.proposal
            alerts += self._renewal.recalibrate(
                drift, self._cam_T_grip, cause, self._trust.unexplained, self._now_s, frame.stamp_ns
            )
            if book.proposal is not None and book.proposal is not proposed:
                self._trust.measured_again(book.proposal)
            if book.current is not before:
                self._trust.measured_again(book.current)
                self._begin()
                named = since.named(self._cam_T_grip, self._covariance, standing.bounds)
                drift, origin = drift_between(self._ref_cam_T_grip, named.cam_T_grip), Origin.RECALIBRATION
        smoothed, alerts = smoothed_record(self._average, self._tracker.floor, since), (*self._take_due(), *alerts)
        taken = self._tracker.taken(standing.measurement)
        corners = corner_records(standing.measurement, self._gripper.corner_ids, taken)
        return measured_record(
            frame,
            self.reference,
            judgement,
            standing,
            named,
            corners,
            origin,
            smoothed,
            drift,
            alerts,
            self._gripper.has_jaw,
            self._settings.policy.valid_by,
        )

    def _after_restart(self, judgement: Judgement, evidence: Evidence) -> Judgement:
        """Suspect until a frame shows whether the picture fits the reference; then an alert reports which."""
        if evidence.motion.frames == 0 or not evidence.believed:
            reason = "restarted, and too few frames since to say whether the picture fits the reference"
            return judgement._replace(verdict=Verdict.SUSPECT, reason=reason)
        self._restarted = False
        compared = after_restart(self.reference, evidence, self._settings.policy.warn_m)
        return judgement._replace(alerts=(compared, *judgement.alerts))

    def _follow(self, standing: Standing, motion: Motion) -> None:
        """The measured pose is believed: update the averages and what is learnt."""
        proven = standing.where_it_was and not standing.unproven
        self._tracker.learn(standing.measurement, opening=not standing.grasped, proven=proven)
        jumped, self._jumped = self._jumped, False
        if jumped:
            self._average.forget()
        vibrates_anew = self._analysis.watch.vibrates_anew
        quiet = self._policy.state is State.TRACKING and not motion.stepped and not vibrates_anew
        self._average.add(standing.cam_T_grip, standing.covariance, quiet)
        if motion.stepped and not jumped:
            self._average.step(motion.step_frames)

    def learn(self) -> None:
        """Learn from the newest frame, in some 2 ms.  :meth:`process` begins with it if the caller hasn't done it."""
        self._trust.learn()
        self._analysis.watch.learn()

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._tracker.searching.pending or self._analysis.causes.pending

    def run_pending(self) -> None:
        """Search for a lost gripper and analyse causes, which takes as long as some frames; possibly in another thread
        than :meth:`process`.  Without it :meth:`process` does both; the records are the same.
        """
        self._tracker.searching.run_pending()
        self._analysis.causes.run_pending()

    def trace(self) -> MeasurementTrace | None:
        """The pixels behind the newest record; None if its frame was refused."""
        if self._newest is None:
            return None
        return trace_of(self._newest, self._camera, self._gripper)

    def notes(self) -> MonitorNotes:
        """The limits behind the newest record; takes some microseconds."""
        measured = self._newest is not None and self._newest.trusted
        return self._notes.take(self._analysis.watch, self._analysis.baseline, self._average, measured)

    def _tick(self, frame: Frame) -> None:
        """Advance time to the frame's stamp; a clock that was set back stops it for this frame only."""
        stamp_s = 1e-9 * frame.stamp_ns
        elapsed_s = max(stamp_s - self._stamp_s, 0.0) if self._stamp_s is not None else 0.0
        self._stamp_s = stamp_s
        self._now_s += elapsed_s
        self._average.wander(elapsed_s)

    def command(self, command: Command, stamp_ns: int) -> CommandReply:
        """Carry out an operator's command between two frames; one that can't be carried out changes nothing."""
        before, done = self.reference, True
        try:
            measurable = self._newest is not None and self._newest.trusted
            text, alerts = self._renewal.obey(command, self._cam_T_grip, measurable, self._now_s, stamp_ns)
            self._due += alerts
        except CommandRefused as refusal:
            done, text = False, str(refusal)
        if self.reference is not before:
            self._begin()
        wanted = command.name in (CommandName.STATE, CommandName.SNAPSHOT)
        state = self.state() if wanted else None
        if state is not None:  # without what only a restart needs, some kB
            state = msgspec.structs.replace(state, strips=msgspec.UNSET, at_reference=msgspec.UNSET)
        return CommandReply(command.name, done, text, self.reference.reference_id, self.reference.revision, state)

    def _begin(self) -> None:
        """Measure drift from the reference in force."""
        book = self._renewal.book
        configured = book.in_force == book.configured
        self._ref_cam_T_grip = from_record(self.reference.cam_T_grip)
        self._analysis.rebase(self.reference, configured)
        self._trust.refer(self.reference)
        self._trust.rebase(book.in_force)

    def _unmeasured(
        self,
        frame: Frame,
        reason: str,
        fault: CornerFault,
        explanation: Explanation,
        refusal: Refusal | None = None,
    ) -> FrameRecord:
        """The last transform, held with a growing covariance, or none when it is too old."""
        judgement = self._policy.unmeasured(self._now_s, frame.stamp_ns, refusal, self._measured_s, explanation)
        self._renewal.moved()
        blank = unmeasured_record(
            frame,
            self.reference,
            reason,
            verdict=judgement.verdict,
            state=judgement.state,
            corners=unmeasured_corners(self._gripper.corner_ids, fault),
            alerts=(*self._take_due(), *judgement.alerts),
            valid_by=self._settings.policy.valid_by,
        )
        if judgement.verdict is Verdict.UNKNOWN or self._covariance is None or self._measured_s is None:
            return blank
        unseen_s = self._now_s - self._measured_s
        growth = np.diag(self._policy.hold_variance(unseen_s))
        assert self._standing is not None
        since, both = self._trust.since, self._trust.held(self._standing, growth, unseen_s, refusal is None)
        named = since.named(self._cam_T_grip, self._covariance + growth, both)
        return msgspec.structs.replace(
            blank,
            cam_T_grip=to_record(named.cam_T_grip),
            covariance=flat(named.covariance),
            smoothed=smoothed_record(self._average, self._tracker.floor + growth, since),
            drift=drift_between(self._ref_cam_T_grip, named.cam_T_grip),
            protection=named.protection,
            since_reference=named.since_reference,
            absolute=named.absolute,
        )

    def _take_due(self) -> list[Alert]:
        due, self._due = self._due, []
        return due
