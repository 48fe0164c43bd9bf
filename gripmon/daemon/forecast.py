"""The forecast of a configuration's view before there is any image, as ``gripmon check`` prints it."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.daemon.config import Config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.model.geometry import invert, make_transform, rotation_angle, rotation_from_xyzw
from gripmon.model.gripper import UNTOLD_BEVEL_M, Gripper
from gripmon.model.records import Protection
from gripmon.teach.accuracy import Accuracy, Vector, as_if_taught, forecast_frame, with_bevels
from gripmon.teach.inset import made_from_images
from gripmon.teach.jaw_travel import JawTravel, over_jaw
from gripmon.teach.kept import Kept, promise_of
from gripmon.teach.mounts import Mount
from gripmon.teach.visibility import FEWEST_CORNERS, Border, Freedom, Rig, border, freedom, see
from gripmon.track.edges.kernel import FEWEST_EDGES

__all__ = ["Forecast", "forecast", "limits_warning", "rig_of"]


class CameraValues(msgspec.Struct, frozen=True):
    """The lens and its field of view (rad)."""

    model: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    field_of_view_rad: tuple[float, float]


class GripperValues(msgspec.Struct, frozen=True):
    """The gripper file and its counts; ``jaw_m``: the jaw's travel, None without a jaw; ``apart_rate``: by how much two
    fingers move apart for each metre of opening, None for other numbers of fingers.
    """

    file: str
    name: str
    corners: int
    edges: int
    faces: int
    notes: tuple[str, ...]
    jaw_m: tuple[float, float] | None
    apart_rate: float | None = None


class ReferenceValues(msgspec.Struct, frozen=True):
    """The reference calibration, and values that reveal a mistake in it."""

    id: str
    translation_m: Vector
    rotation_xyzw: tuple[float, float, float, float]
    distance_m: float
    turn_rad: float
    metres_per_px: float
    tilt_rad: Annotated[float, Meta(description="of the optical axis against the fingers")]
    camera_ahead_m: Annotated[float, Meta(description="of the TCP, along the gripper's z axis")]
    sound_as_wxyz: Annotated[bool, Meta(description="read as w, x, y, z it would be behind the fingertips, in view")]


class FarthestEdge(msgspec.Struct, frozen=True):
    """The taught edge with the largest offset from the sharp model."""

    edge: str
    offset_m: float
    offset_px: float


class TaughtValues(msgspec.Struct, frozen=True):
    """The taught model."""

    file: str
    time: str
    images: int
    edges: tuple[str, ...]
    largest: FarthestEdge


class JawValues(msgspec.Struct, frozen=True):
    """The source of the jaw opening, and the opening of all predictions (m)."""

    source: str
    opening_m: float | None
    nominal: bool


class CornerView(msgspec.Struct, frozen=True):
    """A corner predicted by the calibration."""

    id: str
    uv_px: tuple[float, float] | None
    distance_m: float
    visible: bool
    reason: str | None


class EdgeView(msgspec.Struct, frozen=True):
    """Whether an edge is visible."""

    id: str
    visible: bool


class InView(msgspec.Struct, frozen=True):
    """What is visible, its distance from the image border, and how far camera and jaws may move."""

    corners: int
    edges: int
    corners_needed: int
    edges_needed: int
    enough: bool
    reason: str | None
    behind_another_finger: tuple[str, ...]
    border: Border | None
    camera_may_move: Freedom | None
    limit_m: float
    jaw_travel: JawTravel | None


class Forecast(msgspec.Struct, frozen=True):
    """The forecast of a configuration's view: metres, radians, px; positions in the camera frame.

    ``protection``: the protection level of one frame, which ``valid_by`` names: that of the motion ``since_reference``,
    before the reference's frames are averaged, or the ``absolute`` one; ``protection_if_bevelled``: the same if the
    gripper has bevels that are neither stated nor taught, null if that is excluded; ``promise`` says it beside the
    alert limits, ``needed``: those that this view could meet, if no transform of it can be valid; ``doubt``: why what
    is valid by its absolute error may be farther off, null if nothing says so.
    """

    config: str
    robot: str
    camera_name: str
    camera: CameraValues
    gripper: GripperValues
    reference: ReferenceValues
    taught: TaughtValues | None
    jaw: JawValues
    corners: tuple[CornerView, ...]
    edges: tuple[EdgeView, ...]
    accuracy: Accuracy
    valid_by: str
    protection: Protection | None
    since_reference: Protection | None
    absolute: Protection | None
    protection_if_bevelled: Protection | None
    alert_limit_m: float
    alert_limit_rad: float
    reachable: bool
    needed: str | None
    promise: str
    in_view: InView
    doubt: str | None


def forecast(config: Config) -> Forecast:
    """The forecast for a configuration, without network and source.

    A view that shows too little isn't an error: ``in_view.reason`` says what is missing, and values that need more are
    None.
    """
    settings, gripper, rig = config.settings, config.gripper, rig_of(config)
    policy, in_view = settings.monitor.policy, _in_view(config, rig)
    accuracy = forecast_frame(rig, config.cam_T_grip, config.jaw_opening_m, with_jaw=True)
    found = _promise_of(config, rig, accuracy) if in_view.enough else None
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
        reference=_reference(config, rig),
        taught=_taught(config),
        jaw=JawValues(settings.jaw.source, config.jaw_opening_m, settings.jaw.opening_m is None),
        corners=_corners(config),
        edges=tuple(map(EdgeView, gripper.edge_ids, config.view().edges_visible.tolist())),
        accuracy=accuracy,
        valid_by=policy.valid_by,
        protection=None if found is None else accuracy.by(policy.valid_by),
        since_reference=None if found is None else accuracy.since_reference,
        absolute=None if found is None else accuracy.absolute,
        protection_if_bevelled=None if found is None else _if_bevelled(config, rig),
        alert_limit_m=policy.alert_limit_m,
        alert_limit_rad=policy.alert_limit_rad,
        reachable=found is not None and found.reachable,
        needed=None if found is None or found.reachable else found.needed(),
        promise="nothing: too little is in view" if found is None else f"forecast: {found.promise()}",
        in_view=in_view,
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


def _promise_of(config: Config, rig: Rig, accuracy: Accuracy | None = None) -> Kept:
    return promise_of(rig, config.cam_T_grip, config.jaw_opening_m, accuracy)


def limits_warning(config: Config) -> str | None:
    """A warning if no transform of the configured view can be valid; None otherwise, also if too little is visible."""
    rig = rig_of(config)
    if not see(rig, config.cam_T_grip, config.jaw_opening_m).enough or (found := _promise_of(config, rig)).reachable:
        return None
    told = f"by the forecast no transform of this view can be valid: valid needs {found.needed()}"
    return "; ".join(filter(None, [f"{config.path}: {told} (monitor.policy)", found.help()]))


def _if_bevelled(config: Config, rig: Rig) -> Protection | None:
    """The protection level if no edge is sharp; None if edges are known as they appear, because they were taught or the
    gripper file was made from images, or if the file is stated to be exact.
    """
    if rig.taught is not None or made_from_images(rig.gripper) or rig.settings.model_sigma_m == 0.0:
        return None
    bevelled = rig._replace(gripper=with_bevels(rig.gripper, UNTOLD_BEVEL_M))
    return forecast_frame(bevelled, config.cam_T_grip, config.jaw_opening_m).by(rig.settings.policy.valid_by)


def _camera(config: Config) -> CameraValues:
    camera = config.camera
    across = 2.0 * math.atan(0.5 * camera.width_px / camera.fx_px)
    down = 2.0 * math.atan(0.5 * camera.height_px / camera.fy_px)
    model = type(config.settings.camera).__struct_config__.tag
    return CameraValues(str(model), camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, (across, down))


def _reference(config: Config, rig: Rig) -> ReferenceValues:
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
        sound_as_wxyz=_sound_as_wxyz(config, rig),
    )


def _sound_as_wxyz(config: Config, rig: Rig) -> bool:
    """Whether the reference's quaternion, read in the order w, x, y, z, puts the camera behind the fingertips with a
    view of them.
    """
    w, x, y, z = config.reference.cam_T_grip.rotation_xyzw
    cam_T_grip = make_transform(rotation_from_xyzw((x, y, z, w)), config.cam_T_grip[:3, 3])
    behind = float(invert(cam_T_grip)[2, 3]) < 0.0
    return behind and see(rig, cam_T_grip, config.jaw_opening_m).enough


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


def _in_view(config: Config, rig: Rig) -> InView:
    cam_T_grip, opening_m = config.cam_T_grip, config.jaw_opening_m
    sight = see(rig, cam_T_grip, opening_m)
    names = zip(rig.gripper.landmark_ids, sight.behind, strict=True)
    return InView(
        corners=sight.corners,
        edges=sight.edges,
        corners_needed=FEWEST_CORNERS,
        edges_needed=FEWEST_EDGES,
        enough=sight.enough,
        reason=sight.reason,
        behind_another_finger=tuple(name for name, behind in names if behind),
        border=border(rig, sight),
        camera_may_move=freedom(rig, cam_T_grip, opening_m) if sight.enough else None,
        limit_m=rig.settings.policy.limit_m,
        jaw_travel=over_jaw(rig, cam_T_grip),
    )
