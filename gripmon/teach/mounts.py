"""Camera mounts, described by numbers that can be set up with a drill (distance, tilt, side, roll), and what the
monitor would see from each mount of a grid: before a hole is drilled.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import make_transform, to_record
from gripmon.model.records import Array, Transform
from gripmon.teach.accuracy import Accuracy, forecast_frame
from gripmon.teach.kept import Kept, foreseen
from gripmon.teach.visibility import LandmarkView, Rig, border, moved_camera, see, sideways_m

OPENINGS = 25
"""Number of openings over the jaw's travel at which a mount's view is checked."""

ACCURACY_OPENINGS = 3
"""Number of these at which accuracy and shifts are computed, besides the usual opening."""


class Mount(msgspec.Struct, frozen=True):
    """Pose of a camera against the gripper, except for where in the image the TCP is.

    ``distance_m`` from the camera's centre to the TCP.  ``tilt_rad`` (0 to pi) between the camera's optical axis and
    the gripper's z axis: 0 looks along the fingers.  ``side_rad``: the side of the gripper on which the camera is,
    counted about the gripper's z axis: 0 at -y, +pi/2 at +x; without tilt it has no meaning and is 0.  ``roll_rad``
    about the optical axis: the angle by which the picture is turned clockwise.

    The rotation is ``cam_R_grip = Rz(roll) Rx(tilt) Rz(-side)``.
    """

    distance_m: float
    tilt_rad: float
    side_rad: float
    roll_rad: float

    @classmethod
    def of(cls, cam_T_grip: Array) -> Mount:
        """The mount of a pose (4, 4); it doesn't include where in the image the TCP is."""
        rotation = cam_T_grip[:3, :3]
        tilt = math.atan2(math.hypot(rotation[2, 0], rotation[2, 1]), rotation[2, 2])
        if math.sin(tilt) < 1e-6:
            side, roll = 0.0, math.atan2(rotation[1, 0], rotation[0, 0])
        else:
            from scipy.spatial.transform import Rotation

            roll, tilt, turn = Rotation.from_matrix(rotation).as_euler("ZXZ")
            side = -turn
        return cls(float(np.linalg.norm(cam_T_grip[:3, 3])), float(tilt), float(side), float(roll))

    def pose(self, towards: Array) -> Array:
        """``cam_T_grip`` (4, 4) with the TCP in the direction ``towards`` (3,) of the camera frame."""
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_euler("ZXZ", [self.roll_rad, self.tilt_rad, -self.side_rad]).as_matrix()
        return make_transform(rotation, self.distance_m * towards / np.linalg.norm(towards))


def towards(camera: Camera, uv_px: tuple[float, float]) -> Array:
    """Direction (3,) in the camera frame of an image point.  ValueError where the lens maps nothing."""
    xy = camera.undistort(np.array([uv_px], dtype=float))[0]
    if not np.isfinite(xy).all():
        raise ValueError(f"({uv_px[0]:g}, {uv_px[1]:g}) px: the lens maps nothing there; a point of the image")
    direction = np.array([xy[0], xy[1], 1.0])
    return np.asarray(direction / np.linalg.norm(direction))


def with_focal(camera: Camera, focal_px: float) -> Camera:
    """The same sensor behind a lens of another focal length, without distortion, since that of an uncalibrated lens is
    unknown.  (A fisheye lens remains one: in its ideal form all coefficients are zero.)  At the camera's own focal
    length it is the calibrated lens.  ValueError for an impossible focal length.
    """
    settings = camera.settings
    if math.isclose(focal_px, settings.fx_px, rel_tol=1e-9):
        return camera
    changes: dict[str, object] = {"fx_px": focal_px, "fy_px": focal_px * settings.fy_px / settings.fx_px}
    match settings:
        case PaperLens():
            changes["kappa_per_px2"] = 0.0
        case BrownConradyLens() | FisheyeLens():
            changes["coefficients"] = (0.0, 0.0, 0.0, 0.0)
    other: LensSettings = msgspec.structs.replace(settings, **changes)
    return make_camera(other)


def field_of_view_rad(camera: Camera) -> float:
    """The angle that the image's middle row spans, with the lens's distortion; NaN where the lens doesn't reach it."""
    row = 0.5 * (camera.height_px - 1.0)
    ends = camera.undistort(np.array([[0.0, row], [camera.width_px - 1.0, row]]))
    left, right = np.column_stack([ends, np.ones(2)])
    return math.atan2(float(np.linalg.norm(np.cross(left, right))), float(left @ right))


class Fault(msgspec.Struct, frozen=True):
    """Why a mount would not work: ``kind`` without numbers, ``text`` with them."""

    kind: str
    text: str


class OverJaw(msgspec.Struct, frozen=True):
    """What is seen at openings: ``corners`` and ``edges`` at each, and the ``share`` of them at which the monitor can
    measure.
    """

    opening_m: tuple[float, ...]
    corners: tuple[int, ...]
    edges: tuple[int, ...]
    share: float


class Trial(Mount, frozen=True):
    """What the monitor would see from one mount, with one lens; ``faults``: why it would not work, the most serious
    first, empty if it would.

    At the usual opening unless stated otherwise: ``accuracy`` of one frame (None: too little is in view), and what it
    ``promises``; ``worst_sigma_m``: standard deviation of the TCP along its least certain direction, the largest over
    some openings, found at ``worst_at_m``; ``delay_frames`` to detect a step of the TCP by the policy's ``warn_m``
    along the worst axis (None: never); ``margin_px`` of the visible corners to the border; ``shift_m``: sideways shift
    of the camera up to which the monitor can measure, None for any.
    """

    image_px: tuple[int, int]
    focal_px: float
    field_of_view_rad: float | None
    cam_T_grip: Transform
    works: bool
    faults: tuple[Fault, ...]
    jaw: OverJaw
    accuracy: Accuracy | None = None
    promises: Kept | None = None
    worst_sigma_m: float | None = None
    worst_at_m: float | None = None
    delay_frames: int | None = None
    margin_px: float | None = None
    shift_m: float | None = None

    @property
    def noticed_m(self) -> float:
        """The smallest step of the TCP that is detected along every axis; infinite where nothing can be measured."""
        drift = None if self.accuracy is None else self.accuracy.drift
        return math.inf if drift is None else max(drift.smallest.tcp_m)

    @property
    def rank(self) -> tuple[float, ...]:
        """Sort key, smaller is better: first mounts that work, then more of the jaw's travel, then smaller steps."""
        return (0.0, 0.0, self.noticed_m) if self.works else (1.0, -self.jaw.share, self.noticed_m)


def try_mount(
    rig: Rig,
    mount: Mount,
    cam_T_grip: Array,
    jaw_opening_m: float | None,
    travel_m: tuple[float, float] | None = None,
) -> Trial:
    """The view from one mount.  ``jaw_opening_m`` is the usual one, None for a gripper without jaw; ``travel_m``: the
    part of the jaw's travel that counts, all if None.
    """
    gripper, camera = rig.gripper, rig.camera
    usual_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    low_m, high_m = travel_m or (gripper.jaw_min_m, gripper.jaw_max_m)
    openings_m, chosen = [usual_m], []
    if high_m > low_m:
        openings_m = np.linspace(low_m, high_m, OPENINGS).tolist()
        chosen = np.linspace(0, OPENINGS - 1, ACCURACY_OPENINGS).round().astype(int).tolist()
    sights = [see(rig, cam_T_grip, opening_m) for opening_m in openings_m]
    sight = see(rig, cam_T_grip, usual_m)
    some_m = [openings_m[k] for k in chosen if sights[k].enough]
    angle = field_of_view_rad(camera)
    trial = Trial(
        **msgspec.structs.asdict(mount),
        image_px=(camera.width_px, camera.height_px),
        focal_px=camera.fx_px,
        field_of_view_rad=None if math.isnan(angle) else angle,
        cam_T_grip=to_record(cam_T_grip),
        works=False,
        faults=(
            *_too_little_in_view(openings_m, sights, sight),
            *_after_a_shift(rig, cam_T_grip, [usual_m] * sight.enough + some_m),
        ),
        jaw=OverJaw(
            tuple(openings_m),
            tuple(s.corners for s in sights),
            tuple(s.edges for s in sights),
            float(np.mean([s.enough for s in sights])),
        ),
    )
    if sight.enough:
        trial = _measured(rig, trial, cam_T_grip, usual_m, sight, some_m)
    return msgspec.structs.replace(trial, works=not trial.faults)


def _measured(
    rig: Rig, trial: Trial, cam_T_grip: Array, usual_m: float, sight: LandmarkView, openings_m: list[float]
) -> Trial:
    """The same with what a frame shows; with the worst standard deviation over the usual opening and ``openings_m``."""
    frame, nearest = forecast_frame(rig, cam_T_grip, usual_m), border(rig, sight)
    assert nearest is not None and frame.drift is not None, "enough in view has corners in view"
    each = [(usual_m, frame), *((m, forecast_frame(rig, cam_T_grip, m)) for m in openings_m)]
    sigma_m, at_m = max((f.tcp_sigma_m or 0.0, m) for m, f in each)
    delays = frame.drift.delay_frames[f"{rig.settings.policy.warn_m:g}"]
    known = [delay for delay in delays if delay is not None]
    promises, shift_m = foreseen(frame, rig), sideways_m(rig, cam_T_grip, usual_m)
    return msgspec.structs.replace(
        trial,
        faults=(*trial.faults, *_inexact(rig, frame, promises, usual_m)),
        accuracy=frame,
        promises=promises,
        worst_sigma_m=sigma_m,
        worst_at_m=at_m,
        delay_frames=max(known) if len(known) == len(delays) else None,
        margin_px=nearest.smallest_px,
        shift_m=None if math.isinf(shift_m) else shift_m,
    )


def _too_little_in_view(openings_m: list[float], sights: list[LandmarkView], sight: LandmarkView) -> tuple[Fault, ...]:
    failed = [k for k, s in enumerate(sights) if not s.enough]
    if len(failed) == len(sights) and sight.reason is not None:
        return (Fault("nowhere enough in view", f"nowhere enough to measure: {sight.reason}"),)
    faults = []
    if sight.reason is not None:
        faults.append(Fault("too little in view at the usual opening", f"at the usual opening {sight.reason}"))
    if failed:
        first_mm, last_mm = 1e3 * openings_m[failed[0]], 1e3 * openings_m[failed[-1]]
        what = "some of " if failed[-1] - failed[0] >= len(failed) else ""
        where = f"{what}{first_mm:.1f} to {last_mm:.1f} mm" if len(failed) > 1 else f"{first_mm:.1f} mm"
        text = f"at {where} of opening {sights[failed[len(failed) // 2]].reason}"
        faults.append(Fault("too little in view in a part of the jaw's travel", text))
    return tuple(faults)


def _after_a_shift(rig: Rig, cam_T_grip: Array, openings_m: list[float]) -> tuple[Fault, ...]:
    """Whether a camera shifted sideways by the policy's limit, in any direction along an axis, sees too little."""
    limit_m = rig.settings.policy.limit_m
    for axis in (*np.eye(6)[:2], *-np.eye(6)[:2]):
        moved = moved_camera(cam_T_grip, limit_m * axis)
        for opening_m in openings_m:
            if (reason := see(rig, moved, opening_m).reason) is not None:
                where = f"by {1e3 * limit_m:g} mm, at {1e3 * opening_m:.1f} mm of opening"
                kind = "too little in view after a sideways shift that the policy allows"
                return (Fault(kind, f"after a sideways shift of the camera {where}, {reason}"),)
    return ()


def _inexact(rig: Rig, frame: Accuracy, promises: Kept, usual_m: float) -> tuple[Fault, ...]:
    """Whether no measured transform would be valid, or recalibration past the limit would be impossible."""
    faults, new_pose = [], frame.recalibration
    if not promises.reachable:
        where = f" at {1e3 * usual_m:.1f} mm of opening" if rig.gripper.has_jaw else ""
        kind = "no transform would be valid: the bound on its error is above the alert limit"
        faults.append(Fault(kind, f"{promises.text()}{where}: needs {promises.needed()}"))
    if new_pose.mode != "off" and new_pose.reason is not None:
        text = f"no new pose past the limit: {new_pose.reason}"
        faults.append(Fault("its corners give no new pose past the limit", text))
    return tuple(faults)
