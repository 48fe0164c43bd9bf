"""The solids of a scenario and their poses: fingers, the bodies that carry them, the grasped object, covers.  Also the
truth about a frame, up to rounding: poses, openings, corner pixels, and what hides each corner.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate.scenario import Cover, Prop, Scenario
from gripmon.simulate.scene import COVER_TRAVEL, SceneState
from gripmon.simulate.solids import PlacedSolid, Solid, box, finger_solids, hidden_by, mirrored, paint_order, place

# Half width of a cover, over half the larger side of the view.
COVER_HALF = 1.35


class Bodies:
    """The shapes only, no textures.  Raises ValueError for a gripper whose fingers are not closed convex solids."""

    def __init__(self, gripper: Gripper, scenario: Scenario, view_half: Array) -> None:
        self.gripper = gripper
        self.fingers = finger_solids(gripper, scenario.fingers.shape)
        self.carriers = tuple(_carrier(f) for f in self.fingers) if scenario.fingers.carriers else ()
        self.grasped: Solid | None = None
        if scenario.grasped is not None:
            half = 0.5 * np.array(scenario.grasped.size_m)
            self.grasped = box("object", -half, half)
        self.props = tuple(_prop(number, prop, self.fingers) for number, prop in enumerate(scenario.props))
        self._copies = tuple(prop.shape for prop in scenario.props)
        self.cover_outlines = tuple(_cover_outline(c, view_half) for c in scenario.covers)
        self._corner_finger = gripper.point_finger[gripper.corner_points]

    def placed(self, state: SceneState) -> list[PlacedSolid]:
        """All solids in the camera frame, from back to front."""
        cam_T_finger = state.cam_T_grip @ state.grip_T_finger
        placed = [place(f, cam_T_finger[k]) for k, f in enumerate(self.fingers)]
        placed += [place(c, cam_T_finger[k]) for k, c in enumerate(self.carriers)]
        if state.cam_T_object is not None and self.grasped is not None:
            placed.append(place(self.grasped, state.cam_T_object))
        for index, grip_T_prop in state.props:
            for k, solid in enumerate(self.props[index]):
                placed.append(place(solid, state.cam_T_grip @ self._grip_T_body(state, index, k, grip_T_prop)))
        return paint_order(placed)

    def _grip_T_body(self, state: SceneState, index: int, part: int, grip_T_prop: Array) -> Array:
        """Pose of a part of a prop: copies move with the jaws, mirror images in the opposite direction along z."""
        match self._copies[index]:
            case "box":
                return grip_T_prop
            case "fingers":
                return grip_T_prop @ state.grip_T_finger[part]
            case _:
                mirror = np.diag([1.0, 1.0, -1.0, 1.0])
                there = mirror @ state.grip_T_finger[part] @ mirror
                there[2, 3] += 2.0 * grip_T_prop[2, 3]
                return there

    def placed_covers(self, state: SceneState) -> list[tuple[int, Array]]:
        """Index and outline (k, 3) in the camera frame of the covers in view."""
        return [(i, self.cover_outlines[i] @ T[:3, :3].T + T[:3, 3]) for i, T in state.covers]

    def hidden_corners(self, state: SceneState, corners_cam_m: Array) -> list[Hidden | None]:
        """What hides each corner (c, 3) from the camera; the body nearest to the camera counts."""
        out: list[Hidden | None] = [None] * len(corners_cam_m)
        cam_T_grip = state.cam_T_grip
        eye = -cam_T_grip[:3, :3].T @ cam_T_grip[:3, 3]
        for k in np.flatnonzero(~self.gripper.corners_visible(state.points_grip_m, eye)).tolist():
            out[k] = Hidden.SELF
        for body in self.placed(state):
            reason, own = self._reason(body.solid)
            for k in np.flatnonzero(hidden_by(body, corners_cam_m) & ~own).tolist():
                out[k] = reason
        for k in np.flatnonzero(self.covered(state, corners_cam_m)).tolist():
            out[k] = Hidden.COVER
        return out

    def covered(self, state: SceneState, points_cam_m: Array) -> NDArray[np.bool_]:
        """(n,) which of the points (n, 3) in the camera frame are hidden by a cover."""
        covered = np.zeros(len(points_cam_m), dtype=bool)
        for _, outline in self.placed_covers(state):
            covered |= _behind(outline, points_cam_m)
        return covered

    def _reason(self, solid: Solid) -> tuple[Hidden, NDArray[np.bool_]]:
        """The reason for what a body hides, and which corners are its own."""
        for k, finger in enumerate(self.fingers):
            if finger is solid:
                return Hidden.OTHER_FINGER, self._corner_finger == k
        none = np.zeros(len(self._corner_finger), dtype=bool)
        return (Hidden.CARRIER if any(solid is c for c in self.carriers) else Hidden.OBJECT), none


def _behind(outline: Array, points_cam_m: Array) -> NDArray[np.bool_]:
    """(n,) whether the rays to the points pass through a flat outline (k, 3) at constant z in front of the points."""
    depth = outline[0, 2]
    inside = np.zeros(len(points_cam_m), dtype=bool)
    z = points_cam_m[:, 2]
    x, y = points_cam_m[:, 0] * depth / z, points_cam_m[:, 1] * depth / z
    for (x0, y0, _), (x1, y1, _) in zip(outline.tolist(), np.roll(outline, -1, axis=0).tolist(), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return inside & (z > depth)


def _carrier(finger: Solid) -> Solid:
    """The body behind a finger that carries it: slightly thicker, extending outwards."""
    low, high = finger.vertices_m.min(axis=0), finger.vertices_m.max(axis=0)
    size = high - low
    outwards = math.copysign(1.0, float(low[0] + high[0]))
    first = np.array([low[0], low[1] - 0.25 * size[1], low[2] - 0.9 * size[2]])
    last = np.array([high[0], high[1] + 0.1 * size[1], low[2]])
    if outwards < 0.0:
        first[0] -= 2.2 * size[0]
        last[0] -= 0.25 * size[0]
    else:
        last[0] += 2.2 * size[0]
        first[0] += 0.25 * size[0]
    return box(f"{finger.name} carrier", first, last)


def _prop(number: int, prop: Prop, fingers: tuple[Solid, ...]) -> tuple[Solid, ...]:
    """The bodies of a prop, with unique names."""
    if prop.shape == "box":
        half = 0.5 * np.array(prop.size_m)
        return (box(f"prop {number}", -half, half),)
    copies = fingers if prop.shape == "fingers" else tuple(mirrored(finger) for finger in fingers)
    return tuple(dataclasses.replace(copy, name=f"prop {number} {copy.name}") for copy in copies)


def _cover_outline(cover: Cover, view_half: Array) -> Array:
    """Outline (k, 3) in the cover's frame, counter-clockwise in a view with y down; larger than the view."""
    unit = float(view_half.max()) * cover.distance_m
    length, half = COVER_TRAVEL * unit, COVER_HALF * unit
    front = 0.0
    if cover.kind == "sheet":
        outline = np.array([[front, -half], [front, half], [2.0 * length, half], [2.0 * length, -half]])
    else:
        outline = _hand_outline(front, half, length)
    return np.column_stack([outline, np.zeros(len(outline))])


def _hand_outline(front: float, half: float, length: float) -> Array:
    """Four rounded fingers of different lengths ahead of a palm, counter-clockwise in a view with y down."""
    arc = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    radius = half / 4.3
    knuckles = front + 0.28 * length
    corners: list[tuple[float, float]] = []
    for k, tip in enumerate((0.10, 0.0, 0.03, 0.14)):
        y = -half + (2 * k + 1) * half / 4.0
        end = front + tip * length + radius
        corners.append((knuckles, y - radius))
        corners += [(end - radius * math.cos(a), y + radius * math.sin(a)) for a in arc.tolist()]
        corners.append((knuckles, y + radius))
    corners += [(2.0 * length, half), (2.0 * length, -half)]
    return np.array(corners)


class Hidden(enum.StrEnum):
    """Why a corner isn't visible."""

    OUTSIDE = "outside"
    SELF = "self"
    OTHER_FINGER = "other_finger"
    CARRIER = "carrier"
    OBJECT = "object"
    COVER = "cover"


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """Truth of one frame, at the middle of its exposure.

    ``reference_cam_T_grip`` is a perfect calibration from before; ``tcp_shift_m`` (3,) the TCP's displacement since
    then, camera axes.  ``corner_uv_px`` (c, 2), in the gripper's order, lie in the distorted image, NaN behind the
    camera; ``hidden`` (c,) is None where visible.  ``finger_bend`` (f, 4, 4) maps a finger's points at nominal opening
    to where its bending moves them, gripper frame.
    """

    index: int
    time_s: float
    stamp_ns: int
    cam_T_grip: Array
    reference_cam_T_grip: Array
    tcp_shift_m: Array
    jaw_opening_m: float
    jaw_reported_m: float | None
    corner_ids: tuple[str, ...]
    corner_uv_px: Array
    hidden: tuple[Hidden | None, ...]
    finger_bend: Array
    events: tuple[str, ...]
    exposure: float
    defocus_px: float

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(c,) which corners are visible."""
        return np.array([h is None for h in self.hidden])

    def to_json(self, file: str) -> bytes:
        """One line of JSON without a line feed, naming the image file."""
        corners = [
            {"id": name, "uv_px": uv.tolist() if np.isfinite(uv).all() else None, "hidden": hidden}
            for name, uv, hidden in zip(self.corner_ids, self.corner_uv_px, self.hidden, strict=True)
        ]
        of_corners = ("corner_ids", "corner_uv_px", "hidden")
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in of_corners}
        return msgspec.json.encode({"file": file, **values, "corners": corners}, enc_hook=np.ndarray.tolist)
