"""What a calibration may expect: how certain a frame's transform will be, and what the view can't tell apart.

The monitor's own measurement and update are run on edge points where the model puts them, each with the same assumed
standard deviation: what comes out is the covariance that the geometry gives, without any image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record, invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image, Protection, ReferenceRecord
from gripmon.monitor import MonitorSettings, Tracker, foresee_protection
from gripmon.teach.forecast.visibility import FEWEST_EDGES, FEWEST_SAMPLES, Rig, samples_behind
from gripmon.track.edges import FingertipMeter, Measurement, Patience, TaughtEdges
from gripmon.track.edges.consensus import Consensus
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import Candidates, Votes
from gripmon.track.edges.uncertainty import Uncertainty, assess

EDGE_POINT_SIGMA_PX = 0.05
"""Assumed of every edge point, beside the floors in the settings: steps of 40 grey levels in noise of 1.5 give it."""

CLUTTER_PX = 0.1
"""What the background is assumed to shift a stretch of an edge by, beside that, for the protection level: with it the
bound is that of the usual frame before clutter; one in twenty has up to four times as much (tools/bench integrity).
"""

_STEP, _NOISE, _FULL_SCALE = 40.0, 1.5, 255.0


@dataclass(frozen=True, slots=True)
class JawOutlook:
    """What an unknown opening does, the seventh unknown of the fit.

    ``sigma`` (6,) of the pose and ``sigma_m`` of the opening when nobody reports it.  ``pose_per_m`` (6,): by how much
    the pose is wrong for each metre by which an opening that is taken as exact is wrong.  ``correlation`` of the
    opening with the pose's weakest direction when it is unknown, 0 to 1: near 1 the image can't separate them.
    """

    sigma: Array
    sigma_m: float
    pose_per_m: Array
    correlation: float

    @property
    def growth(self) -> float:
        """By what factor the weakest direction is less certain than with an exactly known opening."""
        return float(1.0 / np.sqrt(max(1.0 - self.correlation**2, 1e-12)))


@dataclass(frozen=True, slots=True)
class Outlook:
    """Expected of one frame in which all visible edges are seen; vectors are (position, rotation), m and rad.

    ``covariance`` (6, 6) as it would be published; ``weakest`` (6,) one standard deviation along its least certain
    direction, rotations counted by how far they move the fingertips.  ``edges``: how many can be sampled; with fewer
    than ``FEWEST_EDGES`` nothing will be measured.  ``jaw`` is None for a gripper without one; ``protection``: the
    level before clutter.
    """

    covariance: Array
    weakest: Array
    edges: int
    corners: NDArray[np.bool_]
    lever_m: float
    jaw: JawOutlook | None
    protection: Protection

    @property
    def sigma(self) -> Array:
        """(6,) standard deviations."""
        return np.asarray(np.sqrt(self.covariance.diagonal()))

    @property
    def enough(self) -> bool:
        """Whether anything can be measured at all."""
        return self.edges >= FEWEST_EDGES


def expect(
    camera: Camera,
    gripper: Gripper,
    settings: MonitorSettings,
    reference: ReferenceRecord,
    jaw_opening_m: float | None,
    taught: TaughtEdges | None = None,
) -> Outlook:
    """What a frame at the reference's pose and an opening (nominal if None) may tell."""
    tracker = Tracker(camera, gripper, settings, taught)
    cam_T_grip = from_record(reference.cam_T_grip)
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = ForeseeingMeter(camera, gripper, settings.corners, settings.jaw_sigma_m, taught)
    given = meter.foresee(cam_T_grip, opening_m, jaw_reported=True)
    covariance = tracker.update(given)[1]
    lever_m = _lever_m(given.prediction)
    jaw = None
    if gripper.has_jaw:
        free = meter.foresee(cam_T_grip, opening_m, jaw_reported=False)
        jaw = _jaw_outlook(tracker.update(free)[1], free.covariance, lever_m)
    edges, corners = _edges_seen(given), given.corners.usable
    protection = foresee_protection(tracker, gripper, settings, given)
    return Outlook(covariance, weakest_direction(covariance, lever_m), edges, corners, lever_m, jaw, protection)


class Foreseen(NamedTuple):
    """Of one frame with a reported opening: ``covariance`` (6, 6) as it would be published, ``usable`` (c,) corners,
    the lever, m, by which a turn counts, and the ``protection`` level before clutter.
    """

    covariance: Array
    usable: NDArray[np.bool_]
    lever_m: float
    protection: Protection


def foresee_frame(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> Foreseen:
    """What a frame at a pose and an opening (nominal if None) gives; only where the view suffices."""
    gripper, settings = rig.gripper, rig.settings
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = ForeseeingMeter(rig.camera, gripper, settings.corners, settings.jaw_sigma_m, rig.taught)
    measurement = meter.foresee(cam_T_grip, opening_m, jaw_reported=True)
    tracker = Tracker(rig.camera, gripper, settings, rig.taught)
    covariance = tracker.update(measurement)[1]
    protection = foresee_protection(tracker, gripper, settings, measurement)
    return Foreseen(covariance, measurement.corners.usable, _lever_m(measurement.prediction), protection)


def weakest_direction(covariance: Array, lever_m: float) -> Array:
    """(6,) one standard deviation along the least certain direction of a covariance (6, 6), a radian counting as
    ``lever_m``.
    """
    scale = np.array([1.0] * 3 + [lever_m] * 3)
    variances, directions = np.linalg.eigh(covariance * np.outer(scale, scale))
    weakest = directions[:, -1] * np.sqrt(variances[-1]) / scale
    return np.asarray(weakest * (1.0 if weakest[np.abs(weakest * scale).argmax()] > 0.0 else -1.0))


def _jaw_outlook(pose_covariance: Array, covariance: Array, lever_m: float) -> JawOutlook:
    """``covariance`` (7, 7) of the fit itself, ``pose_covariance`` (6, 6) as it would be published."""
    weakest = weakest_direction(covariance[:6, :6], lever_m)
    scale = np.array([1.0] * 3 + [lever_m] * 3)
    # Its length is one standard deviation, so that projecting on it twice takes the scale out.
    with_jaw = float((scale**2 * weakest) @ covariance[:6, 6]) / float((scale * weakest) @ (scale * weakest))
    variance = float(covariance[6, 6])
    return JawOutlook(
        np.sqrt(pose_covariance.diagonal()),
        float(np.sqrt(variance)),
        covariance[:6, 6] / variance,
        abs(with_jaw) / np.sqrt(variance),
    )


def _edges_seen(measurement: Measurement) -> int:
    """Edges of which enough samples are seen."""
    edge = measurement.prediction.layout.edge[measurement.candidates.sample]
    return int(np.count_nonzero(np.bincount(edge, minlength=1) >= FEWEST_SAMPLES))


def _lever_m(prediction: Prediction) -> float:
    """Root mean square distance of the gripper's corners from the TCP: how far a turn by one radian moves them."""
    levers_m = prediction.corners.cam_m - prediction.cam_T_grip[:3, 3]
    return float(np.sqrt((levers_m**2).sum(axis=1).mean()))


class ForeseeingMeter(FingertipMeter):
    """Looks at no image: finds an edge point on every profile that no other finger hides, where it was predicted."""

    def foresee(self, cam_T_grip: Array, jaw_opening_m: float, jaw_reported: bool) -> Measurement:
        """What the edge points alone give at a pose and an opening."""
        nothing = np.zeros((1, 1), np.uint8)
        here = Patience(when_doubtful=False, when_lost=False)
        return self.measure(nothing, cam_T_grip, jaw_opening_m, 1.0, here, jaw_reported)

    def _look(self, image: Image, prediction: Prediction) -> Votes:
        gripper, eye_grip_m = self._gripper, invert(prediction.cam_T_grip)[:3, 3]
        points_grip_m = gripper.points_grip_m(prediction.jaw_opening_m)
        hidden = samples_behind(gripper, prediction.layout, points_grip_m, eye_grip_m)
        sample = np.flatnonzero(prediction.ok & ~hidden)
        polarity = self._polarity
        step = np.where(polarity[prediction.layout.edge[sample]] < 0, -_STEP, _STEP)
        sigma_px, width_px = np.full(len(sample), EDGE_POINT_SIGMA_PX), np.ones(len(sample))
        whole = np.zeros(len(sample))
        candidates = Candidates(sample, np.zeros(len(sample)), step, sigma_px, width_px, whole, _NOISE, _FULL_SCALE)
        return self._votes(candidates, prediction)

    def _assess(self, votes: Votes, consensus: Consensus) -> Uncertainty:
        """As assumed: nothing scatters here."""
        scatters = assess(votes, consensus, self._prior, CLUTTER_PX)
        normal = consensus.information + np.diag(self._prior)
        return replace(scatters, covariance=np.linalg.inv(normal), line_weight=consensus.weight)
