"""How far a measured pose may be off: bounds over all fault hypotheses (see ``docs/integrity.md``).

Two things check a fit besides its own residuals.  Only the fingers' ends show a motion along the fingers: it is
checked whether they are seen as ends.  And a mount stays where it was a moment ago, except for its creep, unless it was
knocked, which is rare: the average of the proven poses is the anchor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.drift import USUAL_SQUARE
from gripmon.judge.policy import past_alert_limit
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.poses import perturbation_between
from gripmon.model.records import NOTHING_WRONG, Array, AtReferenceRecord, Protection, ReferenceRecord
from gripmon.monitor.bounds import SIGMA_INFLATION, larger, protection_of, reaching, unbounded
from gripmon.monitor.ends import MISREAD_PROBABILITY, EndsEvidence, proof, within
from gripmon.monitor.known_place import KnownPlace
from gripmon.monitor.possible import About, Possible
from gripmon.monitor.refits import Known, Refits, in_the_references_frames
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import AtReferences, Bounds
from gripmon.monitor.standing import Trust
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import FingerEndsSeen, Measurement, has_lone_end
from gripmon.track.edges.roles import PARALLEL_COSINE
from gripmon.track.integrity import Mount, bounds
from gripmon.track.integrity.frame_kernel import Fits, frame_bounds
from gripmon.track.integrity.knocks import ALONG_OF_ALL, ALONG_SHARE, ANY_SHARE, KNOCK_UNSEEN_PROBABILITY
from gripmon.track.integrity.separation import limits_of

LOOK_ODDS = 1e-3
"""Odds from which the gripper's learned look counts as seen, or as seen elsewhere."""

JAW_CONTRADICTED_SQUARE = chi_square_limit(1e-3, 1)
"""Squared normalised innovation of the opening above which a displaced pose isn't explained by a knock alone: noise
exceeds it in one of a thousand knocks, which is then accepted a frame later.
"""

UNSOLVED_RATIO = 0.1
"""Share of the integrity risk that improbable knocks may have together without being solved, and again those where the
ends and something else are something else; it is taken off the risk.  A tenth makes a normal error's bound half a
percent larger.
"""


class Weigher:
    """Protection levels of one monitor's measurements, and the ``place`` that they rest on."""

    not_as_expected = (
        "the mount was knocked before the start, or the reference or the gripper file is off: the gripper isn't where "
        "the reference has it"
    )
    looks_otherwise = (
        "the gripper isn't where the images had it that it was taught from: the mount, the light, or the tips"
    )

    def __init__(
        self,
        tracker: Tracker,
        gripper: Gripper,
        settings: MonitorSettings,
        reference: ReferenceRecord,
        since: AtReferences,
    ):
        """``since``: what was measured at the reference in force."""
        self._tracker, self._gripper, self._policy = tracker, gripper, settings.policy
        self._ends, self._lone = EndsEvidence(gripper, tracker.along), has_lone_end(gripper)
        creep = settings.smoothing
        variance_per_s = np.square([creep.creep_m_per_sqrt_s] * 3 + [creep.creep_rad_per_sqrt_s] * 3)
        self._possible = Possible(tracker, gripper, settings, from_record(reference.cam_T_grip))
        self._lasting, self._since = self._possible.lasting, since
        self._names_ever = self._lasting.name + in_the_references_frames(self._lasting.name)
        taught, play = tracker.taught_at
        if taught is None or not since.begin(taught, len(self._lasting.name), self._possible.model.parts):
            play = (0.0,) * 6  # as if nothing were known of it: where the motion counts from would move with it
        self._mount = Mount(variance_per_s, settings.policy.mount_jumps_per_month, play)
        self._newest: tuple[Measurement, float, Refits] | None = None
        self.place = KnownPlace(tracker, self._mount, self._possible, reference, since)
        self._unsolved = UNSOLVED_RATIO * settings.policy.integrity_risk
        self._axis = tracker.finger_axis
        self._along_share = ALONG_OF_ALL if self._axis.any() else 0.0  # of knocks, along the fingers
        self._along_misread = MISREAD_PROBABILITY**2  # where the strips were learnt; kept ones at a proven pose

    def restore(self, records: tuple[AtReferenceRecord, ...]) -> str | None:
        """See :meth:`AtReferences.restore`."""
        return self._since.restore(records, len(self._lasting.name), self._possible.model.parts)

    def weigh(
        self,
        measurement: Measurement,
        cam_T_grip: Array,
        ends: FingerEndsSeen | None,
        now_s: float,
        explained: int | None = None,
        look_seen: bool = False,
        slid: bool = False,
        seen_along: bool = False,
    ) -> Trust:
        """Bound the error of ``cam_T_grip`` (4, 4), which the measurement gave.

        ``ends``: the fingers' ends as seen; None if not checked.  ``explained``: number of the hypothesis under which
        the pose follows from the anchor.  ``look_seen``: the gripper's look is seen there.  ``slid``: the fingers'
        strips are seen elsewhere, so that something else was taken for their ends.  ``seen_along``: they are seen
        there: as few corners prove the pose as where it is expected (:func:`~gripmon.monitor.ends.proof`), and a lone
        finger hasn't slid.
        """
        risk, edges, anchor = self._policy.integrity_risk, measurement.normal.edge, self.place.anchor
        if not len(edges):
            return Trust(unbounded(risk, NOTHING_WRONG), False)
        fits = self._refitted(measurement, now_s)
        hypotheses, anchored = fits.hypotheses, fits.anchored
        # The gate: a hypothesis that also needs a knock of the mount is excluded.
        displaced = not fits.stays[0] and explained is None
        # The proof: fingers' ends that can't be something else.
        again = bool(anchored.square[0] <= USUAL_SQUARE) and (anchor is None or anchor.confirmed)
        may_have_slid = self._lone and not seen_along and self.place.may_have_slid(measurement, cam_T_grip, displaced)
        kept = None if explained is None else hypotheses.keep[explained] > 0.0
        proven, misread = False, 1.0
        since_learnt = LOOK_ODDS if seen_along and not slid else 1.0
        if not slid:
            of_ends = self._ends.misread(measurement, ends, kept)
            proven, misread = proof(ends, of_ends, risk, displaced, again, LOOK_ODDS if seen_along else None)
        # The priors: only that of the ends depends on the frame.
        prior = hypotheses.prior.copy()
        prior[hypotheses.ends] = misread * since_learnt * (LOOK_ODDS if look_seen else 1.0)
        # Where the pose was known to be, or knocked away from there, of which the ends alone show a part.
        shown, hidden = self.place.knocked(now_s)
        odds = shown, 1.0 if may_have_slid else hidden
        besides = odds[1] * prior[hypotheses.ends]
        unsettled = displaced or not self.place.proved
        about = self._possible.about(fits.edges)
        without, unsolved = self._without_ends(fits, about, besides, unsettled)
        both, knock = self._bounds(fits, about.rows, without, unsolved, prior, odds, cam_T_grip, displaced)
        both = self._with_questions(both, cam_T_grip, displaced)
        # What the frame adds to the anchor: its fits, without the ends where nothing proves them.
        made_of = without if without is not None and not proven and unsettled else fits
        if without is not None and displaced and not slid and ends is not None and self._sure(without, cam_T_grip):
            proven, made_of = True, without
        # What was taken for the ends when the strips were learnt looks right ever after.
        misread = min(misread, misread * since_learnt + self._along_misread)
        at = both, proven, displaced, knock
        trust = Trust(*at, may_have_slid=may_have_slid, ends=ends, fits=made_of, misread=misread)
        if anchor is None:
            return trust
        along_unseen = besides * self._along_share > risk
        return self._explained(trust, measurement, cam_T_grip, prior, fits, along_unseen)

    def learnt(self, backgrounds: int) -> None:
        """The fingers' strips were learnt at the anchor, which was proved before so many different backgrounds."""
        assert self.place.anchor is not None
        self._along_misread = self.place.anchor.clearest
        self.place.anchor.backgrounds = max(backgrounds, 1)

    def displaced(self, measurement: Measurement, now_s: float) -> bool:
        """Whether a measured pose isn't where the gripper is expected."""
        return len(measurement.normal.edge) > 0 and not self._refitted(measurement, now_s).stays[0]

    def _explained(
        self,
        trust: Trust,
        measurement: Measurement,
        cam_T_grip: Array,
        prior: Array,
        fits: Refits,
        along_unseen: bool,
    ) -> Trust:
        """The trust in a pose (4, 4) with the most probable hypothesis since the anchor, and with what else than a
        knock may explain a displaced one.  ``prior`` (h,): of the hypotheses of ``fits``; ``along_unseen``: a knock
        along the fingers that only the ends would show is more probable than the risk.
        """
        hypotheses, displaced = fits.hypotheses, trust.displaced
        possible = fits.stays * prior
        if trust.proven:
            possible[hypotheses.ends] = 0.0
        number = (1 + int(possible[1:].argmax())) if displaced else hypotheses.ends if along_unseen else 0
        most_probable = (fits.anchored, number) if possible[number] > 0.0 else None
        ambiguous = displaced and bool((possible[1:] > 0.0).any())
        grasped = ambiguous and bool((possible[list(hypotheses.grasp)] > 0.0).any())
        both = trust.bounds
        opened = measurement.jaw_innovation**2 > JAW_CONTRADICTED_SQUARE and self.place.in_place
        if displaced and not ambiguous and opened:
            # A knock doesn't move the jaw: flexing fingers and shadows beside them look like both at once.
            ambiguous = grasped = True
            why = "edges belong to something else, which looks like another opening and distance"
            away = perturbation_between(self.place.at[0], cam_T_grip)
            both = Bounds(*(reaching(each, away, why) for each in both))
        return trust._replace(bounds=both, ambiguous=ambiguous, grasped=grasped, most_probable=most_probable)

    def _with_questions(self, both: Bounds, cam_T_grip: Array, displaced: bool) -> Bounds:
        """The bounds while it is open why the first frames differ from the reference: no motion since them, but of what
        differs from images to teach from.
        """
        first, (absolute, since) = self._since.current, both
        away = None if first is None else first.looks_away(cam_T_grip)
        if away is not None:
            why = self.looks_otherwise if np.linalg.norm(away[:3]) > since.position_m else since.hypothesis
            since = reaching(since, away, why)
        if self.place.anchor is None and displaced:
            absolute = larger(absolute, self._not_as_expected(perturbation_between(self.place.at_first[0], cam_T_grip)))
        if self.place.unexplained is not None:
            absolute = larger(absolute, self._not_as_expected(self.place.unexplained))
        return Bounds(absolute, since)

    def _bounds(
        self,
        fits: Refits,
        rows: NDArray[np.intp],
        without: Refits | None,
        unsolved: float,
        prior: Array,
        odds: tuple[float, float],
        cam_T_grip: Array,
        displaced: bool,
    ) -> tuple[Bounds, Array]:
        """The protection levels of a pose (4, 4), and of the motion since the reference: by what may be wrong where it
        is as known, and after the knocks that the mount may have got since, by the fits and by those ``without`` ends,
        with what may have been wrong all along, ``rows`` of these hypotheses, or in the reference's frames alone.
        ``unsolved``: probability of what isn't solved; ``prior`` (h,): of the hypotheses; ``odds``: of a knock that the
        ends show, and of one that only they would.  And how far a knock moves the mount, (6, 6).
        """
        anchor, lasting, first = self.place.anchor, self._lasting, fits.model.first[0]
        every, (shift, covariance, of_model), risk = fits.hypotheses, fits.alone, self._policy.integrity_risk
        stays, endless, ends, names, solved = fits.stays, every.endless, every.ends, every.name, prior
        none: Fits = shift[:0], covariance[:0], of_model[:0]
        bare = none, (prior[:0], stays[:0], endless[:0])
        if without is fits:  # then that of the ends is the same as that nothing is wrong
            solved = prior * (np.arange(len(prior)) != ends)
        elif without is not None:
            of, names = without.hypotheses, names + without.hypotheses.name
            bare = without.alone, (prior[ends] * of.prior * of.more_than_ends, without.stays, of.endless)
        names, wander = names + self._names_ever, fits.known.wander
        at_first = prior[:0] if first is None else lasting.priors(first.misread)
        always = (none, cam_T_grip, *self.place.at, wander, rows[:0], prior[:0])
        if anchor is not None and not displaced:
            always = *anchor.known, wander, rows, lasting.priors(anchor.misread)
        knocks = cam_T_grip[:3, :3] @ self._axis, ends, PARALLEL_COSINE, *odds
        least = self._unsolved / (len(prior) * len(ANY_SHARE + ALONG_SHARE))
        before, less = (fits.before, knocks, always), (at_first, least, unsolved)
        of_frame = fits.frame, (prior, stays, endless), solved, bare, *before, *less
        unnoticed = min(self._mount.knocked(self._since.elapsed_s, hidden=True), 1.0)
        moved, of_images = (False, False) if first is None else (first.knocked, first.of_images)
        unwatched = KNOCK_UNSEEN_PROBABILITY if of_images else 0.0
        absolute, since, knock = frame_bounds(
            (cam_T_grip, displaced, *of_frame),
            fits.model.alike(cam_T_grip),
            fits.model.differences(cam_T_grip, fits.opened, self._mount.to_and_fro),
            (self.place.usual_motion, displaced or moved, unwatched, unnoticed),
            limits_of(risk, SIGMA_INFLATION),
        )
        if absolute[0] == np.inf:
            return unbounded(risk, "too much may be wrong at once"), knock
        return Bounds(protection_of(absolute, names, risk), protection_of(since, names, risk)), knock

    def _without_ends(
        self, fits: Refits, about: About, besides: float, unsettled: bool
    ) -> tuple[Refits | None, float]:
        """The fits where no end of a finger is what it seems besides: the same if none is seen, None where that counts
        little, a knock being of the probability ``besides`` then; and the probability of what isn't solved for that.
        ``unsettled``: of a pose that is displaced, or before one is proved.
        """
        if not fits.hypotheses.across.any():
            return fits, 0.0
        if unsettled:
            return fits.under(about.without_ends), 0.0
        together = besides * about.pairs.of_more_than_ends
        if together <= self._unsolved:
            return None, together
        return fits.under(about.pairs), 0.0

    def held(self, both: Bounds, growth: Array, unseen_s: float, hidden: bool) -> Bounds:
        """The protection levels of a transform measured ``unseen_s`` ago, whose covariance (6, 6) has grown by
        ``growth``.  ``hidden``: the image is good, but the gripper isn't seen in it.
        """
        risk = self._policy.integrity_risk
        if self._mount.knocked(unseen_s, hidden) > risk:
            return unbounded(risk, "the mount was knocked while nothing is seen of the gripper")
        position_m, rotation_rad = _radii(growth, risk)
        return Bounds(
            *(Protection(b.position_m + position_m, b.rotation_rad + rotation_rad, risk, b.hypothesis) for b in both)
        )

    def confirmations(self, measurement: Measurement, ends: FingerEndsSeen | None) -> int:
        """See :meth:`EndsEvidence.confirmations`."""
        return self._ends.confirmations(measurement, ends)

    def held_across(self, measurement: Measurement, now_s: float) -> bool:
        """Whether enough of the fingers' sides is seen at the anchor to exclude a knock across the fingers since it was
        proven (before anything is proven: just now).  The edges at the ends don't show such a knock.
        """
        excluded = self.place.knocked(now_s)[1] * self._ends.sides_misread(measurement)
        return within(excluded, self._policy.integrity_risk)

    def _sure(self, fits: Refits, cam_T_grip: Array) -> bool:
        """Whether the protection level of a pose (4, 4) from ``fits`` is within the alert limits.  Curved and tapered
        fingers show a motion along themselves even without their ends.
        """
        risk, every = self._policy.integrity_risk, np.arange(len(fits.stays))
        both = fits.bounds(cam_T_grip, every, self._mount.to_and_fro, risk)
        return past_alert_limit(both.by(self._policy.valid_by), self._policy) is None

    def _not_as_expected(self, away: Array) -> Protection:
        """The protection level where the first frames differ from the reference by ``away`` (6,)."""
        risk = self._policy.integrity_risk
        position_m, rotation_rad = _radii(self.place.at_first[1], risk)
        why = self.not_as_expected
        return reaching(Protection(position_m, rotation_rad, risk, why), away, why)

    def _refitted(self, measurement: Measurement, now_s: float) -> Refits:
        """The fits of a measurement, alone and with what is known of the pose.  They are kept while the same
        measurement is weighed again: with its ends checked, or for another pose.
        """
        if self._newest is None or self._newest[0] is not measurement or self._newest[1] != now_s:
            expected_T, covariance = self.place.at
            of_model = np.zeros((1, 6)) if self.place.anchor is None else self.place.anchor.of_model
            wander = self.place.wander(now_s)
            known = Known(expected_T, covariance + np.diag(wander), of_model, wander)
            model = self._possible.model._replace(first=self._since.published_by)
            hypotheses = self._possible.about(measurement.normal.edge).hypotheses
            floor = self._tracker.floor_of(measurement)
            self._newest = measurement, now_s, Refits(measurement, hypotheses, floor, model, known)
        return self._newest[2]


def _radii(covariance: Array, risk: float) -> list[float]:
    """Lengths, m and rad, that position and rotation of a covariance (6, 6) exceed with a probability ``risk``."""
    return bounds(np.stack([covariance[:3, :3], covariance[3:, 3:]]), np.full(2, risk)).tolist()
