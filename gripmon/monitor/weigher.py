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
from gripmon.track.edges import FingerEndsSeen, Measurement, edges_at_ends, has_lone_end, inner_edges, sides
from gripmon.track.integrity import Hypotheses, bounds, hypotheses_of
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

KNOCK_UNSEEN_PROBABILITY = 5e-4
"""Probability that the mount is knocked while something hides the fingers' ends: the gripper touches things then, so
that the average rate of knocks is too low.
"""

MOST_KEPT = 64
"""Sets of seen edges whose hypotheses are remembered."""

CORNERS_WHERE_EXPECTED = 3
"""Corners at the fingers' ends that prove a pose where the gripper is expected; elsewhere four of two fingers."""


def swinging(swing: Array, way: Array, noise: Array) -> Array:
    """(6,) variance of the mount's vibration after one more ``way`` (6,) between consecutive poses; ``noise`` (6,):
    variances that the poses' own errors add to it.
    """
    # A knock is not a vibration, but what rings after it is.
    most = CONTRADICTION_SQUARE * (noise + swing)
    return np.asarray(swing + (np.minimum(np.square(way), most) - swing) / VIBRATION_FRAMES)


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
        self._lasting = Lasting.of(_hypotheses_about(every, gripper, tracker, self._may_open))
        self._kept: dict[bytes, tuple[Hypotheses, NDArray[np.intp]]] = {}
        self._newest: tuple[Measurement, float, Refits] | None = None
        self.swing: Array = np.zeros(6)
        """(6,) variance of the way between proven poses, m² and rad²: vibration."""
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
        return self._since.restore(records, len(self._lasting.name), self._model.fingers)

    @property
    def expected(self) -> tuple[Array, Array]:
        """Where the gripper is expected: pose (4, 4) and covariance (6, 6), of the anchor if there is one."""
        return self._expected if self.anchor is None else (self.anchor.cam_T_grip, self.anchor.covariance)

    def sigma(self, now_s: float) -> Array:
        """(6,) standard deviations of where it is expected, m and rad."""
        return np.asarray(np.sqrt(self.expected[1].diagonal() + self._wander(now_s) + self._tracker.floor.diagonal()))

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
        there: as few corners prove the pose as where it is expected, and a lone finger hasn't slid.
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
        misread = 0.0 if proven and not may_have_slid else 1.0 if slid else self._misread(measurement, ends, kept)
        # The priors: only that of the ends depends on the frame.  Then the probability that only the frame shows where
        # the fingers are along their direction.
        prior = hypotheses.prior.copy()
        prior[hypotheses.ends] = misread * (LOOK_ODDS if look_seen else 1.0)
        alone = 1.0
        if anchor is not None and not (displaced or may_have_slid):
            alone = self._knocked(now_s - anchor.now_s, hidden=True)
        jumped = alone * prior[hypotheses.ends] > risk
        # Lasting hypotheses: from the frame, or from the anchor, whose place the ends confirm then.
        made_of = fits
        if displaced or jumped or anchor is None:
            all_along, without = self._doubts_of_frame(measurement, fits, prior, cam_T_grip, alone if jumped else None)
            if without is not None and displaced and not slid and ends is not None and self._sure(without, cam_T_grip):
                proven, made_of = True, without
        else:
            all_along = anchor.doubts(cam_T_grip, fits, self._about(edges)[1], wander)
        all_along = fits.with_first(all_along, self._lasting, cam_T_grip, None if displaced else anchored)
        if anchor is None:
            both = bounds_of(all_along, risk)
            if displaced:
                away = perturbation_between(self._expected[0], cam_T_grip)
                both = both._replace(absolute=larger(both.absolute, self._not_as_expected(away)))
            both = self._with_question(both)
            return Trust(both, proven, displaced, may_have_slid=may_have_slid, ends=ends, fits=made_of)
        # Hypotheses since the anchor, and the most probable one.
        possible = holds * prior
        number = (1 + int(possible[1:].argmax())) if displaced else hypotheses.ends if jumped else 0
        most_probable = (anchored, number) if possible[number] > 0.0 else None
        since = fits.doubts(cam_T_grip, prior, anchored).among(holds)
        both = self._with_question(bounds_of(all_along + since, risk))
        ambiguous = displaced and bool((possible[1:] > 0.0).any())
        grasped = ambiguous and bool((possible[list(hypotheses.grasp)] > 0.0).any())
        opened = measurement.jaw_innovation**2 > JAW_CONTRADICTED_SQUARE and self._in_place
        if displaced and not ambiguous and opened:
            # A knock doesn't move the jaw: flexing fingers and shadows beside them look like both at once.
            ambiguous = grasped = True
            why = "edges belong to something else, which looks like another opening and distance"
            away = perturbation_between(self.expected[0], cam_T_grip)
            both = Bounds(*(reaching(each, away, why) for each in both))
        return Trust(both, proven, displaced, ambiguous, grasped, may_have_slid, most_probable, ends, made_of)

    def _with_question(self, both: Bounds) -> Bounds:
        """The bounds while it is open why the first frames differed from the reference: no motion since them."""
        if self.unexplained is None:
            return both
        return both._replace(absolute=larger(both.absolute, self._not_as_expected(self.unexplained)))

    def _doubts_of_frame(
        self, measurement: Measurement, fits: Refits, prior: Array, cam_T_grip: Array, alone: float | None
    ) -> tuple[TwoDoubts, Refits | None]:
        """The lasting hypotheses from this frame's ``fits`` alone, with probabilities ``prior`` (h,).

        ``alone``: the probability that only this frame shows where the fingers' ends are, if they may be something
        else; then the fits without the ends are returned as well.
        """
        hypotheses = fits.hypotheses
        # A knock of the mount may bend a finger, too; but fingers are assumed straight at first.
        counts = ~hypotheses.sudden if self.anchor is None else np.ones_like(hypotheses.sudden)
        lasting = self._lasting.numbers(self._about(fits.edges)[1], len(hypotheses.name))
        rows = counts.copy()
        rows[hypotheses.ends] = True
        doubts = fits.doubts(cam_T_grip, prior, lasting=lasting).among(rows)
        if alone is None:
            return doubts, None
        endless, more = hypotheses.without_ends()
        without = Refits(measurement, endless, self._tracker.floor, fits.model)
        besides = alone * prior[hypotheses.ends] * hypotheses.prior
        return doubts + without.doubts(cam_T_grip, besides).among(counts & more), without

    def settle(self, trust: Trust, cam_T_grip: Array, covariance: Array, now_s: float) -> None:
        """Add a proven pose (4, 4) with its covariance (6, 6) to the anchor, or start a new anchor with it."""
        assert trust.fits is not None
        rows = self._about(trust.fits.edges)[1]
        self._slid = trust.may_have_slid
        if self.anchor is not None:
            way = perturbation_between(self.anchor.cam_T_grip, cam_T_grip)
            self.swing = swinging(self.swing, way, self.anchor.covariance.diagonal() + covariance.diagonal())
        elif trust.displaced:
            # Knocked while the monitor was off, or marks on the fingers, or a wrong model: a person has to decide.
            self.unexplained = perturbation_between(self._expected[0], cam_T_grip)
            self.question = Question(self.unexplained, self._revision)
        if self.anchor is None or trust.displaced:
            self.anchor = Anchor(self._lasting, cam_T_grip, trust.fits, rows, now_s, trust.displaced)
        else:
            self._in_place = True
            self.anchor.add(trust.fits, rows, self._creep * max(now_s - self.anchor.now_s, 0.0), now_s)

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
        if self._knocked(unseen_s, hidden) > risk:
            why = "the mount was knocked while nothing is seen of the gripper"
            unbounded = Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, why)
            return Bounds(unbounded, unbounded)
        position_m, rotation_rad = bounds(np.stack([growth[:3, :3], growth[3:, 3:]]), np.full(2, risk)).tolist()
        return Bounds(
            *(Protection(b.position_m + position_m, b.rotation_rad + rotation_rad, risk, b.hypothesis) for b in both)
        )

    def _knocked(self, unseen_s: float, hidden: bool) -> float:
        """Probability that the mount was knocked within ``unseen_s``; ``hidden``: something hides the gripper."""
        return max(self._jumps_per_s * unseen_s, KNOCK_UNSEEN_PROBABILITY if hidden else 0.0)

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
        unseen_s = 0.0 if self.anchor is None else now_s - self.anchor.now_s
        knocked = self._knocked(unseen_s, hidden=True)
        return knocked * MISREAD_PROBABILITY**sides <= self._policy.integrity_risk

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
            hypotheses = _hypotheses_about(edges, self._gripper, self._tracker, self._may_open)
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


def _hypotheses_about(edges: NDArray[np.intp], gripper: Gripper, tracker: Tracker, may_open: bool) -> Hypotheses:
    names = tuple(gripper.edge_ids[edge] for edge in edges)
    of_each = gripper.edge_finger[edges], gripper.finger_ids, tracker.along[edges], inner_edges(gripper)[edges]
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
    hypotheses = _hypotheses_about(
        measurement.normal.edge, gripper, tracker, gripper.has_jaw and settings.jaw_sigma_m > 0.0
    )
    model = _model_error(tracker, gripper)
    doubts = Refits(measurement, hypotheses, tracker.floor, model).doubts(measurement.cam_T_grip, hypotheses.prior)
    return bounds_of(doubts.among(~hypotheses.sudden), settings.policy.integrity_risk)
