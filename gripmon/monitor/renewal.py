"""Renewal of the reference: measured again past the limit, accepted by an operator, or undone by one."""

from __future__ import annotations

import math
from typing import assert_never

import numpy as np

from gripmon.judge.policy import NO_REFERENCE, Judgement, Policy
from gripmon.judge.recalibrate import Proposal, Recalibrator, Refusal, StillFrame
from gripmon.judge.references import CommandRefused, Keep, ReferenceBook
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import (
    Alert,
    AlertKind,
    Array,
    Cause,
    Command,
    CommandName,
    Drift,
    Explanation,
    Frame,
    MonitorState,
    ReferenceRecord,
    Severity,
    State,
)
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.standing import Standing
from gripmon.monitor.tracker import CORNER_COUNTS
from gripmon.track.edges import Measurement, edge_sums

KEEP_AGAIN_S = 10.0
"""Pause before a reference that could not be kept is measured and tried again: a full disk stays full for a while."""


class Renewal:
    """The references and what changes them.  Callers see a change in ``book.current``."""

    def __init__(
        self,
        settings: MonitorSettings,
        gripper: Gripper,
        floor: Array,
        reference: ReferenceRecord,
        policy: Policy,
        state: MonitorState | None,
        keep: Keep,
    ):
        """``floor`` (6, 6): covariance of the systematic error; ``keep`` is called before any new reference.

        Raises ValueError for an inconsistent state.
        """
        self._gripper, self._policy, self._settings = gripper, policy, settings.recalibration
        self._settle_frames = settings.policy.settle_frames
        self._recalibrator = Recalibrator(
            settings.recalibration, gripper, floor, CORNER_COUNTS[settings.recalibrate_corners]
        )
        self._collects = False
        self.outcome: Proposal | Refusal | None = None
        """Outcome of the newest attempt at a new reference; None before the first one."""
        self.wanted = False
        """Whether an operator wants a new reference."""
        self._rejected: ReferenceRecord | None = None  # by an operator, in place of the reference in force
        self._unkept: ReferenceRecord | None = None  # the proposal, if it waits only because it couldn't be kept
        self._keep_again_s = 0.0
        self.book = (
            ReferenceBook(reference, keep)
            if state is None
            else ReferenceBook.restored(state.references, state.proposal, keep)
        )

    def moved(self) -> None:
        """The camera doesn't stand still, or needs no new reference: discard the collected frames."""
        if self._collects:
            self._recalibrator.forget()
            self._collects = False

    def collect(self, frame: Frame, standing: Standing, judgement: Judgement) -> bool:
        """Past the limit, or when an operator wants it, collect a frame whose pose is believed; return whether there
        are enough to measure the reference again.
        """
        if judgement.state is not State.RECALIBRATING and not self.wanted:
            self.moved()
            return False
        still_frames = self._policy.still_frames
        if still_frames <= 1:
            self.moved()
        if not standing.believed:
            return False
        self.still(frame, standing.measurement, standing.cam_T_grip, standing.covariance)
        return judgement.recalibrate or (self.wanted and still_frames >= self._settle_frames)

    def still(self, frame: Frame, measurement: Measurement, cam_T_grip: Array, covariance: Array) -> None:
        """Add a frame of a camera that stands still."""
        self._collects = True
        corners, jaw_opening_m = measurement.corners, measurement.jaw_opening_m
        self._recalibrator.add(
            StillFrame(
                frame.seq,
                frame.stamp_ns,
                cam_T_grip,
                covariance,
                self._gripper.points_grip_m(jaw_opening_m)[self._gripper.corner_points],
                corners.usable,
                corners.xy,
                corners.joint_covariance_xy(corners.usable),
                edge_sums(measurement, self._gripper, cam_T_grip, jaw_opening_m),
            )
        )

    def _want(self) -> str:
        """Note that an operator wants a new reference: it is measured once the camera stands still for long enough."""
        if self._settings.mode == "off":
            raise CommandRefused("recalibration is switched off (monitor.recalibration.mode)")
        self.wanted = True
        return (
            f"as soon as the camera has stood still for {self._settings.frames} frames; an alert says what came of it"
        )

    def recalibrate(
        self,
        drift: Drift,
        cam_T_grip: Array,
        explanation: Explanation,
        unexplained: Array | None,
        now_s: float,
        stamp_ns: int,
    ) -> tuple[Alert, ...]:
        """Make the frames since the camera came to rest a reference, or a proposal, or neither; return the alerts.
        ``cam_T_grip`` (4, 4): where the gripper is now; ``unexplained`` (6,): how far from its reference the first
        frames had it, if that is open.
        """
        cause = explanation.probable.cause
        if self.wanted and cause in NO_REFERENCE:
            self.wanted = False
            text = f"not calibrated again, as an operator wanted: {explanation.text or cause}"
            return self._policy.refused(text, explanation, now_s, stamp_ns)
        again = self._unkept is not None and self._unkept is self.book.proposal and now_s >= self._keep_again_s
        known = (None if again else self.book.proposal, self._rejected)
        if not self.wanted and any(self._holds(each, cam_T_grip) for each in known):
            return ()
        outcome = self.outcome = self._recalibrator.outcome(self.book.current)
        if outcome.wait:
            return ()
        asked, self.wanted = self.wanted, False
        if isinstance(outcome, Refusal):
            self._policy.not_recalibrated()
            if self.book.proposal is not None:
                self.book.reject()  # of another place, and no longer in the alerts
            why = "as an operator wanted" if asked else "though past the limit"
            return self._policy.refused(f"not calibrated again, {why}: {outcome.text}", explanation, now_s, stamp_ns)
        moved = (
            f"the TCP has moved by {1e3 * math.hypot(*drift.tcp_shift_m):.2f} mm, turned by "
            f"{math.degrees(drift.rotation_rad):.2f} degrees"
        )
        draft = self.book.draft(outcome.cam_T_grip, outcome.covariance, stamp_ns, cause=cause, inputs=outcome.inputs)
        asks = [] if outcome.needs_person is None else [outcome.needs_person]
        if self.book.chosen_by_operator and not asked:
            asks.append("an operator chose the reference in force")
        if unexplained is not None:
            asks.append(
                f"the first frames showed the gripper {1e3 * np.linalg.norm(unexplained[:3]):.2f} mm from where it was "
                "expected: accept it if the camera was knocked before, not if fingertips, gripper file or reference "
                "are wrong"
            )
        if asks:
            self.book.propose(draft)
            parts = [f"{moved}; the new reference {draft.reference_id} waits to be accepted", *asks, explanation.text]
            return self._policy.proposed("; ".join(p for p in parts if p), explanation, now_s, stamp_ns)
        try:
            self.book.adopt(draft)
        except CommandRefused as refusal:
            return self._not_kept(draft, str(refusal), asked, explanation, now_s, stamp_ns)
        self._rejected = self._unkept = None
        text = (
            f"{moved}; it was calibrated again from {outcome.inputs.frames} frames, corners "
            f"{', '.join(outcome.inputs.corners)}: revision {self.book.current.revision}"
        )
        done = Alert(AlertKind.RECALIBRATED, cause, Severity.WARNING, text)
        return (*self._policy.recalibrated(now_s), done)

    def _not_kept(
        self, draft: ReferenceRecord, why: str, asked: bool, explanation: Explanation, now_s: float, stamp_ns: int
    ) -> tuple[Alert, ...]:
        """Propose a new reference that can't be kept: until it can, or until an operator accepts it."""
        self._keep_again_s = now_s + KEEP_AGAIN_S
        if not asked and self._unkept is not None and self._unkept is self.book.proposal:
            return ()  # the alert is open already
        self.book.propose(draft)
        self._unkept = draft
        text = f"{why}; it is tried again every {KEEP_AGAIN_S:g} s"
        return self._policy.proposed(text, explanation, now_s, stamp_ns)

    def _holds(self, proposal: ReferenceRecord | None, cam_T_grip: Array) -> bool:
        """Whether there is a proposal and the gripper is there, to within six standard deviations or what would be
        worth a warning, whichever is more.
        """
        if proposal is None:
            return False
        away = perturbation_between(from_record(proposal.cam_T_grip), cam_T_grip)
        sigma = np.sqrt(np.reshape(proposal.covariance, (6, 6)).diagonal())
        return bool((np.abs(away) <= np.maximum(6.0 * sigma, self._policy.worth_a_warning)).all())

    def obey(
        self, command: Command, cam_T_grip: Array, measurable: bool, now_s: float, stamp_ns: int
    ) -> tuple[str, tuple[Alert, ...]]:
        """Carry out an operator's command between two frames; return a text for the operator, and the alerts.

        ``cam_T_grip`` (4, 4) is where the gripper is; ``measurable``: the newest frame shows it.  ``now_s`` is the
        frames' time, ``stamp_ns`` the wall clock's.  Raises :class:`CommandRefused`; then nothing has changed.
        """
        name, argument = command.name, command.argument
        if name in (CommandName.STATE, CommandName.SNAPSHOT):
            reference = self.book.current
            return f"{self._policy.state}, {reference.reference_id} in force, revision {reference.revision}", ()
        if name is CommandName.ACKNOWLEDGE:
            seen = self._policy.alerts.acknowledge(argument)
            if not seen:
                which = f"no open alert {argument}" if argument else "no open alert"
                raise CommandRefused(f"{which} that isn't acknowledged")
            return "acknowledged: " + ", ".join(alert.alert_id for alert in seen), seen
        if name is CommandName.RECALIBRATE:
            if not measurable:
                raise CommandRefused("nothing was measured in the newest frame")
            return self._want(), ()
        if name is CommandName.REJECT:
            rejected = self._rejected = self.book.reject(argument)
            self.wanted = False
            self.moved()
            self._policy.not_recalibrated()
            return f"{rejected.reference_id} is rejected", self._policy.decided("the proposal was rejected", now_s)
        if name is CommandName.ACCEPT:
            proposal = self.book.proposal
            if proposal is not None and not self._holds(proposal, cam_T_grip):
                raise CommandRefused(f"the camera has moved since {proposal.reference_id} was proposed")
            self.book.accept(argument)
        elif name is CommandName.UNDO:
            self.book.undo(stamp_ns, argument)
        elif name is CommandName.RESET:
            self.book.reset(stamp_ns)
        else:
            assert_never(name)
        # An earlier request is obsolete: it must not undo this command.
        self.wanted, self._rejected = False, None
        current = self.book.current
        text = f"{current.reference_id} is in force, revision {current.revision}"
        if current.restores:
            text += f"; it restores {current.restores}"
        kind = AlertKind.RESTORED if current.restores else AlertKind.RECALIBRATED
        return text, (*self._policy.recalibrated(now_s), Alert(kind, Cause.UNKNOWN, Severity.WARNING, text))
