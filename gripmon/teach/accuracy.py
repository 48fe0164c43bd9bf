"""Accuracy forecast: how certain a frame's transform will be, what the view can't separate, which bounds hold.

The monitor's own measurement and update run on edge points where the model predicts them, each with the same assumed
standard deviation.  The result follows from the geometry, without any image; it is what ``gripmon check``, its sweep
and the teaching page show and write as it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, structs

from gripmon.judge.drift import CORRELATION_FRAMES, foresee
from gripmon.judge.recalibrate import coplanar, refusal
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image, Protection, ValidBy
from gripmon.monitor import CORNER_COUNTS, Tracker, foresee_bounds
from gripmon.teach.visibility import Rig, samples_behind
from gripmon.track.edges import FingertipMeter, Measurement, Patience
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

_STEPS_M = (5e-5, 1e-4, 5e-4)
"""Of the TCP, for which the drift test's delay is given."""

_DIRECTIONS = (
    "a shift along x", "a shift along y", "the distance (z)", "a tilt about x", "a tilt about y", "a roll about z",
)  # fmt: skip

Vector = tuple[float, float, float]


class PoseValues(msgspec.Struct, frozen=True):
    """Six numbers about a pose: the TCP's position in camera axes (m) and the rotation about them (rad)."""

    tcp_m: Vector
    rotation_rad: Vector

    @classmethod
    def of(cls, values: Array) -> PoseValues:
        """From an array (6,)."""
        return msgspec.convert({"tcp_m": values[:3].tolist(), "rotation_rad": values[3:].tolist()}, cls)

    @property
    def array(self) -> Array:
        """As an array (6,)."""
        return np.array([*self.tcp_m, *self.rotation_rad])


class UnknownJaw(PoseValues, frozen=True):
    """Standard deviations if the jaw opening were unknown, the seventh unknown of the fit (m, rad)."""

    jaw_m: float


class JawAccuracy(msgspec.Struct, frozen=True):
    """The uncertainty of the reported opening, and how well the image alone determines it.

    ``pose_per_jaw_m``: error of the pose per metre of error of an opening that is taken as exact, and what that is most
    ``like``.  ``correlation``, 0 to 1, of an unknown opening with the pose's least certain direction: near 1 the image
    can't separate them.
    """

    reported_sigma_m: float
    unknown: UnknownJaw
    pose_per_jaw_m: PoseValues
    like: str
    correlation: float
    growth: Annotated[float, Meta(description="how many times less certain the pose is without the opening")]


class DriftForecast(msgspec.Struct, frozen=True):
    """The smallest step that the drift test detects, and its delay in frames for other steps."""

    false_alarms_per_day: float
    frames_per_s: float
    correlation_frames: float
    smallest: PoseValues
    delay_frames: Annotated[
        dict[str, tuple[int | None, int | None, int | None]],
        Meta(description="by the size of the TCP's step (m): along x, y, z; null: never"),
    ]


class RecalibrationForecast(msgspec.Struct, frozen=True):
    """Whether the visible corners determine a pose by themselves, and the uncertainty of one frame (m): an average over
    frames with lasting errors is hardly more certain.
    """

    corners: int
    coplanar: bool
    possible: bool
    reason: str | None
    sigma_m: float | None
    sure_sigma_m: float
    mode: str


class Accuracy(msgspec.Struct, frozen=True):
    """What is expected of a frame that measures all visible edges; None if too few of them are visible.

    ``tcp_sigma_m``: of the TCP along its least certain direction; ``since_reference`` and ``absolute``: both protection
    levels in front of clutter; ``jaw``: the effect of an unknown opening, also None without a jaw or where not asked
    for.
    """

    measurement: str
    edges: int
    edges_needed: int
    corners: Annotated[int, Meta(description="those in view with two edges that are long enough and not parallel")]
    edge_point_sigma_px: float
    recalibration: RecalibrationForecast
    expected: Annotated[PoseValues | None, Meta(description="standard deviations")] = None
    weakest: (
        Annotated[PoseValues, Meta(description="the least certain direction, one standard deviation long")] | None
    ) = None
    jaw: JawAccuracy | None = None
    drift: DriftForecast | None = None
    tcp_sigma_m: float | None = None
    since_reference: Protection | None = None
    absolute: Protection | None = None

    @property
    def enough(self) -> bool:
        """Whether anything can be measured at all."""
        return self.edges >= self.edges_needed

    def by(self, valid_by: ValidBy) -> Protection | None:
        """The protection level that a setting names."""
        return self.since_reference if valid_by is ValidBy.REFERENCE else self.absolute


def forecast_frame(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None, *, with_jaw: bool = False) -> Accuracy:
    """What is expected of a frame at a pose (4, 4) and a reported opening (nominal if None); ``with_jaw``: with an
    unknown opening, too.
    """
    gripper, settings = rig.gripper, rig.settings
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = ForecastMeter(rig.camera, gripper, settings.corners, settings.jaw_sigma_m, rig.taught)
    tracker = Tracker(rig.camera, gripper, settings, rig.taught)
    given = meter.forecast(cam_T_grip, opening_m, jaw_reported=True)
    covariance = tracker.update(given)[1]
    edges = np.bincount(given.prediction.layout.edge[given.candidates.sample], minlength=1) >= FEWEST_SAMPLES
    enough = int(np.count_nonzero(edges)) >= FEWEST_EDGES
    sigma = np.sqrt(covariance.diagonal())
    found = Accuracy(
        measurement=settings.measurement,
        edges=int(np.count_nonzero(edges)),
        edges_needed=FEWEST_EDGES,
        corners=int(np.count_nonzero(given.corners.usable)),
        edge_point_sigma_px=EDGE_POINT_SIGMA_PX,
        recalibration=_recalibration(rig, given, opening_m, float(max(sigma[:3])) if enough else None),
    )
    if not enough:
        return found
    levers_m = gripper.points_grip_m(opening_m if gripper.has_jaw else None)[gripper.landmarks]
    lever_m, jaw = float(np.sqrt((levers_m**2).sum(axis=1).mean())), None
    if with_jaw and gripper.has_jaw:
        free = meter.forecast(cam_T_grip, opening_m, jaw_reported=False)
        jaw = _jaw_accuracy(tracker.update(free)[1], free.covariance, lever_m, settings.jaw_sigma_m)
    both = foresee_bounds(tracker, gripper, settings, given)
    return structs.replace(
        found,
        expected=PoseValues.of(sigma),
        weakest=PoseValues.of(weakest_direction(covariance, lever_m)),
        jaw=jaw,
        drift=_drift(rig, covariance),
        tcp_sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        since_reference=both.since_reference,
        absolute=both.absolute,
    )


def _drift(rig: Rig, covariance: Array) -> DriftForecast:
    settings = rig.settings.drift
    detectable = foresee(covariance, settings)
    steps_m = sorted({*_STEPS_M, rig.settings.policy.warn_m})
    return DriftForecast(
        settings.false_alarms_per_day,
        settings.frames_per_s,
        CORRELATION_FRAMES,
        PoseValues.of(detectable.smallest),
        {f"{m:g}": (*(detectable.delay_frames(m, axis) for axis in range(3)),) for m in steps_m},  # type: ignore[misc]
    )


def _recalibration(rig: Rig, given: Measurement, opening_m: float, sigma_m: float | None) -> RecalibrationForecast:
    gripper, settings = rig.gripper, rig.settings
    taken = gripper.innermost_corners(given.corners.usable, CORNER_COUNTS[settings.recalibrate_corners])
    points_grip_m = gripper.points_grip_m(opening_m if gripper.has_jaw else None)[gripper.corner_points][taken]
    reason = refusal(points_grip_m)
    return RecalibrationForecast(
        corners=len(points_grip_m),
        coplanar=bool(len(points_grip_m) >= 3 and coplanar(points_grip_m)),
        possible=reason is None,
        reason=reason,
        sigma_m=sigma_m,
        sure_sigma_m=settings.recalibration.sure_sigma_m,
        mode=settings.recalibration.mode,
    )


def _jaw_accuracy(pose_covariance: Array, covariance: Array, lever_m: float, reported_sigma_m: float) -> JawAccuracy:
    """``covariance`` (7, 7) is that of the fit, ``pose_covariance`` (6, 6) as it would be published; a radian counts as
    ``lever_m``.
    """
    weakest, scale = weakest_direction(covariance[:6, :6], lever_m), np.array([1.0] * 3 + [lever_m] * 3)
    # Its length is one standard deviation; projecting on it twice cancels the scale.
    with_jaw = float((scale**2 * weakest) @ covariance[:6, 6]) / float((scale * weakest) @ (scale * weakest))
    jaw_sigma_m = float(np.sqrt(covariance[6, 6]))
    pose_per_jaw, correlation = covariance[:6, 6] / covariance[6, 6], abs(with_jaw) / jaw_sigma_m
    unknown = PoseValues.of(np.sqrt(pose_covariance.diagonal()))
    return JawAccuracy(
        reported_sigma_m=reported_sigma_m,
        unknown=UnknownJaw(unknown.tcp_m, unknown.rotation_rad, jaw_sigma_m),
        pose_per_jaw_m=PoseValues.of(pose_per_jaw),
        like=_DIRECTIONS[int(np.abs(pose_per_jaw * scale).argmax())],
        correlation=correlation,
        growth=float(1.0 / np.sqrt(max(1.0 - correlation**2, 1e-12))),
    )


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
        return scatters._replace(covariance=np.linalg.inv(normal), line_weight=consensus.weight)
