"""The forecast of a configuration's view before there is any image, as ``gripmon check`` prints it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from gripmon.daemon.config import Config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.daemon.forecast_values import (
    Accuracy,
    CameraValues,
    CornerView,
    DriftForecast,
    EdgeView,
    FarthestEdge,
    Forecast,
    GripperValues,
    InView,
    JawAccuracy,
    JawTravelForecast,
    JawValues,
    OpeningCertainty,
    PoseValues,
    RecalibrationForecast,
    ReferenceValues,
    TaughtValues,
    UnknownJaw,
)
from gripmon.judge.drift import CORRELATION_FRAMES, foresee
from gripmon.judge.recalibrate import coplanar, refusal
from gripmon.model.geometry import invert, make_transform, rotation_angle, rotation_from_xyzw
from gripmon.model.gripper import UNTOLD_BEVEL_M, Gripper
from gripmon.model.records import Protection
from gripmon.monitor import CORNER_COUNTS
from gripmon.teach.accuracy import (
    EDGE_POINT_SIGMA_PX,
    AccuracyForecast,
    Promise,
    UnknownOpening,
    accuracy_over_jaw,
    as_if_measured,
    as_if_taught,
    forecast_accuracy,
    forecast_frame,
    with_bevels,
)
from gripmon.teach.inset import made_from_images
from gripmon.teach.mounts import Mount
from gripmon.teach.visibility import (
    FEWEST_CORNERS,
    Rig,
    border,
    freedom,
    over_jaw,
    see,
)
from gripmon.track.edges.kernel import FEWEST_EDGES

__all__ = ["Forecast", "forecast", "limits_warning", "promise_of", "rig_of"]

_DIRECTIONS = (
    "a shift along x", "a shift along y", "the distance (z)", "a tilt about x", "a tilt about y", "a roll about z",
)  # fmt: skip
_STEPS_M = (5e-5, 1e-4, 5e-4)  # of the TCP, for which the delay is given


def forecast(config: Config) -> Forecast:
    """The forecast for a configuration, without network and source.

    A view that shows too little isn't an error: ``in_view.reason`` says what is missing, and values that need more are
    None.
    """
    settings, gripper, found = config.settings, config.gripper, promise_of(config)
    both = None if found is None else forecast_frame(rig_of(config), config.cam_T_grip, config.jaw_opening_m).bounds
    policy = settings.monitor.policy
    return Forecast(
        config=str(config.path),
        robot=settings.robot,
        camera_name=settings.camera_name,
        camera=_camera(config),
        gripper=GripperValues(
            file=str(config.gripper_path),
            name=gripper.name,
            corners=len(gripper.corner_ids),
            edges=len(gripper.edge_ids),
            faces=len(gripper.faces),
            notes=tuple(gripper.notes),
            jaw_m=(gripper.jaw_min_m, gripper.jaw_max_m) if gripper.has_jaw else None,
            apart_rate=_apart_rate(gripper),
        ),
        reference=_reference(config),
        taught=_taught(config),
        jaw=JawValues(settings.jaw.source, config.jaw_opening_m, settings.jaw.opening_m is None),
        corners=_corners(config),
        edges=tuple(map(EdgeView, gripper.edge_ids, config.view().edges_visible.tolist())),
        accuracy=_accuracy(config),
        valid_by=policy.valid_by,
        protection=None if found is None else found.protection,
        since_reference=None if both is None else both.since_reference,
        absolute=None if both is None else both.absolute,
        protection_if_bevelled=None if found is None else _if_bevelled(config),
        alert_limit_m=policy.alert_limit_m,
        alert_limit_rad=policy.alert_limit_rad,
        reachable=found is not None and found.reachable,
        needed=None if found is None or found.reachable else found.needed,
        promise="nothing: too little is in view" if found is None else found.text(),
        in_view=_in_view(config),
        doubt=reference_doubt(settings),
    )


def _apart_rate(gripper: Gripper) -> float | None:
    if not gripper.has_jaw or len(gripper.finger_ids) != 2:
        return None
    places_m, moves = gripper.points_grip_m(), gripper.point_motion(gripper.jaw_nominal_m)
    (one_m, one), (other_m, other) = (
        (places_m[own].mean(axis=0), moves[own][0]) for own in (gripper.point_finger == k for k in range(2))
    )
    return float((other - one) @ (other_m - one_m) / np.linalg.norm(other_m - one_m))


def rig_of(config: Config) -> Rig:
    """Camera, gripper and settings of the configuration."""
    return Rig(config.camera, config.gripper, config.settings.monitor, config.taught_edges)


def rig_once_taught(config: Config) -> Rig:
    """As :func:`rig_of`; edges that aren't taught yet are treated as if they were."""
    rig = rig_of(config)
    return rig._replace(gripper=as_if_taught(rig.gripper)) if rig.taught is None else rig


def promise_of(config: Config) -> Promise | None:
    """The promised accuracy at the configured pose and opening; None if too little is visible for a measurement."""
    rig, cam_T_grip, opening_m = rig_of(config), config.cam_T_grip, config.jaw_opening_m
    if not see(rig, cam_T_grip, opening_m).enough:
        return None
    policy = config.settings.monitor.policy
    found = Promise.of(forecast_frame(rig, cam_T_grip, opening_m).protection, policy)
    if found.reachable:
        return found
    remedies = [
        words
        for words, known in as_if_measured(rig).items()
        if Promise.of(forecast_frame(known, cam_T_grip, opening_m).protection, policy).reachable
    ]
    return replace(found, remedies=tuple(remedies))


def limits_warning(config: Config) -> str | None:
    """A warning if no transform of the configured view can be valid; None otherwise."""
    found = promise_of(config)
    if found is None or found.reachable:
        return None
    told = f"by the forecast no transform of this view can be valid: valid needs {found.needed}"
    return f"{config.path}: {told} (monitor.policy)"


def _if_bevelled(config: Config) -> Protection | None:
    """The protection level if no edge is sharp; None if edges are known as they appear, because they were taught or the
    gripper file was made from images, or if the file is stated to be exact.
    """
    rig = rig_of(config)
    if rig.taught is not None or made_from_images(rig.gripper) or rig.settings.model_sigma_m == 0.0:
        return None
    bevelled = rig._replace(gripper=with_bevels(rig.gripper, UNTOLD_BEVEL_M))
    return forecast_frame(bevelled, config.cam_T_grip, config.jaw_opening_m).protection


def _camera(config: Config) -> CameraValues:
    camera = config.camera
    across = 2.0 * math.atan(0.5 * camera.width_px / camera.fx_px)
    down = 2.0 * math.atan(0.5 * camera.height_px / camera.fy_px)
    model = type(config.settings.camera).__struct_config__.tag
    return CameraValues(str(model), camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, (across, down))


def _reference(config: Config) -> ReferenceValues:
    reference, cam_T_grip = config.reference, config.cam_T_grip
    return ReferenceValues(
        id=reference.reference_id,
        translation_m=reference.cam_T_grip.translation_m,
        rotation_xyzw=reference.cam_T_grip.rotation_xyzw,
        distance_m=float(np.linalg.norm(cam_T_grip[:3, 3])),
        turn_rad=rotation_angle(cam_T_grip[:3, :3]),
        metres_per_px=float(cam_T_grip[2, 3]) / config.camera.fx_px,
        tilt_rad=Mount.of(cam_T_grip).tilt_rad,
        camera_ahead_m=float(invert(cam_T_grip)[2, 3]),
        sound_as_wxyz=_sound_as_wxyz(config),
    )


def _sound_as_wxyz(config: Config) -> bool:
    """Whether the reference's quaternion, read in the order w, x, y, z, puts the camera behind the fingertips with a
    view of them.
    """
    w, x, y, z = config.reference.cam_T_grip.rotation_xyzw
    cam_T_grip = make_transform(rotation_from_xyzw((x, y, z, w)), config.cam_T_grip[:3, 3])
    behind = float(invert(cam_T_grip)[2, 3]) < 0.0
    return behind and see(rig_of(config), cam_T_grip, config.jaw_opening_m).enough


def _taught(config: Config) -> TaughtValues | None:
    taught = config.taught
    if taught is None:
        return None
    edge = max(taught.edges, key=lambda name: max(map(abs, taught.edges[name].offset_m)))
    offset_m = max(taught.edges[edge].offset_m, key=abs)
    largest = FarthestEdge(edge, offset_m, offset_m * config.camera.fx_px / float(config.cam_T_grip[2, 3]))
    made = taught.provenance
    return TaughtValues(str(config.taught_path), made.time, len(made.images), tuple(taught.edges), largest)


def _corners(config: Config) -> tuple[CornerView, ...]:
    view = config.view()
    return tuple(
        CornerView(
            id=name,
            uv_px=tuple(uv.round(2).tolist()) if np.isfinite(uv).all() else None,
            distance_m=round(float(np.linalg.norm(point)), 6),
            visible=bool(visible),
            reason=None if visible else "outside" if not inside else "self_hidden",
        )
        for name, uv, point, visible, inside in zip(
            config.gripper.landmark_ids, view.corners_px, view.corners_cam_m, view.visible, view.in_image, strict=True
        )
    )


def _accuracy(config: Config) -> Accuracy:
    settings = config.settings.monitor
    expected = forecast_accuracy(
        config.camera, config.gripper, settings, config.reference, config.jaw_opening_m, config.taught_edges
    )
    enough, jaw = expected.enough, expected.jaw
    return Accuracy(
        measurement=settings.measurement,
        edges=expected.edges,
        edges_needed=FEWEST_EDGES,
        corners=int(np.count_nonzero(expected.corners)),
        edge_point_sigma_px=EDGE_POINT_SIGMA_PX,
        recalibration=_recalibration(config, expected),
        expected=PoseValues.of(expected.sigma) if enough else None,
        weakest=PoseValues.of(expected.weakest) if enough else None,
        jaw=None if jaw is None or not enough else _jaw_accuracy(jaw, expected.lever_m, settings.jaw_sigma_m),
        drift=_drift(config, expected) if enough else None,
    )


def _jaw_accuracy(jaw: UnknownOpening, lever_m: float, reported_sigma_m: float) -> JawAccuracy:
    per_m = [abs(v) * (1.0 if k < 3 else lever_m) for k, v in enumerate(jaw.pose_per_m.tolist())]
    unknown = PoseValues.of(jaw.sigma)
    return JawAccuracy(
        reported_sigma_m=reported_sigma_m,
        unknown=UnknownJaw(unknown.tcp_m, unknown.rotation_rad, jaw.sigma_m),
        pose_per_jaw_m=PoseValues.of(jaw.pose_per_m),
        like=_DIRECTIONS[per_m.index(max(per_m))],
        correlation=float(jaw.correlation),
        growth=jaw.growth,
    )


def _drift(config: Config, expected: AccuracyForecast) -> DriftForecast:
    settings = config.settings.monitor.drift
    detectable = foresee(expected.covariance, settings)
    delays: Any = {f"{m:g}": tuple(detectable.delay_frames(m, axis) for axis in range(3)) for m in _STEPS_M}
    return DriftForecast(
        settings.false_alarms_per_day,
        settings.frames_per_s,
        CORRELATION_FRAMES,
        PoseValues.of(detectable.smallest),
        delays,
    )


def _recalibration(config: Config, expected: AccuracyForecast) -> RecalibrationForecast:
    """Judged by one frame: an average over frames with lasting errors is hardly more certain."""
    gripper, settings = config.gripper, config.settings.monitor
    taken = gripper.innermost_corners(expected.corners, CORNER_COUNTS[settings.recalibrate_corners])
    points_grip_m = gripper.points_grip_m(config.jaw_opening_m)[gripper.corner_points][taken]
    reason = refusal(points_grip_m)
    return RecalibrationForecast(
        corners=len(points_grip_m),
        coplanar=bool(len(points_grip_m) >= 3 and coplanar(points_grip_m)),
        possible=reason is None,
        reason=reason,
        sigma_m=float(max(expected.sigma[:3])) if expected.enough else None,
        sure_sigma_m=settings.recalibration.sure_sigma_m,
        mode=settings.recalibration.mode,
    )


def _in_view(config: Config) -> InView:
    rig, cam_T_grip = rig_of(config), config.cam_T_grip
    sight = see(rig, cam_T_grip, config.jaw_opening_m)
    return InView(
        corners=sight.corners,
        edges=sight.edges,
        corners_needed=FEWEST_CORNERS,
        edges_needed=FEWEST_EDGES,
        enough=sight.enough,
        reason=sight.reason,
        behind_another_finger=tuple(
            name for name, behind in zip(rig.gripper.landmark_ids, sight.behind, strict=True) if behind
        ),
        border=border(rig, sight),
        camera_may_move=freedom(rig, cam_T_grip, config.jaw_opening_m) if sight.enough else None,
        limit_m=config.settings.monitor.policy.limit_m,
        jaw_travel=_jaw_travel(config, rig),
    )


def _jaw_travel(config: Config, rig: Rig) -> JawTravelForecast | None:
    travel = over_jaw(rig, config.cam_T_grip)
    if travel is None:
        return None
    certain = accuracy_over_jaw(rig, config.cam_T_grip)
    policy = config.settings.monitor.policy
    bounds = [None if each is None else each.protection for _, each in certain]
    return JawTravelForecast(
        share=travel.share,
        gaps=travel.gaps,
        corners=(int(travel.corners.min()), int(travel.corners.max())),
        edges=(int(travel.edges.min()), int(travel.edges.max())),
        from_m=config.gripper.jaw_min_m,
        to_m=config.gripper.jaw_max_m,
        certainty=OpeningCertainty(
            opening_m=tuple(opening_m for opening_m, _ in certain),
            worst_sigma_m=tuple(None if each is None else each.tcp_sigma_m for _, each in certain),
            protection_m=tuple(None if b is None else b.position_m for b in bounds),
            protection_rad=tuple(None if b is None else b.rotation_rad for b in bounds),
            alert_limit_m=policy.alert_limit_m,
            alert_limit_rad=policy.alert_limit_rad,
        ),
    )
