"""What may be wrong with the fits of one gripper, and with its file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb
from gripmon.model.records import NOTHING_WRONG, Array, AtReferenceRecord, Frame, ReferenceRecord, Since
from gripmon.monitor.anchor import Lasting, average_of
from gripmon.monitor.bounds import UNBOUNDED_M, UNBOUNDED_RAD, ModelError, unbounded
from gripmon.monitor.common import CommonError, Tilt
from gripmon.monitor.ends import EndsEvidence, proof
from gripmon.monitor.refits import Known, Refits
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.since import AtReference, Bounds, digest_of
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import Measurement, inner_edges, receding, sides
from gripmon.track.edges.words import in_words
from gripmon.track.integrity import Hypotheses, hypotheses_of

MOST_KEPT = 64
"""Sets of seen edges whose hypotheses are remembered."""


class About(NamedTuple):
    """What may be wrong with a fit of some seen edges: the ``hypotheses``, the same ``without_ends`` besides, ``pairs``
    of these that doubt more than the ends, and ``rows`` (g,), which hypothesis each lasting one is.
    """

    hypotheses: Hypotheses
    without_ends: Hypotheses
    pairs: Hypotheses
    rows: NDArray[np.intp]


class Possible:
    """The hypotheses about one gripper's fits: ``lasting``, those that may hold in every frame, and its ``model``'s
    error.
    """

    def __init__(self, tracker: Tracker, gripper: Gripper, settings: MonitorSettings, cam_T_grip: Array):
        """``cam_T_grip`` (4, 4): where the picture shows the gripper, for its edges' names in words."""
        self._gripper, self._along, self._sides = gripper, tracker.along & ~receding(gripper), sides(gripper)
        self._words, self._inner = in_words(gripper, cam_T_grip), inner_edges(gripper)
        self._may_open = gripper.has_jaw and settings.jaw_sigma_m > 0.0  # else the report is configured as exact
        self._kept: dict[bytes, About] = {}
        self.lasting = Lasting.of(self.hypotheses(np.arange(len(gripper.edge_ids))))
        file, taught, offset = gripper.model, tracker.taught_error, tracker.taught_offset
        wrong = file.scale_sigma or file.tilt_sigma_rad or len(taught) or offset.any()
        common = CommonError(file.scale_sigma, taught, offset, Tilt.of(gripper, cam_T_grip)) if wrong else None
        of_each = gripper.edge_finger, len(gripper.finger_ids)
        self.model = ModelError(tracker.model_sigma_m, tracker.finger_axis, *of_each, common)

    def hypotheses(self, edges: NDArray[np.intp]) -> Hypotheses:
        """What may be wrong with a fit of ``edges`` (v,)."""
        names = tuple(self._words.edges[edge] for edge in edges)
        of_each = self._gripper.edge_finger[edges], self._words.fingers, self._along[edges], self._inner[edges]
        return hypotheses_of(names, *of_each, self._may_open, tuple(side[edges] for side in self._sides))

    def about(self, edges: NDArray[np.intp]) -> About:
        """The same with what follows from it, kept from frame to frame."""
        key = edges.tobytes()
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            hypotheses = self.hypotheses(edges)
            without = hypotheses.without_ends()
            rows = self.lasting.rows(hypotheses, edges)
            self._kept[key] = About(hypotheses, without, without.pairs(), rows)
        return self._kept[key]


class _Seen(NamedTuple):
    """One image to teach from: its fits, what may be wrong with them, the opening, the probability that its ends are
    something else, and whether it proves where the gripper is.
    """

    fits: Refits
    about: About
    jaw_opening_m: float
    misread: float
    proven: bool

    @property
    def counting(self) -> tuple[Refits, NDArray[np.intp]]:
        """The fits that count, without the fingers' ends where nothing proves them, and which are the lasting ones."""
        return self.fits if self.proven else self.fits.under(self.about.without_ends), self.about.rows


def seen_in_images(
    tracker: Tracker,
    gripper: Gripper,
    settings: MonitorSettings,
    reference: ReferenceRecord,
    frames: Sequence[Frame],
    play: Array,
    taught_ns: int,
) -> AtReferenceRecord | None:
    """What a monitor with taught edges measures of the images that they were taught from, ``taught_ns`` (Unix ns) when,
    on average, of those that don't prove where the gripper is by their fits without the fingers' ends; ``play`` (6,):
    standard deviations of the mount's play between them.  None where it is seen in none.
    """
    cam_T_grip = from_record(reference.cam_T_grip)
    possible, risk = Possible(tracker, gripper, settings, cam_T_grip), settings.policy.integrity_risk
    evidence, seen = EndsEvidence(gripper, tracker.along), list[_Seen]()
    for number, frame in enumerate(frames):
        measurement = tracker.measure(frame, cam_T_grip, float(number))
        if not measurement.trusted:
            continue
        measurement = tracker.with_known_jaw(measurement, frame.jaw_opening_m)
        ends, about = tracker.ends(frame, measurement), possible.about(measurement.normal.edge)
        known = _nothing_known(measurement.cam_T_grip)
        floor = tracker.floor_of(measurement)
        of_ends = proof(ends, evidence.misread(measurement, ends), risk)
        own = Refits(measurement, about.hypotheses, floor, possible.model, known)
        seen.append(_Seen(own, about, measurement.jaw_opening_m, of_ends.misread, of_ends.proven))
    if not seen:
        return None
    average = average_of(cam_T_grip, [each.counting for each in seen], play)
    proven = any(each.proven for each in seen)
    misread = min(each.misread for each in seen if each.proven == proven)
    opening_m = float(np.mean([each.jaw_opening_m for each in seen]))
    seen_T = perturb(cam_T_grip, average.shift[0])
    of = average._replace(shift=average.shift - average.shift[0])
    at = seen_T, of, opening_m, len(seen), Since.REFERENCE, taught_ns, misread, proven
    return AtReference(*at, of_images=True).record(reference.reference_id, digest_of(tracker.measured_as))


def _nothing_known(cam_T_grip: Array) -> Known:
    return Known(cam_T_grip, np.diag([UNBOUNDED_M**2] * 3 + [UNBOUNDED_RAD**2] * 3), np.zeros((1, 6)))


def foresee_bounds(tracker: Tracker, gripper: Gripper, settings: MonitorSettings, measurement: Measurement) -> Bounds:
    """The protection levels of a single frame with the given measurement and proven fingers' ends, where the frames of
    the reference show no more.
    """
    if not len(measurement.normal.edge):
        return unbounded(settings.policy.integrity_risk, NOTHING_WRONG)
    cam_T_grip = measurement.cam_T_grip
    possible = Possible(tracker, gripper, settings, measurement.prediction.cam_T_grip)
    hypotheses = possible.hypotheses(measurement.normal.edge)
    known, floor = _nothing_known(cam_T_grip), tracker.floor_of(measurement)
    fits = Refits(measurement, hypotheses, floor, possible.model, known)
    risk, lasting = settings.policy.integrity_risk, np.flatnonzero(~hypotheses.sudden)
    return fits.bounds(cam_T_grip, lasting, np.zeros(6), risk)
