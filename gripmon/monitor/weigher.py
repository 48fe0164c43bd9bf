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
from gripmon.model.least_squares import CONTRADICTION_SQUARE, chi_square_limit
from gripmon.model.poses import perturbation_between
from gripmon.model.records import NOTHING_WRONG, Array, AtReferenceRecord, Protection, ReferenceRecord
from gripmon.monitor.refits import (
    UNBOUNDED_M,
    UNBOUNDED_RAD,
    Anchor,
    Anchored,
    Known,
    Lasting,
    ModelError,
    Refits,
    TwoDoubts,
    bounds_of,
    larger,
    reaching,
)
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import AtReferences, Bounds, CommonError
from gripmon.monitor.standing import Question, Trust
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import (
    FingerEndsSeen,
    Measurement,
    edges_at_ends,
    has_lone_end,
    inner_edges,
    sides,
)
from gripmon.track.edges.roles import PARALLEL_COSINE
from gripmon.track.edges.words import Words, in_words
from gripmon.track.integrity import Hypotheses, Knocks, bounds, hypotheses_of
from gripmon.track.integrity.hypotheses import WRONG_EDGE
from gripmon.track.look import ONE_EDGE_PX

VIBRATION_FRAMES = 20.0
"""Proven frames over which the mount's vibration is learnt."""

MISREAD_PROBABILITY = 0.1
"""Probability that what is seen where a finger's end is expected is something else, and that each further corner of it
is: that of a border anywhere within the search lines' reach to lie within a tenth of it.
"""

LOOK_ODDS = 1e-3
"""Odds from which the gripper's learned look counts as seen, or as seen elsewhere."""

JAW_CONTRADICTED_SQUARE = chi_square_limit(1e-3, 1)
"""Squared normalised innovation of the opening above which a displaced pose isn't explained by a knock alone: noise
exceeds it in one of a thousand knocks, which is then accepted a frame later.
"""

KNOCK_UNSEEN_PROBABILITY = 1e-3
"""Probability that the mount was knocked where nothing has shown it: while something hides the fingers' ends, since the
gripper touches things then, and between the reference's images and the first frame.  A policy, once for each such
occlusion, since the average rate of knocks is too low for both (docs/integrity.md).
"""

LEAST_WEIGHT_RATIO = 1e-3
"""Share of the integrity risk below which a knock under a hypothesis isn't solved but taken off the risk."""

MOST_KEPT = 64
"""Sets of seen edges whose hypotheses are remembered."""

CORNERS_WHERE_EXPECTED = 3
"""Corners at the fingers' ends that prove a pose where the gripper is expected; elsewhere four of two fingers."""


def swinging(swing: Array, way: Array, noise: Array) -> Array:
    """(6,) variance of the mount's vibration after one more ``way`` (6,) between consecutive poses; ``noise`` (6,):
    variances that the poses' own errors add to it, which is taken off.  Negative where there happens to be less.
    """
    # A knock is not a vibration, but what rings after it is.
    most = CONTRADICTION_SQUARE * (noise + np.maximum(swing, 0.0))
    return np.asarray(swing + (np.minimum(np.square(way), most) - noise - swing) / VIBRATION_FRAMES)


class Weigher:
    """Protection levels of one monitor's measurements, and the anchor that they rest on."""

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
        self._along = tracker.along  # (e,) which edges run along the fingers
        self._at_ends = edges_at_ends(gripper)  # (e,) which are at their ends
        self._lone = has_lone_end(gripper)
        creep = settings.smoothing
        self._creep = np.square([creep.creep_m_per_sqrt_s] * 3 + [creep.creep_rad_per_sqrt_s] * 3)
        self._jumps_per_s = settings.policy.mount_jumps_per_month / (30.0 * 86_400.0)
        self._model, self._since = _model_error(tracker, gripper), since
        self._may_open = gripper.has_jaw and settings.jaw_sigma_m > 0.0  # else the report is configured as exact
        every = np.arange(len(gripper.edge_ids))
        self._words = in_words(gripper, from_record(reference.cam_T_grip))
        self._lasting = Lasting.of(_hypotheses_about(every, gripper, tracker, self._may_open, self._words))
        self._kept: dict[bytes, tuple[Hypotheses, NDArray[np.intp]]] = {}
        self._newest: tuple[Measurement, float, Refits] | None = None
        self._swing: Array = np.zeros(6)
        self.anchor: Anchor | None = None
        self.question: Question | None = None
        """By how much the first proven pose differed from the expected one; None if it didn't."""
        self._in_place = False  # once a frame proved where the gripper was before: that shows how the report errs
        self.rebase(reference)

    def rebase(self, reference: ReferenceRecord, last_T: Array | None = None) -> None:
        """Expect the gripper at a reference (the original, if one is restored) or at the last known pose (4, 4), until
        a frame proves a pose.
        """
        expected_T = from_record(reference.cam_T_grip) if last_T is None else last_T
        self._expected = expected_T, np.reshape(reference.covariance, (6, 6))
        self.unexplained: Array | None = None
        """(6,) of an open question what every bound includes, m and rad; None for nothing."""
        if self.question is not None:
            self.question = self.question.with_reference(reference)
            self.unexplained = self.question.away if self.question.open_at(reference.revision) else None
        self._revision, self._reference_T = reference.revision, from_record(reference.cam_T_grip)
        self._slid: bool | None = None  # not known before something is proven

    def restore(self, records: tuple[AtReferenceRecord, ...]) -> str | None:
        """See :meth:`AtReferences.restore`."""
        return self._since.restore(records, len(self._lasting.name), self._model.parts)

    @property
    def expected(self) -> tuple[Array, Array]:
        """Where the gripper is expected: pose (4, 4) and covariance (6, 6), of the anchor if there is one."""
        return self._expected if self.anchor is None else (self.anchor.cam_T_grip, self.anchor.covariance)

    @property
    def swing(self) -> Array:
        """(6,) variance of the way between proven poses that their errors don't explain, m² and rad²: vibration."""
        return np.maximum(self._swing, 0.0)

    @property
    def misread_ever(self) -> float:
        """Probability that what looked like the fingers' ends was something else in every frame that the anchor is the
        average of.
        """
        return 1.0 if self.anchor is None else self.anchor.misread

    @property
    def proved(self) -> bool:
        """Whether a frame has proven a pose."""
        return self.anchor is not None and self.anchor.proven

    def sigma(self, now_s: float) -> Array:
        """(6,) standard deviations of where it is expected, m and rad."""
        variance = self.expected[1].diagonal() + self._wander(now_s) + self._tracker.floor.diagonal()
        if self.anchor is not None:
            variance = variance + np.square(self.anchor.of_model).sum(axis=0)
        return np.sqrt(variance)

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
        strictly: int = 0,
    ) -> Trust:
        """Bound the error of ``cam_T_grip`` (4, 4), which the measurement gave.

        ``ends``: the fingers' ends as seen; None if not checked.  ``explained``: number of the hypothesis under which
        the pose follows from the anchor.  ``look_seen``: the gripper's look is seen there.  ``slid``: the fingers'
        strips are seen elsewhere, so that something else was taken for their ends.  ``seen_along``: they are seen
        there: as few corners prove the pose as where it is expected, and a lone finger hasn't slid.  ``strictly``: at
        how many fingers no edge goes on beyond the ends even by a few pixels; each is worth as much as one more corner.
        """
        risk, edges = self._policy.integrity_risk, measurement.normal.edge
        if not len(edges):
            unbounded = Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, NOTHING_WRONG)
            return Trust(Bounds(unbounded, unbounded), False)
        wander = self._wander(now_s)
        fits, anchored = self._refitted(measurement, now_s, wander)
        hypotheses, anchor = fits.hypotheses, self.anchor
        # The gate: a hypothesis that also needs a knock of the mount is excluded.
        holds = anchored.square <= CONTRADICTION_SQUARE
        displaced = not holds[0] and explained is None
        # The proof: fingers' ends that can't be something else.
        again = bool(anchored.square[0] <= USUAL_SQUARE) and (anchor is None or anchor.confirmed)
        proven = not slid and _proven(ends, displaced and not seen_along, again)
        may_have_slid = self._lone and not seen_along and self._may_have_slid(measurement, cam_T_grip, displaced)
        kept = None if explained is None else hypotheses.keep[explained] > 0.0
        misread = 1.0 if slid else self._misread(measurement, ends, kept)
        if proven:
            misread *= MISREAD_PROBABILITY**strictly
        if seen_along and not slid:
            misread *= LOOK_ODDS
        # The priors: only that of the ends depends on the frame.
        prior = hypotheses.prior.copy()
        prior[hypotheses.ends] = misread * (LOOK_ODDS if look_seen else 1.0)
        # Where the pose was known to be, or knocked away from there, of which the ends alone show a part.
        unseen = 1.0 if may_have_slid else self._knocked(now_s, hidden=True)
        knocks = Knocks.of(self._along_cam(fits, cam_T_grip))
        jumped = unseen * float(knocks.share[knocks.along].sum()) * prior[hypotheses.ends] > risk
        doubts, left_out, without = self._doubts_of_knocks(
            measurement, fits, prior, holds, knocks, unseen, cam_T_grip, now_s, displaced
        )
        doubts = fits.doubts(cam_T_grip, prior, anchored).among(holds) + doubts
        made_of = fits if proven or without is None else without
        if without is not None and displaced and not slid and ends is not None and self._sure(without, cam_T_grip):
            proven, made_of = True, without
        staying = self._staying(now_s, knocks, displaced)
        if anchor is not None and not displaced:
            rows = self._about(edges)[1]
            doubts = doubts + anchor.doubts(cam_T_grip, fits, rows, wander, staying)
        ever = MISREAD_PROBABILITY**2 if anchor is None else anchor.misread  # the least that proves a pose
        at_first = self._lasting.priors(ever)
        alone = None if displaced else anchored
        doubts = fits.with_first(doubts, self._lasting, at_first, cam_T_grip, alone, staying)
        both = bounds_of(doubts, risk, left_out)
        if anchor is None and displaced:
            away = perturbation_between(self._expected[0], cam_T_grip)
            both = both._replace(absolute=larger(both.absolute, self._not_as_expected(away)))
        both = self._with_question(both)
        if anchor is None:
            return Trust(both, proven, displaced, may_have_slid=may_have_slid, ends=ends, fits=made_of, misread=misread)
        # The most probable hypothesis since the anchor.
        possible = holds * prior
        if proven:
            possible[hypotheses.ends] = 0.0
        number = (1 + int(possible[1:].argmax())) if displaced else hypotheses.ends if jumped else 0
        most_probable = (anchored, number) if possible[number] > 0.0 else None
        ambiguous = displaced and bool((possible[1:] > 0.0).any())
        grasped = ambiguous and bool((possible[list(hypotheses.grasp)] > 0.0).any())
        opened = measurement.jaw_innovation**2 > JAW_CONTRADICTED_SQUARE and self._in_place
        if displaced and not ambiguous and opened:
            # A knock doesn't move the jaw: flexing fingers and shadows beside them look like both at once.
            ambiguous = grasped = True
            why = "edges belong to something else, which looks like another opening and distance"
            away = perturbation_between(self.expected[0], cam_T_grip)
            both = Bounds(*(reaching(each, away, why) for each in both))
        return Trust(both, proven, displaced, ambiguous, grasped, may_have_slid, most_probable, ends, made_of, misread)

    def _with_question(self, both: Bounds) -> Bounds:
        """The bounds while it is open why the first frames differed from the reference: no motion since them."""
        if self.unexplained is None:
            return both
        return both._replace(absolute=larger(both.absolute, self._not_as_expected(self.unexplained)))

    def _along_cam(self, fits: Refits, cam_T_grip: Array) -> Array:
        """(3,) the way along the fingers, camera frame, that their sides don't show: tapered ones have one of their own
        beside that of the fingers.  Zero for fingers without a direction.
        """
        axis = cam_T_grip[:3, :3] @ self._tracker.finger_axis
        least_known: Array = np.linalg.eigh(fits.covariance[fits.hypotheses.ends][:3, :3])[1][:, 2]
        return least_known if abs(float(least_known @ axis)) > PARALLEL_COSINE * np.linalg.norm(axis) else axis

    def _staying(self, now_s: float, knocks: Knocks, displaced: bool) -> Array:
        """(6, 6) covariance of the motion since the first proven frames that isn't excluded: of a mount that creeps and
        vibrates, and after a knock by what a knock moves it.
        """
        elapsed_s = 0.0 if self.anchor is None else max(now_s - self.anchor.began_s, 0.0)
        covariance = np.diag(self._creep * elapsed_s + self.swing) + self._tracker.floor
        knocked = displaced or (self.anchor is not None and self.anchor.knocked)
        return covariance + knocks.spread if knocked else covariance

    def _doubts_of_knocks(
        self,
        measurement: Measurement,
        fits: Refits,
        prior: Array,
        holds: NDArray[np.bool_],
        knocks: Knocks,
        unseen: float,
        cam_T_grip: Array,
        now_s: float,
        displaced: bool,
    ) -> tuple[TwoDoubts, float, Refits | None]:
        """What may be wrong if the mount was knocked since it was last known, and the probability of what is left out.

        ``prior`` (h,) of the hypotheses, ``holds`` (h,) those under which it may have stayed; ``unseen``: probability
        of a knock that only the ends would show.  Also returns the fits without any of them, if they count.
        """
        hypotheses, edges = fits.hypotheses, fits.edges
        least = LEAST_WEIGHT_RATIO * self._policy.integrity_risk
        across = ~self._along[edges]
        endless = (hypotheses.keep[:, across] == 0.0).all(axis=1)
        probable = np.where(endless, unseen, self._knocked(now_s, hidden=False))
        if not across.any():
            probable[hypotheses.ends] = 0.0  # the same as that nothing is wrong
        doubts, left_out = fits.knocked(cam_T_grip, prior, knocks, probable, holds, endless, least)
        besides = unseen * prior[hypotheses.ends]
        without = None if across.any() else fits
        if across.any() and (displaced or not self.proved or besides * WRONG_EDGE > least):
            endless_too, more = hypotheses.without_ends()
            without = Refits(measurement, endless_too, self._tracker.floor, fits.model, fits.known)
            both = prior[hypotheses.ends] * hypotheses.prior * more
            stays = without.anchored.square <= CONTRADICTION_SQUARE
            of_both, more_out = without.knocked(
                cam_T_grip, both, knocks, np.full(len(both), unseen), stays, np.ones_like(stays), least
            )
            doubts, left_out = doubts + of_both, left_out + more_out
        return doubts, left_out, without

    def settle(
        self, trust: Trust, measurement: Measurement, cam_T_grip: Array, covariance: Array, now_s: float
    ) -> None:
        """Add a pose (4, 4) with its covariance (6, 6) to the anchor, or start a new anchor with it.  One that isn't
        proven counts until another one is, by its fits without the fingers' ends.
        """
        assert trust.fits is not None
        proven = trust.proven
        if self.proved and not proven:
            return
        rows = self._about(trust.fits.edges)[1]
        if proven:
            self._slid = trust.may_have_slid
        if self.proved:
            assert self.anchor is not None
            way = perturbation_between(self.anchor.cam_T_grip, cam_T_grip)
            self._swing = swinging(self._swing, way, self.anchor.covariance.diagonal() + covariance.diagonal())
        elif trust.displaced:
            # Knocked while the monitor was off, or marks on the fingers, or a wrong model: a person has to decide.
            self.unexplained = perturbation_between(self._expected[0], cam_T_grip)
            self.question = Question(self.unexplained, self._revision)
        if self.anchor is None or trust.displaced or proven > self.anchor.proven:
            origin_T, known = self.expected if self.proved else self._expected
            if trust.displaced:
                known = known + Knocks.of(cam_T_grip[:3, :3] @ self._tracker.finger_axis).spread
            misread = trust.misread
            beside_px = measurement.prediction.moved_px(perturbation_between(origin_T, cam_T_grip))
            if self.proved and beside_px < ONE_EDGE_PX:
                misread = min(misread, self.misread_ever)  # so near to it nothing else is taken for the ends
            at = cam_T_grip, trust.fits, rows, now_s, (origin_T, known)
            self.anchor = Anchor(self._lasting, *at, misread, proven, trust.displaced)
        else:
            self._in_place = proven
            self.anchor.add(trust.fits, rows, self._creep * max(now_s - self.anchor.now_s, 0.0), now_s, trust.misread)

    def _may_have_slid(self, measurement: Measurement, cam_T_grip: Array, displaced: bool) -> bool:
        """Whether a lone finger may have slid along itself though corners are seen: they may belong to a mark on it or
        to something beside it.  They prove a place that the edges don't distinguish from the reference's, and then
        each place less than :data:`ONE_EDGE_PX` from the proven one; elsewhere a person has to confirm it by a new
        reference.
        """
        if self._slid is None:
            covariance = self._expected[1] + measurement.covariance[:6, :6] + self._tracker.floor
            way = perturbation_between(self._reference_T, cam_T_grip)
            displaced = bool(way @ np.linalg.solve(covariance, way) > CONTRADICTION_SQUARE)
        else:
            assert self.anchor is not None
            way = perturbation_between(self.anchor.cam_T_grip, cam_T_grip)
        return bool(self._slid) or (displaced and measurement.prediction.moved_px(way) >= ONE_EDGE_PX)

    def held(self, both: Bounds, growth: Array, unseen_s: float, hidden: bool) -> Bounds:
        """The protection levels of a transform measured ``unseen_s`` ago, whose covariance (6, 6) has grown by
        ``growth``.  ``hidden``: the image is good, but the gripper isn't seen in it.
        """
        risk = self._policy.integrity_risk
        if max(self._jumps_per_s * unseen_s, KNOCK_UNSEEN_PROBABILITY if hidden else 0.0) > risk:
            why = "the mount was knocked while nothing is seen of the gripper"
            unbounded = Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, why)
            return Bounds(unbounded, unbounded)
        position_m, rotation_rad = bounds(np.stack([growth[:3, :3], growth[3:, 3:]]), np.full(2, risk)).tolist()
        return Bounds(
            *(Protection(b.position_m + position_m, b.rotation_rad + rotation_rad, risk, b.hypothesis) for b in both)
        )

    def _knocked(self, now_s: float, hidden: bool) -> float:
        """Probability that the mount was knocked since the pose was last proven, or since the reference's images;
        ``hidden``: something hides what would show it.
        """
        if self.anchor is None:
            return KNOCK_UNSEEN_PROBABILITY
        return max(self._jumps_per_s * (now_s - self.anchor.now_s), KNOCK_UNSEEN_PROBABILITY if hidden else 0.0)

    def confirmations(self, measurement: Measurement, ends: FingerEndsSeen | None) -> int:
        """How many times the fingers' ends are seen where the pose has them: once for each finger by its edges, and
        once more for each further corner.
        """
        return self._times(self._across(measurement), ends)

    def _across(self, measurement: Measurement) -> NDArray[np.intp]:
        """The edges that are seen and don't run along the fingers."""
        edge = measurement.normal.edge
        return edge[measurement.consensus.edge_seen[edge] & ~self._along[edge]]

    def _times(self, edges: NDArray[np.intp], ends: FingerEndsSeen | None) -> int:
        by_edge = set(self._gripper.edge_finger[edges].tolist())
        return len(by_edge) if ends is None else sum(max(int(ends.seen[finger]), 1) for finger in by_edge)

    def _misread(self, measurement: Measurement, ends: FingerEndsSeen | None, kept: NDArray[np.bool_] | None) -> float:
        """Probability that what is seen where the fingers' ends are expected is something else; ``kept`` (v,): the
        measured edges that count.  A finger's root isn't an end, and edges on one line count once, of whichever
        fingers: a single straight border may show them all.
        """
        edges = self._across(measurement)
        edges = edges[self._at_ends[edges]]
        if kept is not None:
            edges = edges[np.isin(edges, measurement.normal.edge[kept])]
        times = self._times(edges, ends)
        if ends is not None and not ends.seen.any() and _on_one_line(measurement, edges):
            times = min(times, 1)
        return MISREAD_PROBABILITY**times

    def held_across(self, measurement: Measurement, now_s: float) -> bool:
        """Whether enough of the fingers' sides is seen at the anchor to exclude a knock across the fingers since it was
        proven (before anything is proven: just now).  The edges at the ends don't show such a knock; each side may be
        misread with the same probability as an end.
        """
        edge = measurement.normal.edge
        sides = int((measurement.consensus.edge_seen[edge] & self._along[edge]).sum())
        excluded = self._knocked(now_s, hidden=True) * MISREAD_PROBABILITY**sides
        return excluded <= (1.0 + 1e-9) * self._policy.integrity_risk  # powers of ten are equal but for rounding

    def _sure(self, fits: Refits, cam_T_grip: Array) -> bool:
        """Whether the protection level of a pose (4, 4) from ``fits`` is within the alert limits.  Curved and tapered
        fingers show a motion along themselves even without their ends.
        """
        both = bounds_of(fits.doubts(cam_T_grip, fits.hypotheses.prior), self._policy.integrity_risk)
        return past_alert_limit(both.by(self._policy.valid_by), self._policy) is None

    def _not_as_expected(self, away: Array) -> Protection:
        """The protection level where the first frames differ from the reference by ``away`` (6,)."""
        risk = self._policy.integrity_risk
        covariance = np.stack([self._expected[1][:3, :3], self._expected[1][3:, 3:]])
        position_m, rotation_rad = bounds(covariance, np.full(2, risk)).tolist()
        why = "the mount was knocked before the start, or the model is off: it wasn't where the reference has it"
        return reaching(Protection(position_m, rotation_rad, risk, why), away, why)

    def _wander(self, now_s: float) -> Array:
        """(6,) variance of the motion since the anchor: creep and vibration."""
        if self.anchor is None:
            return self.swing
        return self._creep * max(now_s - self.anchor.now_s, 0.0) + self.swing

    def _refitted(self, measurement: Measurement, now_s: float, wander: Array) -> tuple[Refits, Anchored]:
        """The fits of a measurement, alone and with the anchor after a motion of variances ``wander`` (6,).  They are
        kept while the same measurement is weighed again: with its ends checked, or for another pose.
        """
        if self._newest is None or self._newest[0] is not measurement or self._newest[1] != now_s:
            expected_T, covariance = self.expected
            of_model = np.zeros((1, 6)) if self.anchor is None else self.anchor.of_model
            covariance = covariance.copy()
            covariance.flat[::7] += wander
            known = Known(expected_T, covariance, of_model)
            model = self._model._replace(first=self._since.published_by)
            fits = Refits(measurement, self._about(measurement.normal.edge)[0], self._tracker.floor, model, known)
            self._newest = measurement, now_s, fits
        fits = self._newest[2]
        assert fits.anchored is not None
        return fits, fits.anchored

    def _about(self, edges: NDArray[np.intp]) -> tuple[Hypotheses, NDArray[np.intp]]:
        """The hypotheses about a fit of ``edges`` (v,), and which of them each lasting hypothesis is."""
        key = edges.tobytes()
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            hypotheses = _hypotheses_about(edges, self._gripper, self._tracker, self._may_open, self._words)
            self._kept[key] = hypotheses, self._lasting.rows(hypotheses, edges)
        return self._kept[key]


def _proven(ends: FingerEndsSeen | None, elsewhere: bool, again: bool) -> bool:
    """Whether the fingers' ends are seen as ends.  Not ``elsewhere`` than expected fewer corners suffice; where the
    innovation is within noise (``again``), one of each finger.
    """
    if ends is None:
        return False
    expected = not elsewhere and int(ends.seen.sum()) >= CORNERS_WHERE_EXPECTED
    return ends.sure or expected or (again and ends.at_each)


def _on_one_line(measurement: Measurement, edges: NDArray[np.intp]) -> bool:
    """Whether some edges lie on one straight line of the image."""
    prediction = measurement.prediction
    uv_px = prediction.uv_px[np.isin(prediction.layout.edge, edges) & prediction.ok]
    if len(uv_px) == 0:
        return True
    off_px = uv_px - uv_px.mean(axis=0)
    return bool(np.abs(off_px @ np.linalg.svd(off_px, full_matrices=False)[2][-1]).max() < ONE_EDGE_PX)


def _hypotheses_about(
    edges: NDArray[np.intp], gripper: Gripper, tracker: Tracker, may_open: bool, words: Words
) -> Hypotheses:
    names = tuple(words.edges[edge] for edge in edges)
    of_each = gripper.edge_finger[edges], words.fingers, tracker.along[edges], inner_edges(gripper)[edges]
    return hypotheses_of(names, *of_each, may_open, tuple(side[edges] for side in sides(gripper)))


def _model_error(tracker: Tracker, gripper: Gripper) -> ModelError:
    scale_sigma, taught, offset = gripper.model.scale_sigma, tracker.taught_error, tracker.taught_offset
    common = CommonError(scale_sigma, taught, offset) if scale_sigma or len(taught) or offset.any() else None
    return ModelError(tracker.model_sigma_m, tracker.finger_axis, gripper.edge_finger, len(gripper.finger_ids), common)


def foresee_bounds(tracker: Tracker, gripper: Gripper, settings: MonitorSettings, measurement: Measurement) -> Bounds:
    """The protection levels of a single frame with the given measurement and proven fingers' ends, where the frames of
    the reference show no more.
    """
    if not len(measurement.normal.edge):
        unbounded = Protection(UNBOUNDED_M, UNBOUNDED_RAD, settings.policy.integrity_risk, NOTHING_WRONG)
        return Bounds(unbounded, unbounded)
    may_open = gripper.has_jaw and settings.jaw_sigma_m > 0.0
    words = in_words(gripper, measurement.prediction.cam_T_grip)
    hypotheses = _hypotheses_about(measurement.normal.edge, gripper, tracker, may_open, words)
    model = _model_error(tracker, gripper)
    nothing = Known(measurement.cam_T_grip, np.diag([UNBOUNDED_M**2] * 3 + [UNBOUNDED_RAD**2] * 3), np.zeros((1, 6)))
    fits = Refits(measurement, hypotheses, tracker.floor, model, nothing)
    doubts = fits.doubts(measurement.cam_T_grip, hypotheses.prior)
    return bounds_of(doubts.among(~hypotheses.sudden), settings.policy.integrity_risk)
