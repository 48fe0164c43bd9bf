"""Which corners and edges of the gripper a camera sees from a pose, as the monitor will look for them, and why others
are not seen.

Beyond the monitor's own rule (a face must look at the camera) fingers that stand before each other are found: the
monitor will look for such an edge, and see the other finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.monitor import MonitorSettings
from gripmon.track.edges import TaughtEdges
from gripmon.track.edges.prediction import CORNER_MARGIN_PX, EdgeLayout, lay_out

FEWEST_EDGES = 3
"""Edges that must be seen for a fit to be believed."""

FEWEST_CORNERS = 3
"""Corners that must be seen; a configuration that shows fewer is refused."""

FEWEST_SAMPLES = 4
"""Profiles of an edge below which it isn't used, as in the monitor's layout."""

TOUCHING_M = 1e-4
"""A point that is less than this behind another finger's face lies on it."""


class Rig(NamedTuple):
    """A camera, a gripper, and how the monitor looks at it; everything but the pose between them."""

    camera: Camera
    gripper: Gripper
    settings: MonitorSettings
    taught: TaughtEdges | None = None


@dataclass(frozen=True, slots=True)
class Sight:
    """What is seen from one pose at one jaw opening: arrays (c,) over the gripper's corners.

    ``uv_px`` (c, 2), NaN where the lens maps nothing.  Each corner is ``visible``, or ``outside`` of the image, or
    ``self_hidden`` by its own finger, or ``behind`` another one, the first that holds.  ``edges``: how many can be
    sampled.
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


def see(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> Sight:
    """What ``rig`` sees at a pose (4, 4) and an opening (nominal if None)."""
    camera, gripper = rig.camera, rig.gripper
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    corners_grip_m = points_grip_m[gripper.corner_points]
    uv_px = camera.project(corners_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    with np.errstate(invalid="ignore"):
        within = (uv_px >= CORNER_MARGIN_PX) & (uv_px <= last_px - CORNER_MARGIN_PX)
    outside = np.asarray(~within.all(axis=1))
    self_hidden = ~outside & ~gripper.corners_visible(points_grip_m, eye_grip_m)
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    layout = lay_out(camera, gripper, cam_T_grip, opening_m, rig.settings.corners.sampling, rig.taught)
    # Both in one call, which takes most of the time.
    samples_m, of_samples = _samples(gripper, layout, points_grip_m)
    of_corners = gripper.point_finger[gripper.corner_points]
    targets_m, finger = np.concatenate([corners_grip_m, samples_m]), np.concatenate([of_corners, of_samples])
    hidden = behind_another_finger(gripper, points_grip_m, eye_grip_m, targets_m, finger)
    behind, free = ~outside & ~self_hidden & hidden[: len(of_corners)], ~hidden[len(of_corners) :]
    edges = np.count_nonzero(np.bincount(layout.edge[free], minlength=1) >= FEWEST_SAMPLES)
    return Sight(uv_px, outside, self_hidden, behind, int(edges))


def samples_behind(gripper: Gripper, layout: EdgeLayout, points_grip_m: Array, eye_grip_m: Array) -> NDArray[np.bool_]:
    """(n,) which samples of a layout lie behind another finger."""
    samples_m, finger = _samples(gripper, layout, points_grip_m)
    return behind_another_finger(gripper, points_grip_m, eye_grip_m, samples_m, finger)


def _samples(gripper: Gripper, layout: EdgeLayout, points_grip_m: Array) -> tuple[Array, NDArray[np.intp]]:
    """A layout's samples (n, 3) in the gripper frame, and their fingers (n,)."""
    ends = points_grip_m[gripper.edge_points[layout.edge]]
    samples_m = ends[:, 0] + layout.fraction[:, None] * (ends[:, 1] - ends[:, 0])
    return samples_m, gripper.edge_finger[layout.edge]


_LEVI_CIVITA = np.zeros((3, 3, 3))
_LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_LEVI_CIVITA[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0
_WITHOUT = ([1, 2], [0, 2], [0, 1])


def behind_another_finger(
    gripper: Gripper, points_grip_m: Array, eye_grip_m: Array, targets_m: Array, finger: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """(n,) whether a face of another finger stands between the eye (3,) and each of the targets (n, 3), which belong to
    the fingers ``finger`` (n,); all in the gripper frame.  Fingers are convex solids, of which the faces that look at
    the eye hide all that the others do.  Without faces nothing is known to hide.
    """
    hidden = np.zeros(len(targets_m), dtype=bool)
    rays = targets_m - eye_grip_m
    length_m = np.sqrt(np.einsum("ni,ni->n", rays, rays))
    for face in gripper.faces:
        other = (finger != face.finger) & ~hidden
        if not other.any():
            continue
        loop = points_grip_m[face.points]
        spokes = loop[1:] - loop[0]
        normal = np.einsum("ijk,nj,nk->i", _LEVI_CIVITA, spokes[:-1], spokes[1:])  # outwards, twice the area long
        height = float((eye_grip_m - loop[0]) @ normal)
        if height <= 0.0:
            continue
        towards = -(rays @ normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = height / towards
            crosses = other & (share > 0.0) & ((1.0 - share) * length_m > TOUCHING_M)
        which = np.flatnonzero(crosses)
        if not len(which):
            continue
        hits = eye_grip_m + share[which, None] * rays[which]
        hidden[which] = _in_polygon(hits, loop, int(np.abs(normal).argmax()))
    return hidden


def _in_polygon(points: Array, loop: Array, drop: int) -> NDArray[np.bool_]:
    """(n,) whether points (n, 3) of a planar loop's plane lie in it (even-odd rule), seen along the axis ``drop``."""
    x, y = points[:, _WITHOUT[drop]].T[:, :, None]
    ax, ay = loop[:, _WITHOUT[drop]].T
    bx, by = np.append(ax[1:], ax[0]), np.append(ay[1:], ay[0])
    spans = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = x < ax + (y - ay) * (bx - ax) / (by - ay)
    return np.asarray(np.count_nonzero(spans & left, axis=1) % 2 == 1)
