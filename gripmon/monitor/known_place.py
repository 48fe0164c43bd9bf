"""Where the gripper is known to be: at the anchor, the average of the proven poses, or before there is one where the
reference has it; and how far the mount may have moved since.
"""

from __future__ import annotations

import numpy as np

from gripmon.model.geometry import from_record
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, ReferenceRecord
from gripmon.monitor.anchor import Anchor
from gripmon.monitor.possible import Possible
from gripmon.monitor.since import AtReferences
from gripmon.monitor.standing import Question, Trust
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import Measurement
from gripmon.track.integrity import Mount
from gripmon.track.integrity.knocks import KNOCK_UNSEEN_PROBABILITY
from gripmon.track.look import ONE_EDGE_PX


class KnownPlace:
    """What one monitor knows of the gripper's place from its frames so far."""

    def __init__(
        self, tracker: Tracker, mount: Mount, possible: Possible, reference: ReferenceRecord, since: AtReferences
    ):
        """``possible``: what may be wrong with its fits; ``since``: what was measured at the reference in force."""
        self._tracker, self._mount, self._possible, self._since = tracker, mount, possible, since
        self.anchor: Anchor | None = None
        self.question: Question | None = None
        """By how much the first proven pose differed from the expected one; None if it didn't."""
        self.in_place = False
        """Whether a frame proved where the gripper was before: that shows how the reported opening errs."""
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

    @property
    def at(self) -> tuple[Array, Array]:
        """Where the gripper is expected: pose (4, 4) and covariance (6, 6), of the anchor if there is one."""
        return self._expected if self.anchor is None else (self.anchor.cam_T_grip, self.anchor.covariance)

    @property
    def at_first(self) -> tuple[Array, Array]:
        """The same as before there was an anchor: by the reference, or the last known pose."""
        return self._expected

    @property
    def proved(self) -> bool:
        """Whether a frame has proven a pose."""
        return self.anchor is not None and self.anchor.proven

    @property
    def swing(self) -> Array:
        """(6,) variance of the mount's vibration, m² and rad²."""
        return self._mount.swing

    @property
    def usual_motion(self) -> Array:
        """(6, 6) covariance of what a mount moves by since the reference's frames without a knock."""
        return np.diag(self._mount.creep(self._since.elapsed_s) + self._mount.to_and_fro) + self._tracker.floor

    def wander(self, now_s: float) -> Array:
        """(6,) variance of the motion since the anchor: creep, vibration and play.  Before there is one without play:
        whether the first frames are where the reference has the gripper is asked by what that says of itself.
        """
        if self.anchor is None:
            return self.swing
        return self._mount.creep(now_s - self.anchor.now_s) + self._mount.to_and_fro

    def sigma(self, now_s: float) -> Array:
        """(6,) standard deviations of where it is expected, m and rad."""
        variance = self.at[1].diagonal() + self.wander(now_s) + self._tracker.floor.diagonal()
        if self.anchor is not None:
            variance = variance + np.square(self.anchor.of_model).sum(axis=0)
        return np.sqrt(variance)

    def knocked(self, now_s: float) -> tuple[float, float]:
        """Probability that the mount was knocked since the pose was last proven, or since the reference's images, if
        nothing hides what would show it, and if something does.
        """
        if self.anchor is None:
            return KNOCK_UNSEEN_PROBABILITY, KNOCK_UNSEEN_PROBABILITY
        elapsed_s = now_s - self.anchor.now_s
        return self._mount.knocked(elapsed_s, hidden=False), self._mount.knocked(elapsed_s, hidden=True)

    def moved(self) -> bool:
        """Whether the anchor isn't where the reference's frames had the gripper, by more than a mount moves by itself:
        also after a knock while the monitor was off or the ends were hidden.
        """
        first, anchor = self._since.current, self.anchor
        if first is None or anchor is None:
            return False
        way = perturbation_between(first.cam_T_grip, anchor.cam_T_grip)
        covariance = anchor.covariance + first.fits.covariance[0] + self.usual_motion
        return _contradicts(way, covariance)

    def may_have_slid(self, measurement: Measurement, cam_T_grip: Array, displaced: bool) -> bool:
        """Whether a lone finger may have slid along itself though corners are seen: they may belong to a mark on it or
        to something beside it.  They prove a place that the edges don't distinguish from the reference's, and then
        each place less than :data:`ONE_EDGE_PX` from the proven one; elsewhere a person has to confirm it by a new
        reference.
        """
        if self._slid is None:
            covariance = self._expected[1] + measurement.covariance[:6, :6] + self._tracker.floor_of(measurement)
            way = perturbation_between(self._reference_T, cam_T_grip)
            displaced = _contradicts(way, covariance)
        else:
            assert self.anchor is not None
            way = perturbation_between(self.anchor.cam_T_grip, cam_T_grip)
        return bool(self._slid) or (displaced and measurement.prediction.moved_px(way) >= ONE_EDGE_PX)

    def settle(
        self, trust: Trust, measurement: Measurement, cam_T_grip: Array, covariance: Array, now_s: float
    ) -> None:
        """Add a pose (4, 4) with its covariance (6, 6) to the anchor, or start a new anchor with it.  One that isn't
        proven counts until another one is, by its fits without the fingers' ends.
        """
        assert trust.fits is not None and trust.knock is not None
        proven = trust.proven
        if self.proved and not proven:
            return
        rows = self._possible.about(trust.fits.edges).rows
        if proven:
            self._slid = trust.may_have_slid
        if self.proved:
            assert self.anchor is not None
            way = perturbation_between(self.anchor.cam_T_grip, cam_T_grip)
            self._mount.learn(way, self.anchor.covariance.diagonal() + covariance.diagonal())
        elif trust.displaced:
            # Knocked while the monitor was off, or marks on the fingers, or a wrong model: a person has to decide.
            self.unexplained = perturbation_between(self._expected[0], cam_T_grip)
            self.question = Question(self.unexplained, self._revision)
        if self.anchor is None or trust.displaced or proven > self.anchor.proven:
            origin_T, known = self.at if self.proved else self._expected
            if trust.displaced:
                known = known + trust.knock
            misread = trust.misread
            beside_px = measurement.prediction.moved_px(perturbation_between(origin_T, cam_T_grip))
            if self.proved and beside_px < ONE_EDGE_PX:
                assert self.anchor is not None
                misread = min(misread, self.anchor.misread)  # so near to it nothing else is taken for the ends
            at = cam_T_grip, trust.fits, rows, now_s, (origin_T, known)
            self.anchor = Anchor(self._possible.lasting, *at, misread, proven, trust.displaced)
        else:
            self.in_place = proven
            self.anchor.add(trust.fits, rows, self._mount.creep(now_s - self.anchor.now_s), now_s, trust.misread)


def _contradicts(way: Array, covariance: Array) -> bool:
    """Whether a motion (6,) is larger than its covariance (6, 6) allows."""
    return bool(way @ np.linalg.solve(covariance, way) > CONTRADICTION_SQUARE)
