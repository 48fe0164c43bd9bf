"""A grid of camera mounts, and what the monitor would see from each: before anyone drills a hole."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.judge.drift import DriftSettings, foresee
from gripmon.judge.recalibrate import refusal
from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array
from gripmon.monitor import CORNER_COUNTS
from gripmon.teach.accuracy import Foreseen, Promise, foresee_frame, promise
from gripmon.teach.visibility import Rig, Sight, border, moved_camera, see, sideways_m

OPENINGS = 25
"""Openings over the jaw's travel at which a mount's view is looked at."""

CLOSER_AT = 3
"""Openings over the jaw's travel at which accuracy and shifts are reckoned, beside the usual one."""


@dataclass(frozen=True, slots=True)
class Grid:
    """All combinations are tried.  ``rigs`` differ in their lens; ``towards`` (one for each): where the TCP shows."""

    distances_m: tuple[float, ...]
    tilts_rad: tuple[float, ...]
    sides_rad: tuple[float, ...]
    rolls_rad: tuple[float, ...]
    rigs: tuple[Rig, ...]
    towards: tuple[Array, ...]

    def __len__(self) -> int:
        axes = (self.distances_m, self.tilts_rad, self.sides_rad, self.rolls_rad, self.rigs)
        return int(np.prod([len(axis) for axis in axes]))

    def mounts(self) -> Iterator[tuple[Mount, int]]:
        """Mount and number of its lens."""
        for k, roll, side, tilt, distance in itertools.product(
            range(len(self.rigs)), self.rolls_rad, self.sides_rad, self.tilts_rad, self.distances_m
        ):
            yield Mount(distance, tilt, side, roll), k


class Fault(NamedTuple):
    """Why a mount would not work: ``kind`` in general, ``text`` with its numbers."""

    kind: str
    text: str


NOWHERE = "nowhere enough in view"
NOT_USUAL = "too little in view at the usual opening"
NOT_ALL = "too little in view in a part of the jaw's travel"
SHIFTED = "too little in view after a sideways shift that the policy allows"
INEXACT = "no transform would be valid: the bound on its error is above the alert limit"
NO_POSE = "its corners give no new pose past the limit"


@dataclass(frozen=True, slots=True)
class Trial:
    """What the monitor would see from one mount.

    ``sight`` at the usual opening.  ``corners``, ``edges`` (n,) at ``openings_m`` (n,), ``share`` of these openings at
    which the monitor can measure.  The rest is None unless it can at the usual opening: ``covariance`` (6, 6) of a
    frame, ``worst_sigma_m`` the standard deviation of the TCP along its least certain direction at the worst of some
    openings, ``worst_at_m``; ``promise`` the worst that a frame may promise at one of them; ``smallest`` (6,) steps
    that are noticed, ``delay_frames`` for a step of the TCP by the policy's ``warn_m`` along the worst axis (None: not
    noticed at all); ``margin_px`` of the visible corners from the border and ``shift_m`` that the camera may shift
    sideways until the monitor can't measure, at the usual opening.
    ``faults``: why this mount would not work; none if it would.
    """

    mount: Mount
    lens: int
    cam_T_grip: Array
    openings_m: Array
    corners: NDArray[np.intp]
    edges: NDArray[np.intp]
    share: float
    sight: Sight
    covariance: Array | None
    worst_sigma_m: float | None
    worst_at_m: float | None
    promise: Promise | None
    smallest: Array | None
    delay_frames: int | None
    margin_px: float | None
    shift_m: float | None
    lever_m: float | None
    faults: tuple[Fault, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why this mount would not work, the gravest first; none if it would."""
        return tuple(fault.text for fault in self.faults)

    @property
    def kind(self) -> str | None:
        """Of the gravest reason."""
        return self.faults[0].kind if self.faults else None

    @property
    def works(self) -> bool:
        return not self.faults

    @property
    def noticed_m(self) -> float:
        """The smallest step of the TCP that is noticed along every axis; infinite where nothing can be measured."""
        return float("inf") if self.smallest is None else float(self.smallest[:3].max())

    @property
    def rank(self) -> tuple[float, ...]:
        """Smaller is better: first what works, then what has more of the jaw's travel, then what notices more."""
        if self.works:
            return (0.0, 0.0, self.noticed_m)
        return (1.0, -self.share, self.noticed_m)


def try_mount(
    rig: Rig,
    mount: Mount,
    lens: int,
    cam_T_grip: Array,
    jaw_opening_m: float | None,
    travel_m: tuple[float, float] | None = None,
) -> Trial:
    """Look from one mount; ``jaw_opening_m`` is the usual one, None for a gripper without jaw.  ``travel_m``: the jaw's
    travel that counts, all of it if None.
    """
    gripper = rig.gripper
    usual_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    openings_m = np.array([usual_m])
    low_m, high_m = travel_m or (gripper.jaw_min_m, gripper.jaw_max_m)
    if high_m > low_m:
        openings_m = np.linspace(low_m, high_m, OPENINGS)
    sights = [see(rig, cam_T_grip, opening_m) for opening_m in openings_m.tolist()]
    sight = see(rig, cam_T_grip, usual_m)
    frame = nearest = smallest = delay = shift_m = None
    worst: _Worst | None = None
    if sight.enough:
        frame, nearest = foresee_frame(rig, cam_T_grip, usual_m), border(rig, sight)
        smallest, delay = _noticed(frame.covariance, rig.settings.drift, rig.settings.policy.warn_m)
        worst = _worst(rig, cam_T_grip, [o for o, _ in _closer(openings_m, sights)], (usual_m, frame))
        shift_m = sideways_m(rig, cam_T_grip, usual_m)
    return Trial(
        mount,
        lens,
        cam_T_grip,
        openings_m,
        np.array([s.corners for s in sights], dtype=np.intp),
        np.array([s.edges for s in sights], dtype=np.intp),
        float(np.mean([s.enough for s in sights])),
        sight,
        None if frame is None else frame.covariance,
        None if worst is None else worst.sigma_m,
        None if worst is None else worst.at_m,
        None if worst is None else worst.promise,
        smallest,
        delay,
        None if nearest is None else nearest.smallest_px,
        shift_m,
        None if frame is None else frame.lever_m,
        (
            *_blind(openings_m, sights, sight),
            *_shifted(rig, cam_T_grip, [(usual_m, sight), *_closer(openings_m, sights)]),
            *_inexact(rig, worst, frame),
        ),
    )


def tried(grid: Grid, jaw_opening_m: float | None, travel_m: tuple[float, float] | None = None) -> Iterator[Trial]:
    """Every mount of a grid, one after the other."""
    for mount, k in grid.mounts():
        yield try_mount(grid.rigs[k], mount, k, mount.cam_T_grip(grid.towards[k]), jaw_opening_m, travel_m)


def _noticed(covariance: Array, settings: DriftSettings, step_m: float) -> tuple[Array, int | None]:
    """Smallest steps (6,) that are noticed, and frames until one of ``step_m`` along the worst axis is."""
    foresight = foresee(covariance, settings)
    delays = [foresight.delay_frames(step_m, axis) for axis in range(3)]
    known = [d for d in delays if d is not None]
    return foresight.smallest, max(known) if len(known) == len(delays) else None


def _closer(openings_m: Array, sights: list[Sight]) -> list[tuple[float, Sight]]:
    """Some openings from end to end at which the monitor can measure."""
    chosen = np.linspace(0, len(openings_m) - 1, CLOSER_AT).round().astype(int).tolist() if len(openings_m) > 1 else []
    return [(float(openings_m[k]), sights[k]) for k in chosen if sights[k].enough]


class _Worst(NamedTuple):
    """Largest standard deviation of the TCP in any direction and at which opening; what the usual one promises."""

    sigma_m: float
    at_m: float
    promise: Promise
    promise_at_m: float


def _worst(rig: Rig, cam_T_grip: Array, openings_m: list[float], usual: tuple[float, Foreseen]) -> _Worst:
    """Over the usual and some more openings."""
    each = [usual, *((m, foresee_frame(rig, cam_T_grip, m)) for m in openings_m)]
    sigma_m, at_m = max((float(np.sqrt(np.linalg.eigvalsh(f.covariance[:3, :3])[-1])), o) for o, f in each)
    opening_m, frame = usual
    return _Worst(sigma_m, at_m, promise(frame.protection, rig.settings.policy), opening_m)


def _blind(openings_m: Array, sights: list[Sight], sight: Sight) -> tuple[Fault, ...]:
    """At which openings too little is seen."""
    failed = [k for k, s in enumerate(sights) if not s.enough]
    if len(failed) == len(sights) and sight.reason is not None:
        return (Fault(NOWHERE, f"nowhere enough to measure: {sight.reason}"),)
    faults = [] if sight.reason is None else [Fault(NOT_USUAL, f"at the usual opening {sight.reason}")]
    if failed:
        first_mm, last_mm = 1e3 * openings_m[failed[0]], 1e3 * openings_m[failed[-1]]
        what = "some of " if failed[-1] - failed[0] >= len(failed) else ""
        where = f"{what}{first_mm:.1f} to {last_mm:.1f} mm" if len(failed) > 1 else f"{first_mm:.1f} mm"
        faults.append(Fault(NOT_ALL, f"at {where} of opening {sights[failed[len(failed) // 2]].reason}"))
    return tuple(faults)


def _shifted(rig: Rig, cam_T_grip: Array, openings: list[tuple[float, Sight]]) -> tuple[Fault, ...]:
    """Whether a camera that has shifted sideways by the policy's limit, either way, sees too little."""
    limit_m = rig.settings.policy.limit_m
    for way in (*np.eye(6)[:2], *-np.eye(6)[:2]):
        moved = moved_camera(cam_T_grip, limit_m * way)
        for opening_m, sight in openings:
            if sight.enough and (there := see(rig, moved, opening_m)).reason is not None:
                where = f"by {1e3 * limit_m:g} mm, at {1e3 * opening_m:.1f} mm of opening"
                return (Fault(SHIFTED, f"after a sideways shift of the camera {where}, {there.reason}"),)
    return ()


def _inexact(rig: Rig, worst: _Worst | None, frame: Foreseen | None) -> tuple[Fault, ...]:
    """Whether what is measured would never be valid, or leave no way back past the limit."""
    if worst is None or frame is None:
        return ()
    faults, settings = [], rig.settings
    if not worst.promise.reachable:
        where = f" at {1e3 * worst.promise_at_m:.1f} mm of opening" if rig.gripper.has_jaw else ""
        bound_mm = 1e3 * worst.promise.protection.position_m
        faults.append(
            Fault(INEXACT, f"bound on the TCP's error {bound_mm:.2g} mm{where}: needs {worst.promise.needed}")
        )
    if settings.recalibration.mode != "off":
        taken = rig.gripper.innermost_corners(frame.usable, CORNER_COUNTS[settings.recalibrate_corners])
        points_m = rig.gripper.points_grip_m(None)[rig.gripper.corner_points][taken]
        if (why := refusal(points_m)) is not None:
            faults.append(Fault(NO_POSE, f"no new pose past the limit: {why}"))
    return tuple(faults)


_UPRIGHT = 1e-6


class Mount(NamedTuple):
    """Where a camera is against the gripper.

    ``distance_m`` from the camera's centre to the TCP.  ``tilt_rad`` (0 to pi) between the camera's optical axis and
    the gripper's z axis: 0 looks along the fingers.  ``side_rad``: on which side of the gripper the camera sits,
    counted about the gripper's z axis: 0 at -y, +pi/2 at +x; without tilt it has no meaning and is 0.  ``roll_rad``
    about the optical axis: by how much the picture is turned clockwise.

    The rotation is ``cam_R_grip = Rz(roll) Rx(tilt) Rz(-side)``.
    """

    distance_m: float
    tilt_rad: float
    side_rad: float
    roll_rad: float

    @classmethod
    def of(cls, cam_T_grip: Array) -> Mount:
        """The mount that a pose (4, 4) is; what it leaves out is where in the image the TCP shows."""
        rotation = cam_T_grip[:3, :3]
        tilt = math.atan2(math.hypot(rotation[2, 0], rotation[2, 1]), rotation[2, 2])
        if math.sin(tilt) < _UPRIGHT:
            side, roll = 0.0, math.atan2(rotation[1, 0], rotation[0, 0])
        else:
            roll, tilt, turn = Rotation.from_matrix(rotation).as_euler("ZXZ")
            side = -turn
        return cls(float(np.linalg.norm(cam_T_grip[:3, 3])), float(tilt), float(side), float(roll))

    def cam_T_grip(self, towards: Array) -> Array:
        """The pose (4, 4) with the TCP in the direction ``towards`` (3,) of the camera frame."""
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
    """The same sensor behind a lens of another focal length, without distortion: that of a lens nobody has calibrated
    isn't known.  (A fisheye stays one: its ideal form has all coefficients zero.)  At the focal length that the camera
    has it is the calibrated lens.  ValueError for a focal length that can't be meant.
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
    """The angle that the image's middle row spans, with the lens's distortion; NaN where the lens ends before."""
    row = 0.5 * (camera.height_px - 1.0)
    ends = camera.undistort(np.array([[0.0, row], [camera.width_px - 1.0, row]]))
    left, right = np.column_stack([ends, np.ones(2)])
    return math.atan2(float(np.linalg.norm(np.cross(left, right))), float(left @ right))
