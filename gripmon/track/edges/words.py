"""A gripper's fingers and edges in words of the picture: "the left finger's outer border (e06)"."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.edges.roles import along_fingers, inner_edges

_BESIDE = {1: ("",), 2: ("left ", "right "), 3: ("left ", "middle ", "right ")}
_BELOW = {1: ("",), 2: ("upper ", "lower "), 3: ("upper ", "middle ", "lower ")}
_COMPASS = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")
_SIDES = ("right", "lower", "left", "upper")
_THIRD = 1.0 / 3.0
"""Part of a finger's width at either side of it that counts as its border (no unit)."""


class Words(NamedTuple):
    """Names of a gripper's fingers (f) and edges (e), as someone says who looks at the image."""

    fingers: tuple[str, ...]
    edges: tuple[str, ...]

    def meant(self, text: str, gripper: Gripper) -> NDArray[np.bool_]:
        """(e,) which edges a text of these words is about."""
        named = np.array([name in text for name in self.edges])
        if named.any():
            return named
        along = along_fingers(gripper)[1]
        own = np.array([name in text for name in self.fingers])
        chosen = own[gripper.edge_finger] if own.any() else np.ones(len(along), dtype=bool)
        if "inner edges" in text:
            return np.asarray(chosen & inner_edges(gripper))
        if "ends" in text:
            return np.asarray(chosen & ~along)
        return np.asarray(chosen & own.any())


def in_words(gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None = None) -> Words:
    """The words for a gripper seen from ``cam_T_grip`` (4, 4) at an opening (nominal if None): which finger by its
    place in the image; which edge by where it lies on its finger as the image shows it, and in parentheses its name in
    the gripper file, since several may lie there.

    Without a lens: distortion exchanges neither sides nor ends.  Of more than three fingers the file's names are said.
    """
    points_m = gripper.points_grip_m(jaw_opening_m)
    axis, along = along_fingers(gripper)
    axis = axis if axis[2] >= 0.0 else -axis  # out of the gripper, towards the tips
    uv = _seen(points_m, cam_T_grip)
    own = [np.flatnonzero(gripper.point_finger == finger) for finger in range(len(gripper.finger_ids))]
    centre = np.array([uv[points].mean(axis=0) if len(points) else np.zeros(2) for points in own])
    fingers = _fingers(gripper.finger_ids, centre)
    edges = []
    for edge, (name, ends, finger) in enumerate(
        zip(gripper.edge_ids, gripper.edge_points, gripper.edge_finger, strict=True)
    ):
        points = own[finger]
        middle = uv[ends].mean(axis=0)
        if not axis.any():
            what = f"{_towards(middle - centre[finger], _COMPASS)} border"
        else:
            tip = _seen(np.array([points_m[points].mean(axis=0) + s * axis for s in (-1e-3, 1e-3)]), cam_T_grip)
            across = _across(tip[1] - tip[0], centre, int(finger))
            side = _side(middle, uv[points], across, len(own) > 1)
            what = _on_side(side, along[edge], _share(points_m[ends].mean(axis=0), points_m[points], axis) > 0.5)
        edges.append(f"{fingers[finger]}'s {what} ({name})")
    return Words(fingers, tuple(edges))


def _seen(points_m: Array, cam_T_grip: Array) -> Array:
    """(n, 2) directions in the image of points in the gripper frame."""
    cam_m = points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    return np.asarray(cam_m[:, :2] / np.maximum(cam_m[:, 2:], 1e-6))


def _fingers(names: tuple[str, ...], centre: Array) -> tuple[str, ...]:
    extent = np.ptp(centre, axis=0)
    way = int(extent[1] > extent[0])
    places = (_BESIDE, _BELOW)[way].get(len(names))
    if places is None:
        return tuple(f"finger {name}" for name in names)
    order = np.argsort(np.argsort(centre[:, way], kind="stable"), kind="stable")
    return tuple(f"the {places[k]}finger" for k in order.tolist())


def _across(way: Array, centre: Array, finger: int) -> Array:
    """(2,) across a finger in the image, towards the others; of a lone finger to either side."""
    way = way / max(float(np.linalg.norm(way)), 1e-12)
    others = np.delete(centre, finger, axis=0)
    inwards = others.mean(axis=0) - centre[finger] if len(others) else np.array([-way[1], way[0]])
    return np.asarray(inwards - (inwards @ way) * way)


def _share(at: Array, among: Array, way: Array) -> float:
    """Where a place lies among others along a direction, from 0 to 1; a half where they don't differ."""
    places = among @ way
    extent = float(np.ptp(places))
    return 0.5 if extent <= 0.0 else float(at @ way - places.min()) / extent


def _side(middle: Array, points: Array, across: Array, several: bool) -> str:
    """On which side of its finger a place is: inner, outer, the image's of a lone finger; empty between them."""
    share = _share(middle, points, across)
    if _THIRD < share < 1.0 - _THIRD:
        return ""
    if several:
        return "inner" if share > 0.5 else "outer"
    return _towards(across if share > 0.5 else -across, _SIDES)


def _on_side(side: str, along: bool, at_tip: bool) -> str:
    if along:
        return f"{side} border" if side else "middle edge"
    end = "tip" if at_tip else "back end"
    return f"{end}, {side} side" if side else end


def _towards(way: Array, names: tuple[str, ...]) -> str:
    """The name of a direction in the image, whose second axis points down."""
    turn = np.arctan2(way[1], way[0]) / (2.0 * np.pi)
    return names[round(turn * len(names)) % len(names)]
