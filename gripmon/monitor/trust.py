"""Which pose is published, and how far it is trusted: where a measurement and the anchor differ, one must be proven.

A pose that isn't where the gripper was is believed when the fingers' ends are seen there as ends and the gripper's
learned look doesn't contradict: mounts are knocked rarely, objects hide fingers in every grasp.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from gripmon.judge.inspection import sparse
from gripmon.judge.policy import past_alert_limit
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Frame, Image, MonitorState, ReferenceRecord, StripsRecord
from gripmon.monitor.bounds import reaching, unbounded
from gripmon.monitor.ends import CORNERS_WHERE_EXPECTED
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import AtReferences, Bounds
from gripmon.monitor.standing import Question, Standing, Trust
from gripmon.monitor.tracker import Tracker
from gripmon.monitor.weigher import LOOK_ODDS, Weigher
from gripmon.track.edges import Measurement, own_steps
from gripmon.track.look import ONE_EDGE_PX, FingerStrips, GripperLook, StripsRefused, StripsSeen

PROOF_EVERY_FRAMES = 4
"""Frames between two checks of the fingers' ends, while the gripper is where it was and the last check proved it."""


FADED_RATIO, FADED_WITHIN_S = 0.7, 0.25
"""Contrast of the edges over that in a frame before, by each frame's own light, below which an image may show two
places: a knock in the first half of an exposure leaves the old place at most half, and what is seen across it adds to
that.  Frames farther apart than the second have other backgrounds.
"""


class _Candidate(NamedTuple):
    """A place where the gripper may be: the measurement, its pose (4, 4) and covariance (6, 6), the fingers' slide from
    there according to their strips, and how far the place is trusted.
    """

    measurement: Measurement
    cam_T_grip: Array
    covariance: Array
    along: StripsSeen
    trust: Trust


class Integrity:
    """Decides for one monitor's frames, one after the other."""

    taught_otherwise = (
        "where the teaching images had the gripper isn't used: they were measured with other settings; the motion "
        "since the reference counts from the next 30 frames that prove where it is, or teach again"
    )

    def __init__(
        self,
        camera: Camera,
        tracker: Tracker,
        gripper: Gripper,
        settings: MonitorSettings,
        reference: ReferenceRecord,
    ):
        self._tracker, self._policy = tracker, settings.policy
        policy = settings.policy
        self.since = AtReferences(reference, policy.valid_by, policy.integrity_risk, tracker.measured_as)
        """What was measured at the reference in force."""
        self._weigher = Weigher(tracker, gripper, settings, reference, self.since)
        self._place = self._weigher.place
        unused = tracker.taught_at[0] is not None and self.since.current is None
        self.since_refused: str | None = self.taught_otherwise if unused else None
        """Why what the taught edges or a state have about the reference's frames isn't used; None where it is, or there
        is nothing.
        """
        # Fingers without a direction of their own are slid out of the gripper.
        axis = tracker.finger_axis if tracker.finger_axis.any() else np.array([0.0, 0.0, 1.0])
        self._look = GripperLook(camera, gripper, axis)
        self._strips = FingerStrips(camera, gripper, tracker.along)
        self.strips_refused: str | None = None
        """Why strips that were kept over a restart aren't used; None where they are, or none were kept."""
        self._learn_from: tuple[Image, Array, float, float] | None = None
        self._jaw_opening_m = 0.0  # in the newest frame that proved a pose
        self._frames = 0
        self._elsewhere = 0
        self._believed = False
        self._ends_seen = False
        self._contrast: tuple[float, Array] | None = None  # when measured, and (e,) of the edges; zero where unseen

    def strips_state(self) -> StripsRecord | msgspec.UnsetType:
        """The fingers' strips for the state file; unset before they are learnt."""
        return self._strips.state() or msgspec.UNSET

    @property
    def unexplained(self) -> Array | None:
        """(6,) by how much the first proven pose differed from the expected one, m and rad; None if it didn't, or an
        operator has said why.
        """
        return self._place.unexplained

    @property
    def question(self) -> Question | None:
        """The same, also once it is answered."""
        return self._place.question

    @property
    def swing(self) -> Array:
        """(6,) variance of the vibration between proven poses, m² and rad²."""
        return self._place.swing

    def refer(self, reference: ReferenceRecord) -> None:
        """Begin the motion since the reference in force."""
        self.since.refer(reference)

    def measured_again(self, reference: ReferenceRecord) -> None:
        """A new reference, in force or proposed, was measured from the newest frames."""
        if self._place.anchor is not None:
            self.since.measured(reference, self._place.anchor, self._jaw_opening_m)

    def rebase(self, reference: ReferenceRecord) -> None:
        """Expect the gripper at a new reference."""
        self._place.rebase(reference)

    def resume(self, last_T: Array | None, reference: ReferenceRecord, state: MonitorState | None) -> None:
        """Continue after a restart: from the last known pose (4, 4), with the kept strips: without them
        a mark that a knock has brought to where the tips were shows only once another place is proven.
        """
        if state is not None and state.unexplained is not msgspec.UNSET:
            # What an earlier run couldn't explain, a restart doesn't either.
            answered = None if state.explained_from is msgspec.UNSET else state.explained_from
            revision = state.references[-1].revision
            self._place.question = Question(np.array(state.unexplained), revision, answered)
        self._place.rebase(reference, last_T)
        if state is not None and state.strips is not msgspec.UNSET:
            try:
                self._strips.restore(state.strips)
            except StripsRefused as refused:
                self.strips_refused = str(refused)
        if state is not None:
            known = () if state.at_reference is msgspec.UNSET else state.at_reference
            self.since_refused = self._weigher.restore(known) or self.since_refused

    def learn(self) -> None:
        """Learn the look from the newest frame that proved the pose, once."""
        learn_from, self._learn_from = self._learn_from, None
        if learn_from is not None:
            self._look.learn(*learn_from)
            self._strips.learn(*learn_from)
            self._weigher.learnt(self._look.backgrounds)

    def last_known(self, cam_T_grip: Array) -> Array:
        """The newest pose (4, 4) if it was believed and one was proven before, else where the gripper is expected: a
        pose that nothing proved mustn't be what a restart expects.
        """
        return cam_T_grip if self._believed and self._place.proved else self._place.at[0]

    def rivals(self, ref_cam_T_grip: Array) -> tuple[Array, ...]:
        """Where else the gripper may be: at the anchor, and where the reference has it."""
        anchor = self._place.anchor
        return (ref_cam_T_grip,) if anchor is None or not anchor.proven else (anchor.cam_T_grip, ref_cam_T_grip)

    def held(self, standing: Standing, growth: Array, unseen_s: float, hidden: bool) -> Bounds:
        """The bounds of a pose measured ``unseen_s`` ago, with the covariance (6, 6) of the possible motion since;
        ``hidden``: the image is good, but the gripper isn't seen.
        """
        return self._weigher.held(standing.bounds, growth, unseen_s, hidden)

    def judge(self, frame: Frame, measurement: Measurement, now_s: float) -> Standing | None:
        """What to publish of a measurement, and how far it is trusted; None where the gripper isn't seen."""
        self.since.now_ns = frame.stamp_ns
        if self.since.first_ns is None:
            self.since.first_ns = frame.stamp_ns
        first = self.since.current
        if measurement.trusted:
            measurement = self._tracker.with_known_jaw(measurement, frame.jaw_opening_m)
            standing: Standing | None = self._judge(frame, measurement, now_s)
            if standing is not None and self._faded(frame, measurement, now_s):
                why = "the mount was knocked during the exposure: most edges have lost contrast at once"
                standing = standing._replace(bounds=unbounded(self._policy.integrity_risk, why), believed=False)
        else:
            standing = self._held(frame, now_s)
        self._believed = standing is not None and standing.believed
        if standing is not None and self.since.current is None:
            why = "the gripper is elsewhere, since no frame has proved yet where it is"
            if self._weigher.displaced(standing.measurement, now_s):
                why = f"{self._weigher.not_as_expected}, and no frame has proved yet where it is"
            none = unbounded(self._policy.integrity_risk, why).since_reference
            standing = standing._replace(bounds=standing.bounds._replace(since_reference=none))
        if standing is not None:
            self.since.weighed = first
        return standing

    def _faded(self, frame: Frame, measurement: Measurement, now_s: float) -> bool:
        """Whether most of the edges have lost contrast since the last frame measured, in proportion to the light: a
        knock during an exposure shows the gripper twice, and where it was expected it is found.
        """
        assert frame.image is not None
        seen, before = measurement.consensus.edge_seen, self._contrast
        contrast = np.abs(own_steps(measurement)) * seen / float(sparse(frame.image).mean())
        self._contrast = now_s, contrast
        if before is None or now_s - before[0] > FADED_WITHIN_S:
            return False
        both = (contrast > 0.0) & (before[1] > 0.0)
        faded = contrast[both] < FADED_RATIO * before[1][both]
        return bool(2 * np.count_nonzero(faded) > len(faded))

    def _past_limit(self, both: Bounds) -> bool:
        """Whether the bound that makes a transform valid is past an alert limit."""
        return past_alert_limit(both.by(self._policy.valid_by), self._policy) is not None

    def _judge(self, frame: Frame, measurement: Measurement, now_s: float) -> Standing:
        cam_T_grip, covariance = self._tracker.update(measurement)
        along = self._along(frame, measurement, cam_T_grip)
        trust = self._trust_in(frame, measurement, cam_T_grip, along, now_s)
        here = self._slid_back(frame, _Candidate(measurement, cam_T_grip, covariance, along, trust), now_s)
        measurement, cam_T_grip, trust = here.measurement, here.cam_T_grip, here.trust
        if not trust.displaced or (trust.proven and self._beside_px(measurement, cam_T_grip) < ONE_EDGE_PX):
            return self._conclude(frame, here, now_s)
        if trust.proven:
            assert trust.ends is not None
            strict, seen_along = trust.ends.only_strictly, here.along.here
            again = self._weigher.weigh(measurement, cam_T_grip, strict, now_s, seen_along=seen_along)
            proven = again.proven and not self._look_contradicts(frame, measurement, cam_T_grip)
            # A knock is rare: even odds suffice against it.
            proven = proven and self._along(frame, measurement, cam_T_grip, risk=1.0).slide_m is None
            here = here._replace(trust=again._replace(proven=proven))
        return self._against_its_place(frame, here, trust, now_s)

    def _trust_in(
        self, frame: Frame, measurement: Measurement, cam_T_grip: Array, along: StripsSeen, now_s: float
    ) -> Trust:
        """The trust in a measured pose (4, 4); the fingers' ends are looked at now and then, and where they may matter:
        the bound is past a limit without them, or the pose isn't where the gripper was.
        """
        weigher = self._weigher
        displaced = weigher.displaced(measurement, now_s)
        due = self._frames % PROOF_EVERY_FRAMES == 0 or not self._ends_seen or displaced or not self._place.proved
        self._frames += 1
        if not due:
            trust = weigher.weigh(measurement, cam_T_grip, None, now_s)
            if not self._past_limit(trust.bounds):
                return trust
        ends = self._tracker.ends(frame, measurement)
        trust = weigher.weigh(measurement, cam_T_grip, ends, now_s, seen_along=along.here)
        self._ends_seen = trust.proven
        return trust

    def _slid_back(self, frame: Frame, here: _Candidate, now_s: float) -> _Candidate:
        """A candidate, corrected where the fingers' strips show that it has slid along them, because something else was
        taken for their ends: also at the expected place, if a knock brought it there.  If the gripper isn't measured
        where the strips have it either: the same pose, bounded without the ends.
        """
        weigher, (measurement, cam_T_grip, _, along, trust) = self._weigher, here
        if along.slide_m is not None:
            slid_T = cam_T_grip.copy()
            slid_T[:3, 3] += cam_T_grip[:3, :3] @ along.slide_m
            again = self._measured(frame, slid_T, self._place.sigma(now_s), now_s)
            if again is not None and again.along.slide_m is None:
                return again
        elif not along.undecided:
            return here
        return here._replace(trust=weigher.weigh(measurement, cam_T_grip, trust.ends, now_s, slid=True))

    def _beside_px(self, measurement: Measurement, cam_T_grip: Array) -> float:
        """How far the edges show from where the gripper is expected, px."""
        return measurement.prediction.moved_px(perturbation_between(self._place.at[0], cam_T_grip))

    def _against_its_place(self, frame: Frame, here: _Candidate, at_first: Trust, now_s: float) -> Standing:
        """Decide between a displaced pose and the expected place.  The proven one is published; where both or neither
        are, the expected place, since mounts are knocked rarely; but the bound reaches the displaced one where that
        isn't excluded: the expected place isn't proven, or shows fewer of the edges.  ``at_first``: the trust in the
        displaced pose before the strict check of its ends.
        """
        there = self._at_its_place(frame, now_s)
        proven = here.trust.proven
        if there is None or (proven and not there.trust.proven):
            standing = self._conclude(frame, here, now_s)
        else:
            standing = self._conclude(frame, there, now_s)
            more = np.setdiff1d(here.measurement.normal.edge, there.measurement.normal.edge)
            proven = there.trust.proven and not (proven and len(more))
        seen = self._weigher.confirmations(here.measurement, at_first.ends)
        if proven or seen < CORNERS_WHERE_EXPECTED:
            return standing
        return _reaching(standing, here.cam_T_grip, "the fingers stand elsewhere, where their ends are seen, too")

    def _held(self, frame: Frame, now_s: float) -> Standing | None:
        """For a frame in which the gripper wasn't found: the measurement at the anchor.  None without an anchor, where
        too little is seen there, where neither the fingers' ends nor their strips show it, since what hides them may
        look like edges of theirs, or where the bound is past an alert limit.
        """
        there = None if not self._place.proved else self._at_its_place(frame, now_s)
        if there is None:
            return None
        standing = self._conclude(frame, there, now_s)
        unknown = standing.unproven and not there.along.here
        return None if unknown or self._past_limit(standing.bounds) else standing

    def _at_its_place(self, frame: Frame, now_s: float) -> _Candidate | None:
        """The measurement at the expected place, if the gripper may still be there: marks on the fingers and borders
        beside them look like ends elsewhere.  None where that is excluded, or too little of the sides is seen.
        """
        weigher = self._weigher
        there = self._measured(frame, self._place.at[0], self._place.sigma(now_s), now_s)
        if there is None or there.trust.displaced or not weigher.held_across(there.measurement, now_s):
            return None
        slid = there.along.slide_m is not None or there.along.undecided
        return there if there.along.here or not slid else None

    def _measured(self, frame: Frame, cam_T_grip: Array, sigma: Array, now_s: float) -> _Candidate | None:
        """The measurement at a pose (4, 4), of edges within the standard deviations (6,) of it; None where no edge is
        seen.
        """
        measurement = self._tracker.measure_held(frame, cam_T_grip, sigma)
        if measurement.consensus.share == 0.0:
            return None
        measurement.trusted = True
        cam_T_grip, covariance = self._tracker.update(measurement)
        ends, along = self._tracker.ends(frame, measurement), self._along(frame, measurement, cam_T_grip)
        trust = self._weigher.weigh(measurement, cam_T_grip, ends, now_s, seen_along=along.here)
        return _Candidate(measurement, cam_T_grip, covariance, along, trust)

    def _conclude(self, frame: Frame, candidate: _Candidate, now_s: float) -> Standing:
        """What to publish of a place, and whether it becomes the anchor."""
        measurement, cam_T_grip, covariance, along, trust = candidate
        left_open = trust.most_probable is not None and not trust.proven
        if left_open and (trust.displaced or self._past_limit(trust.bounds)):
            return self._by_anchor(frame, candidate, now_s)
        proved = self._place.proved
        where_it_was = proved and not trust.displaced
        beside_px = self._beside_px(measurement, cam_T_grip)
        moved = self._knocked(trust, beside_px, along.here)
        knocked = moved and beside_px >= ONE_EDGE_PX
        proves = trust.proven and (moved or not trust.displaced)
        unproven = proved and not proves
        if trust.fits is not None and (proves or not (trust.displaced or proved)):
            before = self._place.anchor
            self._place.settle(trust, measurement, cam_T_grip, covariance, now_s)
            assert self._place.anchor is not None
            if self._place.anchor is not before:
                self._look.count_again()
            self._jaw_opening_m = measurement.jaw_opening_m
            if proves:
                self.since.proved()
            first = self.since.current
            if proves and first is not None and not first.knocked and self._place.moved():
                self.since.moved()  # once: each change is written to the state file
            self.since.add(self._place.anchor, measurement.jaw_opening_m, frame.stamp_ns)
        if proves and frame.image is not None and not (moved or trust.may_have_slid):
            # A copy: learning can wait, and the caller may read the next image into the same memory.
            self._learn_from = frame.image.copy(), cam_T_grip, measurement.jaw_opening_m, now_s
        believed = moved or not trust.displaced or (trust.proven and trust.ambiguous)
        at = measurement, cam_T_grip, covariance, trust.bounds
        standing = Standing(*at, believed, where_it_was, trust.grasped, knocked=knocked, unproven=unproven)
        if moved or trust.ambiguous or not trust.displaced:
            return standing
        # Until another frame confirms it, the gripper may as well be where it was.
        why = "the fingers stand elsewhere, or the mount was knocked just now"
        return _reaching(standing, self._place.at[0], why)

    def _knocked(self, trust: Trust, beside_px: float, seen_along: bool) -> bool:
        """Whether the mount was knocked; the edges are ``beside_px`` from the old place.  Knocks are so rare that one
        frame doesn't suffice, unless the fingers' strips are seen there, too, or the motion is as small as a creep.
        Further frames have to prove the new place before the old one is proven again or something else explains the
        motion; the mount may ring meanwhile.  Before the strips are learnt even these prove nothing: a mark taken for
        the ends is less rare than a knock.
        """
        if not trust.proven:
            return False
        self._elsewhere = self._elsewhere + 1 if trust.displaced and not trust.ambiguous else 0
        if beside_px < ONE_EDGE_PX or seen_along:
            return self._elsewhere >= 1
        unknown = self._place.proved and self._strips.awaited
        return self._elsewhere >= self._policy.confirm_frames and not unknown

    def _by_anchor(self, frame: Frame, candidate: _Candidate, now_s: float) -> Standing:
        """Publish the pose under the most probable hypothesis, from the anchor and the edges that it keeps: the frame
        alone doesn't determine it.
        """
        measurement, _, _, along, trust = candidate
        assert trust.instead is not None
        number, cam_T_grip, covariance = trust.instead
        slid = along.slide_m is not None or along.undecided
        seen = not slid and self._look_supports(frame, measurement, cam_T_grip)
        trust = self._weigher.weigh(measurement, cam_T_grip, trust.ends, now_s, number, seen, slid)
        at = measurement, cam_T_grip, covariance, trust.bounds
        return Standing(*at, believed=False, where_it_was=True, unproven=True)

    def _look_contradicts(self, frame: Frame, measurement: Measurement, cam_T_grip: Array) -> bool:
        """Whether the gripper's look excludes this pose: it is seen at the expected place, and much less here."""
        if not self._look.ready or frame.image is None:
            return False
        poses = np.stack([cam_T_grip, self._place.at[0]])
        return self._look.compare(frame.image, poses, measurement.jaw_opening_m).contradicts(LOOK_ODDS)

    def _along(self, frame: Frame, measurement: Measurement, cam_T_grip: Array, risk: float = LOOK_ODDS) -> StripsSeen:
        """Where the strips have the gripper along its fingers, from a pose (4, 4), at odds of one to ``risk``."""
        if frame.image is None:
            return StripsSeen()
        return self._strips.compare(frame.image, cam_T_grip, measurement.jaw_opening_m, risk)

    def _look_supports(self, frame: Frame, measurement: Measurement, cam_T_grip: Array) -> bool:
        """Whether the gripper's look is seen at a pose (4, 4)."""
        if not self._look.ready or frame.image is None:
            return False
        return self._look.supports(frame.image, cam_T_grip, measurement.jaw_opening_m, LOOK_ODDS)


def _reaching(standing: Standing, other_T: Array, why: str) -> Standing:
    """The same, not believed, with a bound that includes another possible pose (4, 4)."""
    away = perturbation_between(standing.cam_T_grip, other_T)
    both = Bounds(*(reaching(each, away, why) for each in standing.bounds))
    return standing._replace(bounds=both, believed=False)
