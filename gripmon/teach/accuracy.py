"""Accuracy forecast: how certain a frame's transform will be, what the view can't separate, which alert limits hold.

The monitor's own measurement and update run on edge points where the model predicts them, each with the same assumed
standard deviation.  The result is the covariance that follows from the geometry, without any image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from gripmon.judge.policy import PolicySettings
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record, invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image, Protection, ReferenceRecord, ValidBy
from gripmon.model.units import in_degrees, in_mm
from gripmon.monitor import Bounds, MonitorSettings, Tracker, foresee_bounds
from gripmon.teach.visibility import Rig, samples_behind, see
from gripmon.track.edges import FingertipMeter, Measurement, Patience, TaughtEdges
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import FEWEST_SAMPLES, Prediction
from gripmon.track.edges.profiles import Candidates, Edgels, weigh
from gripmon.track.edges.robust_fit import RobustFit, Uncertainty, assess

EDGE_POINT_SIGMA_PX = 0.05
"""Assumed error of an edge point, besides the floors in the settings: that of a step of 40 grey levels in noise of 1.5.
"""

CLUTTER_PX = 0.1
"""Assumed shift of a stretch of an edge by the background, in addition, for the protection level.  It gives the bound
of the usual frame in front of clutter; one frame in twenty has up to four times as much (tools/bench integrity).
"""


@dataclass(frozen=True, slots=True)
class UnknownOpening:
    """The effect of an unknown jaw opening, the seventh unknown of the fit.

    ``sigma`` (6,) of the pose and ``sigma_m`` of the opening when the robot doesn't report it.  ``pose_per_m`` (6,):
    error of the pose per metre of error of an opening that is taken as exact.  ``correlation``, 0 to 1, of an unknown
    opening with the pose's least certain direction: near 1 the image can't separate them.
    """

    sigma: Array
    sigma_m: float
    pose_per_m: Array
    correlation: float

    @property
    def growth(self) -> float:
        """Factor by which the least certain direction is less certain than with an exactly known opening."""
        return float(1.0 / np.sqrt(max(1.0 - self.correlation**2, 1e-12)))


@dataclass(frozen=True, slots=True)
class AccuracyForecast:
    """Expected accuracy of a frame that measures all visible edges; vectors are (position, rotation), m and rad.

    ``covariance`` (6, 6) as it would be published.  ``edges``: number that can be sampled; with fewer than
    ``FEWEST_EDGES`` nothing will be measured.  ``corners`` (c,): which can be measured.  ``lever_m``: root mean square
    distance of the gripper's corners from the TCP, by which a rotation of one radian moves them.  ``bounds``: both
    protection levels in front of clutter, and ``protection`` the one that makes a transform valid.  ``jaw``: the effect
    of an unknown opening; None for a gripper without jaw, or
    where not asked for.
    """

    covariance: Array
    edges: int
    corners: NDArray[np.bool_]
    lever_m: float
    bounds: Bounds
    protection: Protection
    jaw: UnknownOpening | None

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,)."""
        return np.asarray(np.sqrt(self.covariance.diagonal()))

    @property
    def weakest(self) -> Array:
        """One standard deviation (6,) along the least certain direction, a radian counting as ``lever_m``."""
        return weakest_direction(self.covariance, self.lever_m)

    @property
    def tcp_sigma_m(self) -> float:
        """Standard deviation of the TCP along its least certain direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def enough(self) -> bool:
        """Whether anything can be measured at all."""
        return self.edges >= FEWEST_EDGES


def forecast_accuracy(
    camera: Camera,
    gripper: Gripper,
    settings: MonitorSettings,
    reference: ReferenceRecord,
    jaw_opening_m: float | None,
    taught: TaughtEdges | None = None,
) -> AccuracyForecast:
    """Expected accuracy of a frame at the reference's pose and an opening (nominal if None)."""
    rig = Rig(camera, gripper, settings, taught)
    return forecast_frame(rig, from_record(reference.cam_T_grip), jaw_opening_m, with_jaw=gripper.has_jaw)


def forecast_frame(
    rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None, *, with_jaw: bool = False
) -> AccuracyForecast:
    """Expected accuracy of a frame at a pose and a reported opening (nominal if None); ``with_jaw``: with an unknown
    opening, too.
    """
    gripper, settings = rig.gripper, rig.settings
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = ForecastMeter(rig.camera, gripper, settings.corners, settings.jaw_sigma_m, rig.taught)
    tracker = Tracker(rig.camera, gripper, settings, rig.taught)
    given = meter.forecast(cam_T_grip, opening_m, jaw_reported=True)
    covariance = tracker.update(given)[1]
    levers_m = gripper.points_grip_m(opening_m if gripper.has_jaw else None)[gripper.landmarks]
    lever_m = float(np.sqrt((levers_m**2).sum(axis=1).mean()))
    jaw = None
    if with_jaw:
        free = meter.forecast(cam_T_grip, opening_m, jaw_reported=False)
        jaw = _unknown_opening(tracker.update(free)[1], free.covariance, lever_m)
    seen = np.bincount(given.prediction.layout.edge[given.candidates.sample], minlength=1) >= FEWEST_SAMPLES
    both = foresee_bounds(tracker, gripper, settings, given)
    protection, edges = both.by(settings.policy.valid_by), int(np.count_nonzero(seen))
    return AccuracyForecast(covariance, edges, given.corners.usable, lever_m, both, protection, jaw)


def accuracy_over_jaw(rig: Rig, cam_T_grip: Array, count: int = 13) -> list[tuple[float, AccuracyForecast | None]]:
    """The expected accuracy at ``count`` openings (m) over the jaw's travel; None where too little is visible."""
    openings_m = np.linspace(rig.gripper.jaw_min_m, rig.gripper.jaw_max_m, count).tolist()
    return [(m, forecast_frame(rig, cam_T_grip, m) if see(rig, cam_T_grip, m).enough else None) for m in openings_m]


def with_bevels(gripper: Gripper, least_m: float) -> Gripper:
    """The same gripper with all edges bevelled or rounded by at least ``least_m``."""
    edges = {n: structs.replace(edge, bevel_m=max(edge.bevel_m, least_m)) for n, edge in gripper.model.edges.items()}
    return Gripper(structs.replace(gripper.model, edges=edges))


def as_if_taught(gripper: Gripper) -> Gripper:
    """The same gripper with the bevels of its straight edges known, as teaching leaves it; curved ones stay."""
    model = gripper.model
    edges = {n: edge if edge.via else structs.replace(edge, bevel_m=0.0) for n, edge in model.edges.items()}
    return Gripper(structs.replace(model, edges=edges))


def as_if_measured(rig: Rig) -> dict[str, Rig]:
    """Variants of the rig, each with one more quantity known that a person can measure; the key describes it."""
    model, taught = rig.gripper.model, rig.taught
    known = {}
    if taught is None:
        known["its bevels taught (gripmon teach)"] = rig._replace(gripper=as_if_taught(rig.gripper))
    elif len(taught.reference_error) or taught.reference_offset.any():
        exact = replace(taught, reference_error=np.zeros((0, 6)), reference_offset=np.zeros(6))
        known["a reference known better (its sigmas: gripmon calibrate plane)"] = rig._replace(taught=exact)
    if model.scale_sigma:
        exact_size = Gripper(structs.replace(model, scale_sigma=0.0))
        size = "its size measured better (a length, a plate: scale_sigma in the gripper file says how well)"
        known[size] = rig._replace(gripper=exact_size)
    if model.tilt_sigma_rad:
        exact_tilt = Gripper(structs.replace(model, tilt_sigma_rad=0.0))
        tilt = "its tilt measured better (a second opening, a plate: tilt_sigma_rad in the gripper file)"
        known[tilt] = rig._replace(gripper=exact_tilt)
    return known


def weakest_direction(covariance: Array, lever_m: float) -> Array:
    """One standard deviation (6,) along the least certain direction of a covariance (6, 6), a radian counting as
    ``lever_m``.
    """
    scale = np.array([1.0] * 3 + [lever_m] * 3)
    variances, directions = np.linalg.eigh(covariance * np.outer(scale, scale))
    weakest = directions[:, -1] * np.sqrt(variances[-1]) / scale
    return np.asarray(weakest * (1.0 if weakest[np.abs(weakest * scale).argmax()] > 0.0 else -1.0))


def _unknown_opening(pose_covariance: Array, covariance: Array, lever_m: float) -> UnknownOpening:
    """``covariance`` (7, 7) is that of the fit, ``pose_covariance`` (6, 6) as it would be published."""
    weakest = weakest_direction(covariance[:6, :6], lever_m)
    scale = np.array([1.0] * 3 + [lever_m] * 3)
    # Its length is one standard deviation; projecting on it twice cancels the scale.
    with_jaw = float((scale**2 * weakest) @ covariance[:6, 6]) / float((scale * weakest) @ (scale * weakest))
    variance = float(covariance[6, 6])
    sigma_m = float(np.sqrt(variance))
    return UnknownOpening(
        np.sqrt(pose_covariance.diagonal()), sigma_m, covariance[:6, 6] / variance, abs(with_jaw) / sigma_m
    )


class ForecastMeter(FingertipMeter):
    """Measures without an image: assumes an edge point, at its predicted position, on every search line that no other
    finger hides.
    """

    def forecast(self, cam_T_grip: Array, jaw_opening_m: float, jaw_reported: bool) -> Measurement:
        """The measurement from edge points alone at a pose and an opening."""
        nothing = np.zeros((1, 1), np.uint8)
        here = Patience(when_doubtful=False, when_lost=False)
        return self.measure(nothing, cam_T_grip, jaw_opening_m, 1.0, here, jaw_reported)

    def _look(self, image: Image, prediction: Prediction) -> Edgels:
        gripper, eye_grip_m = self._gripper, invert(prediction.cam_T_grip)[:3, 3]
        points_grip_m = gripper.points_grip_m(prediction.jaw_opening_m)
        hidden = samples_behind(gripper, prediction.layout, points_grip_m, eye_grip_m)
        sample = np.flatnonzero(prediction.ok & ~hidden)
        zero, one = np.zeros(len(sample)), np.ones(len(sample))
        # Steps of 40 grey levels of 255 in noise of 1.5, in focus.
        step = np.where(self._polarity[prediction.layout.edge[sample]] < 0, -40.0, 40.0)
        candidates = Candidates(sample, zero, step, EDGE_POINT_SIGMA_PX * one, one, zero, 1.5, 255.0)
        return weigh(candidates, prediction, self._polarity, self._settings.consensus)

    def _assess(self, edgels: Edgels, consensus: RobustFit) -> Uncertainty:
        """Uses the assumed errors: there is no scatter here."""
        scatters = assess(edgels, consensus, self._prior, CLUTTER_PX)
        normal = consensus.information + np.diag(self._prior)
        return replace(scatters, covariance=np.linalg.inv(normal), line_weight=consensus.weight)


@dataclass(frozen=True, slots=True)
class Promise:
    """``protection`` of a transform for which all visible edges are measured, and the alert limits to compare it with:
    whether transforms of a view can be valid, before there is any image.  ``remedies``: if they can't, what would make
    them valid, each by itself.
    """

    protection: Protection
    alert_limit_m: float
    alert_limit_rad: float
    valid_by: ValidBy = ValidBy.ABSOLUTE
    remedies: tuple[str, ...] = ()

    @classmethod
    def of(cls, protection: Protection, policy: PolicySettings) -> Promise:
        return cls(protection, policy.alert_limit_m, policy.alert_limit_rad, policy.valid_by)

    @property
    def reachable(self) -> bool:
        """Whether a transform of this view can be valid."""
        return self.excess <= 1.0

    @property
    def excess(self) -> float:
        """The larger of both bounds over its limit: above 1, no transform can be valid."""
        bound = self.protection
        return max(bound.position_m / self.alert_limit_m, bound.rotation_rad / self.alert_limit_rad)

    @property
    def needed(self) -> str:
        """Remedies, or the alert limits that this view can keep, where the present ones are too tight; else empty."""
        bound, parts = self.protection, []
        if not (math.isfinite(bound.position_m) and math.isfinite(bound.rotation_rad)):
            return "more of the fingers in view: no limit would do"
        if bound.position_m > self.alert_limit_m:
            needed_m = rounded_up(bound.position_m)
            parts.append(f"alert_limit_m of at least {needed_m:g} ({1e3 * needed_m:g} mm)")
        if bound.rotation_rad > self.alert_limit_rad:
            needed_rad = rounded_up(bound.rotation_rad)
            parts.append(f"alert_limit_rad of at least {needed_rad:g} ({in_degrees(needed_rad)} degrees)")
        return ", or ".join([*self.remedies, " and ".join(parts)])

    @property
    def subject(self) -> str:
        """What the bound is of, in words."""
        return "the motion since the reference" if self.valid_by is ValidBy.REFERENCE else "a transform"

    def text(self) -> str:
        """One line for a person."""
        bound = self.protection
        good = f"good to {in_mm(bound.position_m)} mm and {in_degrees(bound.rotation_rad)} degrees"
        limits = f"{1e3 * self.alert_limit_m:g} mm, {in_degrees(self.alert_limit_rad)} degrees"
        reached = "reachable" if self.reachable else f"NOT reachable: valid needs {self.needed}"
        promise = (
            f"{self.subject} of this view is {good} (risk {bound.risk:g} a frame); alert limit {limits}: {reached}"
        )
        return f"forecast: {promise}"


def rounded_up(value: float) -> float:
    """Round up to two significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit
