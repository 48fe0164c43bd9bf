"""Which corners and edges of the gripper a camera sees from a pose, as the monitor will search for them, and why others
are not seen.

In addition to the monitor's own rule (a face must be turned to the camera), this finds fingers in front of each other:
the monitor will search for a hidden edge, and see the other finger.  It also gives margins: the distance of visible
corners from the image's border, how far the camera may move until too few of them are in view, and the part of the
jaw's travel in which the view suffices.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import exp_rotation, invert, make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.monitor import MonitorSettings
from gripmon.track.edges import TaughtEdges
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import BORDER_PX, FEWEST_SAMPLES, EdgeLayout, inside_px, lay_out

FEWEST_CORNERS = 3
"""Fewest visible corners; a configuration with fewer is refused."""

TOUCHING_M = 1e-4
"""Distance behind another finger's face below which a point lies on the face."""


class Rig(NamedTuple):
    """A camera, a gripper, and the monitor's settings: everything but the pose between camera and gripper."""

    camera: Camera
    gripper: Gripper
    settings: MonitorSettings
    taught: TaughtEdges | None = None


@dataclass(frozen=True, slots=True)
class LandmarkView:
    """The view from one pose at one jaw opening: arrays (c,) over the gripper's landmarks, which are its corners if it
    has any.

    ``uv_px`` (c, 2), NaN where the lens maps nothing.  Each corner is ``outside`` of the image, ``self_hidden`` by its
    own finger, or ``behind`` another one, the first that applies, or else ``visible``.  ``edges``: the number that can
    be sampled.
    """

    uv_px: Array
    outside: NDArray[np.bool_]
    self_hidden: NDArray[np.bool_]
    behind: NDArray[np.bool_]
    edges: int

    @property
    def visible(self) -> NDArray[np.bool_]:
        return ~(self.outside | self.self_hidden | self.behind)

    @property
    def corners(self) -> int:
        return int(np.count_nonzero(self.visible))

    @property
    def enough(self) -> bool:
        """Whether the monitor can measure from here."""
        return self.corners >= FEWEST_CORNERS and self.edges >= FEWEST_EDGES

    @property
    def reason(self) -> str | None:
        """Why the monitor can't measure from here; None if it can."""
        if self.corners < FEWEST_CORNERS:
            counts = {
                "outside of the image": self.outside,
                "hidden by their own finger": self.self_hidden,
                "behind another finger": self.behind,
            }
            parts = [f"{np.count_nonzero(n)} {text}" for text, n in counts.items() if n.any()]
            return f"{self.corners} corners visible ({', '.join(parts)})"
        if self.edges < FEWEST_EDGES:
            return f"{self.edges} edges long enough in the image"
        return None


def see(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> LandmarkView:
    """The view of ``rig`` at a pose (4, 4) and an opening (nominal if None)."""
    camera, gripper = rig.camera, rig.gripper
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    corners_grip_m = points_grip_m[gripper.landmarks]
    uv_px = camera.project(corners_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    with np.errstate(invalid="ignore"):
        outside = np.asarray(~(inside_px(camera, uv_px) >= BORDER_PX))
    self_hidden = ~outside & ~gripper.points_visible(points_grip_m, eye_grip_m, gripper.landmarks)
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    layout = lay_out(camera, gripper, cam_T_grip, opening_m, rig.settings.corners.sampling, rig.taught)
    # Both in one call, as this takes most of the time.
    samples_m, of_samples = _samples(gripper, layout, points_grip_m)
    of_corners = gripper.point_finger[gripper.landmarks]
    targets_m, finger = np.concatenate([corners_grip_m, samples_m]), np.concatenate([of_corners, of_samples])
    hidden = behind_another_finger(gripper, points_grip_m, eye_grip_m, targets_m, finger)
    behind, free = ~outside & ~self_hidden & hidden[: len(of_corners)], ~hidden[len(of_corners) :]
    edges = np.count_nonzero(np.bincount(layout.edge[free], minlength=1) >= FEWEST_SAMPLES)
    return LandmarkView(uv_px, outside, self_hidden, behind, int(edges))


def samples_behind(gripper: Gripper, layout: EdgeLayout, points_grip_m: Array, eye_grip_m: Array) -> NDArray[np.bool_]:
    """Mask (n,) of a layout's samples that lie behind another finger."""
    samples_m, finger = _samples(gripper, layout, points_grip_m)
    return behind_another_finger(gripper, points_grip_m, eye_grip_m, samples_m, finger)


def _samples(gripper: Gripper, layout: EdgeLayout, points_grip_m: Array) -> tuple[Array, NDArray[np.intp]]:
    """A layout's samples (n, 3) in the gripper frame, and their fingers (n,)."""
    start, end = gripper.tangents_m(points_grip_m, layout.edge, layout.fraction)
    samples_m = start + layout.fraction[:, None] * (end - start)
    return samples_m, gripper.edge_finger[layout.edge]


_LEVI_CIVITA = np.zeros((3, 3, 3))
_LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_LEVI_CIVITA[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0
_WITHOUT = np.array([[1, 2], [0, 2], [0, 1]])


def behind_another_finger(
    gripper: Gripper, points_grip_m: Array, eye_grip_m: Array, targets_m: Array, finger: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Mask (n,): whether a face of another finger lies between the eye (3,) and each of the targets (n, 3), which
    belong to the fingers ``finger`` (n,); all in the gripper frame.  Fingers are convex solids, so faces turned to the
    eye hide all that the others do.  Without faces nothing counts as hidden.
    """
    hidden = np.zeros(len(targets_m), dtype=bool)
    if not gripper.faces:
        return hidden
    loops = points_grip_m[gripper.face_loops]
    spokes = loops[:, 1:] - loops[:, :1]
    normals = np.einsum("ijk,fnj,fnk->fi", _LEVI_CIVITA, spokes[:, :-1], spokes[:, 1:])  # outwards, twice the area long
    heights = np.einsum("fi,fi->f", eye_grip_m - loops[:, 0], normals)
    front = np.flatnonzero(heights > 0.0)
    loops, normals = loops[front], normals[front]
    rays = targets_m - eye_grip_m
    length_m = np.sqrt(np.einsum("ni,ni->n", rays, rays))
    others = finger[:, None] != gripper.face_finger[front]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = heights[front] / -(rays @ normals.T)
        target, face = np.nonzero(others & (share > 0.0) & ((1.0 - share) * length_m[:, None] > TOUCHING_M))
    hits = eye_grip_m + share[target, face, None] * rays[target]
    inside = _in_polygons(hits, loops[face], np.abs(normals).argmax(axis=1)[face])
    hidden[target[inside]] = True
    return hidden


def _in_polygons(points: Array, loops: Array, drop: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Mask (n,) of points (n, 3) inside of their planar loops (n, k, 3) in these planes (even-odd rule), each seen
    along its axis ``drop`` (n,).
    """
    x, y = np.take_along_axis(points, _WITHOUT[drop], axis=1).T[:, :, None]
    ax, ay = np.moveaxis(np.take_along_axis(loops, _WITHOUT[drop][:, None], axis=2), 2, 0)
    bx, by = np.roll(ax, -1, axis=1), np.roll(ay, -1, axis=1)
    spans = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = x < ax + (y - ay) * (bx - ax) / (by - ay)
    return np.asarray(np.count_nonzero(spans & left, axis=1) % 2 == 1)


SOUGHT_M = 1.0
"""Largest shift of the camera that is examined."""

SOUGHT_RAD = np.pi
"""Largest turn of the camera that is examined."""

SHIFTS_M = np.geomspace(0.002, SOUGHT_M, 57)
"""Shifts that are examined, each 12 % longer than the one before: some 30 px in the image where a view usually ends, at
30 mm.  A narrower gap in the view may be missed.
"""

TURNS_RAD = np.linspace(0.05, SOUGHT_RAD, 63)
"""Turns that are examined: some 50 px in the image."""

HALVINGS = 12
"""Of the step in which a view ends: some micrometres are left of it."""

TwoSided = tuple[float | None, float | None]
"""Amounts in negative and in positive direction; None: beyond the range that was searched."""


class Border(msgspec.Struct, frozen=True):
    """The smallest distance of a visible corner from each side of the image, and the smallest of all (px)."""

    left: float
    right: float
    top: float
    bottom: float
    smallest_px: float
    corner: str
    side: str


class Freedom(msgspec.Struct, frozen=True):
    """How far the camera may move along each single axis, x, y and z, before the monitor can't measure any more: shift
    (m) along and turn (rad) about the camera's own axes, and what is missing beyond.
    """

    shift_m: dict[str, TwoSided]
    turn_rad: dict[str, TwoSided]
    shift_reason: dict[str, tuple[str | None, str | None]]
    turn_reason: dict[str, tuple[str | None, str | None]]
    sought_m: float = SOUGHT_M
    sought_rad: float = SOUGHT_RAD


def moved_camera(cam_T_grip: Array, motion: Array) -> Array:
    """``cam_T_grip`` (4, 4) after the camera has shifted by ``motion[:3]`` (m) and turned about its own centre by the
    rotation vector ``motion[3:]`` (rad), both in its axes before the motion.
    """
    back = exp_rotation(motion[3:]).T
    return make_transform(back @ cam_T_grip[:3, :3], back @ (cam_T_grip[:3, 3] - motion[:3]))


def border(rig: Rig, sight: LandmarkView) -> Border | None:
    """Where the visible corners come nearest to the image's border; None if no corner is visible."""
    if not sight.corners:
        return None
    which = np.flatnonzero(sight.visible)
    u, v = sight.uv_px[which].T
    distances = np.stack([u, rig.camera.width_px - 1.0 - u, v, rig.camera.height_px - 1.0 - v])
    side, corner = np.unravel_index(int(distances.argmin()), distances.shape)
    sides = Border.__struct_fields__[:4]
    nearest = dict(zip(sides, distances.min(axis=1).tolist(), strict=True))
    name = rig.gripper.landmark_ids[which[corner]]
    return Border(**nearest, smallest_px=float(distances.min()), corner=name, side=sides[side])


def freedom(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> Freedom:
    """How far the camera may shift and turn along each of its axes at a fixed jaw opening."""
    found = [[_limit(rig, cam_T_grip, jaw_opening_m, sign * axis) for sign in (-1.0, 1.0)] for axis in np.eye(6)]
    amounts, reasons = ([(low[k], high[k]) for low, high in found] for k in (0, 1))
    parts = amounts[:3], amounts[3:], reasons[:3], reasons[3:]
    return Freedom(*(dict(zip("xyz", part, strict=True)) for part in parts))  # type: ignore[arg-type]


def sideways_m(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> float:
    """The shortest shift of the camera along its x or y, in either direction, after which the monitor can't measure;
    infinite if there is none.  In coarser steps than :func:`freedom`, good to 1/500 of the shift.
    """
    axes = np.concatenate([np.eye(6)[:2], -np.eye(6)[:2]])
    limits = [_limit(rig, cam_T_grip, jaw_opening_m, axis, SHIFTS_M[::3], halvings=7)[0] for axis in axes]
    return min((limit for limit in limits if limit is not None), default=math.inf)


def _limit(
    rig: Rig,
    cam_T_grip: Array,
    jaw_opening_m: float | None,
    axis: Array,
    amounts: Array | None = None,
    halvings: int = HALVINGS,
) -> tuple[float | None, str | None]:
    """The amount of a motion along the unit vector ``axis`` (6,) after which the view doesn't suffice, and why; None if
    it always does.
    """

    def view(amount: float) -> LandmarkView:
        return see(rig, moved_camera(cam_T_grip, amount * axis), jaw_opening_m)

    if amounts is None:
        amounts = TURNS_RAD if axis[3:].any() else SHIFTS_M
    good = 0.0
    for amount in [0.0, *amounts.tolist()]:
        if not (sight := view(amount)).enough:
            bad, sight = first_failing(good, amount, sight, view, halvings)
            return bad, sight.reason
        good = amount
    return None, None


def first_failing(
    good: float, bad: float, there: LandmarkView, view: Callable[[float], LandmarkView], halvings: int = HALVINGS
) -> tuple[float, LandmarkView]:
    """Bisect between a value whose view suffices and one whose view, ``there``, doesn't: the failing value found that
    is nearest to the former, and its view.
    """
    for _ in range(halvings if good != bad else 0):
        middle = 0.5 * (good + bad)
        sight = view(middle)
        if sight.enough:
            good = middle
        else:
            bad, there = middle, sight
    return bad, there
