"""From one frame to the corrected transform: measure, fuse the jaw opening with earlier knowledge, update."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb
from gripmon.model.records import Array, Beside, EdgeEvidence, Frame, Image
from gripmon.monitor.backlog import RESULT_AFTER_S, Backlog
from gripmon.monitor.settings import MonitorSettings
from gripmon.track.differential import DegenerateGeometry, Update, differential_update
from gripmon.track.edges import (
    Expected,
    FingerEndsSeen,
    FingerMeter,
    FingertipMeter,
    Measurement,
    Patience,
    SearchSettings,
    Sought,
    TaughtEdges,
    edges_at_ends,
)
from gripmon.track.jaw import JawKnowledge

USUAL_SHARE = 0.6
"""Inlier ratio that is expected before anything is known about this gripper, and when teaching."""

USUAL_RATES = (0.02, 0.1)
"""How fast the usual inlier ratio follows a smaller and a larger one, per frame: a few bad frames hardly lower it."""

SHOWN_FRAMES = 50
"""Frames over which it is learnt how often each edge shows, as the usual inlier ratio follows a smaller one: one that
was hidden once isn't given up.  That all show, which is assumed before, counts as one of them.
"""

CORNER_COUNTS = {"all": None, "3P": 3, "4P": 4, "5P": 5}
"""Largest number of corners of each variant, named as in the paper."""


class GripperSearch:
    """Searches for a gripper that isn't seen, one search at a time in the background: started with one frame's image,
    its result used in a later frame.

    Nobody waits for frames, unless they are ``live``: then the first search after the gripper was lost runs within its
    frame, and the others are used a fixed time later.  A live frame waits for none: a result is used in the first one
    after the search's end.  ``searches``, whether one began with the newest frame's image, and ``searched_seq``, the
    number of the frame whose image the one used that is used in it, tell a replay of live frames how to repeat that.

    A doubtful fit may search further at the cost of a credit that good frames refill slowly.  A lost gripper is
    searched for continuously while the last transform is held, and then in one of several frames: it keeps moving, and
    may come back at any moment.  A place found during a doubtful fit is followed for as long: it has to show the
    fingers' ends, and clutter hides them in some frames.
    """

    def __init__(self, meter: FingertipMeter, settings: SearchSettings, hold_s: float):
        """``meter``: for the search alone, since it runs in parallel with the frames."""
        self._meter, self._settings, self._hold_s = meter, settings, hold_s
        self._backlog: Backlog[Sequence[Expected]] = Backlog()
        self._found: Sequence[Expected] | None = None  # for the newest frame
        self._kept: tuple[Sequence[Expected], float] = (), 0.0  # found before a doubtful fit, and when
        self.live = self.searches = False
        self.searched_seq: int | None = None
        self._seq = self._of_seq = 0  # of the newest frame, and of the one whose image is searched
        self._within = True  # whether this frame may wait for a search
        self._after_s = RESULT_AFTER_S
        self._now_s = self._seen_s = 0.0
        self._credit = float(settings.eager_frames)
        self._untrusted = 0  # frames since the gripper was seen
        self._searched = False  # since then

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._backlog.undone

    def run_pending(self) -> None:
        """Run the waiting searches; in any thread."""
        self._backlog.run()

    def begin_frame(self, seq: int, now_s: float, then: Beside | None = None) -> Patience:
        """Whether this frame may look beyond where the gripper is expected.  Raises a failed search's exception.

        ``then``: what is recorded of this frame, of which this is a replay.  A search that began in a recorded frame
        lasts as long as it did then; one that a replay of other images began keeps to the frames' clock.
        """
        self._seq, self._now_s, self._found = seq, now_s, None
        self._within, due_s, self._after_s = not self.live and then is None, now_s, RESULT_AFTER_S
        if then is not None:
            self._after_s = math.inf if then.searches else RESULT_AFTER_S
            due_s = math.inf if then.searches or then.searched_seq is not None else now_s  # one search at a time
        elif self.live:
            self._after_s = 0.0
        self.searches, self.searched_seq = False, None
        for found in self._backlog.results(due_s, waits=not self.live):
            self.searched_seq = self._of_seq
            if isinstance(found, Exception):
                raise found
            self._found = found
            self._kept = found, now_s
        kept, since_s = self._kept
        if kept and self._found is None and not self._untrusted and now_s - since_s <= self._hold_s:
            self._found = kept
        at_once = not self._searched and self._within
        if self._found is not None or len(self._backlog):
            return Patience(self._found is not None, self._found is not None, at_once)
        held = now_s - self._seen_s <= self._hold_s
        when_lost = held or self._untrusted % self._settings.patient_every == 0
        return Patience(self._credit >= 1.0, when_lost, at_once)

    def places(self, image: Image, expected: Expected, sought: Sought) -> Sequence[Expected]:
        """Places to follow in this frame: those found by an earlier frame's search, or by this one's if the gripper was
        just lost and frames may wait; else none, and a search starts with a copy of the image.
        """
        if self._found is not None:
            return self._found
        first, self._searched = not self._searched, True
        if sought.lost and first and self._within:
            return self._meter.searched(image, expected, sought)
        self.searches, self._of_seq, kept = True, self._seq, image.copy()
        self._backlog.add(lambda: self._meter.searched(kept, expected, sought), self._now_s, self._after_s)
        return ()

    def end_frame(self, measurement: Measurement) -> None:
        """Update the credit and the counters with the frame's measurement."""
        pays = measurement.looked_far and self._found is None
        earned = -1.0 if pays else 1.0 / self._settings.refill_frames
        self._credit = min(max(self._credit + earned, 0.0), float(self._settings.eager_frames))
        self._untrusted += 1
        if not measurement.looked_far:
            self._kept = (), 0.0
        if measurement.trusted:
            self._untrusted, self._searched, self._seen_s = 0, False, self._now_s


class Tracker:
    """Measures one gripper in one camera's frames, one after the other."""

    def __init__(self, camera: Camera, gripper: Gripper, settings: MonitorSettings, taught: TaughtEdges | None = None):
        self._gripper, self._settings = gripper, settings
        self._jaw = JawKnowledge(settings.jaw_sigma_m, settings.jaw_offset_sigma_m)
        self._meter = FingertipMeter(camera, gripper, settings.corners, self._jaw.report_sigma_m, taught)
        self.floor: Array = np.diag(np.square([settings.floor_m] * 3 + [settings.floor_rad] * 3))
        """(6, 6) covariance of the systematic error that no averaging removes, but for :meth:`floor_of`."""
        self.model_sigma_m = settings.model_sigma_m if taught is None else 0.0
        """Standard deviation of each finger's length in the model, m; 0 with taught edges, which include it."""
        self.taught_error: Array = np.zeros((0, 6)) if taught is None else taught.reference_error
        """(k, 6) error of the reference that taught edges have in them, by a standard deviation along k directions."""
        self.taught_offset: Array = np.zeros(6) if taught is None else taught.reference_offset
        """(6,) how far off that reference the gripper appeared in the teaching images."""
        self.taught_at = (None, (0.0,) * 6) if taught is None else (taught.at_reference, taught.play)
        """What was measured of the teaching images, if anything, and the mount's play (6,) between them, standard
        deviations, m and rad.
        """
        digest = "" if taught is None else taught.digest
        self.measured_as = digest, settings.corners, settings.measurement, settings.jaw_sigma_m
        """What a measured pose depends on besides gripper and camera; the taught edges by their digest."""
        self._jaw_opening_m = gripper.jaw_nominal_m  # as measured last
        self._usual_share = USUAL_SHARE
        self._shown_frames = np.ones(len(gripper.edge_ids))
        self._at_ends = edges_at_ends(gripper)
        # Separate meters, since they may run in parallel with a measurement.
        searcher = FingertipMeter(camera, gripper, settings.corners, self._jaw.report_sigma_m, taught)
        self.searching = GripperSearch(searcher, settings.corners.search, settings.policy.hold_s)
        self._finger_meter = FingerMeter(camera, gripper, settings.corners, self._jaw.report_sigma_m, taught)

    def measure(
        self,
        frame: Frame,
        cam_T_grip: Array,
        now_s: float,
        rivals: tuple[Array, ...] = (),
        then: Beside | None = None,
    ) -> Measurement:
        """Measure around ``cam_T_grip`` (4, 4), where the gripper is expected, and look further if clearly fewer edge
        points than usual are inliers: at the ``rivals`` (4, 4) first.  An opening that isn't reported is expected to
        be as measured last.  ``then``: see :meth:`GripperSearch.begin_frame`.
        """
        assert frame.image is not None
        patience = self.searching.begin_frame(frame.seq, now_s, then)
        measurement = self._meter.measure(
            frame.image,
            cam_T_grip,
            self._opening_m(frame),
            self._usual_share,
            patience,
            jaw_reported=frame.jaw_opening_m is not None,
            rivals=rivals,
            search=self.searching.places,
        )
        self.searching.end_frame(measurement)
        if measurement.trusted:
            self._jaw_opening_m = measurement.jaw_opening_m
        return measurement

    def _opening_m(self, frame: Frame) -> float:
        return self._jaw_opening_m if frame.jaw_opening_m is None else frame.jaw_opening_m

    def measure_held(self, frame: Frame, cam_T_grip: Array, sigma: Array) -> Measurement:
        """Measure only at ``cam_T_grip`` (4, 4), with the edges within its standard deviations (6,)."""
        assert frame.image is not None
        measurement = self._meter.measure_held(
            frame.image, cam_T_grip, sigma, self._opening_m(frame), self._usual_share
        )
        return self.with_known_jaw(measurement, frame.jaw_opening_m)

    def learn(self, measurement: Measurement, opening: bool, proven: bool) -> None:
        """Learn from a frame whose pose is believed: the usual inlier ratio, how often each edge shows, and, if the
        measured ``opening`` is believed as well, the error of the reported one.  ``proven``: the fingers' ends are seen
        in the gripper's place; else something may be in front of them, which is not to change how often they show.
        """
        share = measurement.consensus.share
        self._usual_share += USUAL_RATES[int(share > self._usual_share)] * (share - self._usual_share)
        edges = measurement.prediction.layout.edges
        edges = edges[~self._at_ends[edges] | proven]
        self._shown_frames[edges] = np.minimum(self._shown_frames[edges] + 1.0, SHOWN_FRAMES)
        shown = self._meter.shown.copy()  # a new array: a search may be using the old one
        shown[edges] += (measurement.consensus.edge_seen[edges] - shown[edges]) / self._shown_frames[edges]
        self._meter.shown = shown
        if opening and measurement.jaw_seen is not None:
            self._jaw.learn(measurement.jaw_seen)

    def ends(self, frame: Frame, measurement: Measurement) -> FingerEndsSeen:
        """Whether the fingers' ends are seen as ends; takes a quarter of a measurement's time."""
        assert frame.image is not None
        return self._meter.ends(frame.image, measurement)

    @property
    def finger_axis(self) -> Array:
        """(3,) the fingers' direction, gripper frame; zero if they have none."""
        return self._meter.finger_axis

    @property
    def along(self) -> NDArray[np.bool_]:
        """(e,) which edges run along the fingers."""
        return self._meter.along

    def with_known_jaw(self, measurement: Measurement, reported_m: float | None) -> Measurement:
        """The measurement, corrected by the reported opening's error as learnt from earlier frames."""
        if reported_m is None or not self._gripper.has_jaw:
            return measurement
        if self._jaw.exact:
            measurement.jaw_known_m, measurement.jaw_known_sigma_m = reported_m, 0.0
            return measurement
        fused = self._jaw.fuse(measurement.jaw_reported_m, measurement.jaw_opening_m, measurement.covariance)
        covariance = measurement.covariance.copy()
        covariance[:6, :6] = fused.covariance
        covariance[:6, 6] = covariance[6, :6] = covariance[:6, 6] * (fused.sigma_m**2 / covariance[6, 6])
        covariance[6, 6] = fused.sigma_m**2
        return replace(
            measurement,
            cam_T_grip=perturb(measurement.cam_T_grip, fused.xi),
            jaw_opening_m=min(max(fused.jaw_opening_m, self._gripper.jaw_min_m), self._gripper.jaw_max_m),
            covariance=covariance,
            jaw_known_m=fused.known_m,
            jaw_known_sigma_m=fused.known_sigma_m,
            jaw_seen=fused.seen,
            jaw_innovation=max(measurement.jaw_innovation, fused.innovation, key=abs),
        )

    def floor_of(self, measurement: Measurement) -> Array:
        """(6, 6) covariance of a measurement's systematic error: larger where the jaws are beyond the openings at which
        their motion is known.
        """
        beyond_m = self._gripper.beyond_m(measurement.jaw_opening_m)
        return self.floor + np.diag([beyond_m**2] * 3 + [0.0] * 3) if beyond_m else self.floor

    def update(self, measurement: Measurement) -> tuple[Array, Array]:
        """The corrected transform and its covariance: from all inlier edgels, or from the corners and equation (17)."""
        cam_T_grip, covariance = measurement.cam_T_grip, measurement.covariance[:6, :6]
        if self._settings.measurement == "edges":
            return cam_T_grip, covariance + self.floor_of(measurement)
        taken = self.taken(measurement)
        if np.count_nonzero(taken) >= 3:
            covariance_xy = measurement.corners.joint_covariance_xy(taken)
            try:
                update = self._corner_update(measurement, taken, covariance_xy, measurement.jaw_opening_m)
                cam_T_grip = perturb(measurement.prediction.cam_T_grip, update.xi)
                covariance = update.covariance
                if self._gripper.has_jaw:
                    # The corners assume the opening known: add its uncertainty's effect on the motion.
                    jaw_sigma_m = float(np.sqrt(measurement.covariance[6, 6]))
                    opened_m = measurement.jaw_opening_m + jaw_sigma_m
                    opened = self._corner_update(measurement, taken, covariance_xy, opened_m)
                    covariance = covariance + np.outer(opened.xi - update.xi, opened.xi - update.xi)
            except DegenerateGeometry:
                pass  # The remaining corners lie on a line: the edges still determine the motion.
        return cam_T_grip, covariance + self.floor_of(measurement)

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

    def taken(self, measurement: Measurement) -> NDArray[np.bool_]:
        """(c,) the usable corners that the configured variant uses."""
        return self._gripper.innermost_corners(measurement.corners.usable, CORNER_COUNTS[self._settings.update_corners])

    def evidence(self, frame: Frame, measurement: Measurement, ref_cam_T_grip: Array) -> EdgeEvidence:
        """The evidence of each finger by itself in a measured frame; takes several times as long as the measurement,
        and may run in another thread.
        """
        assert frame.image is not None
        reported = frame.jaw_opening_m is not None
        return self._finger_meter.evidence(frame.image, measurement, ref_cam_T_grip, jaw_reported=reported)
