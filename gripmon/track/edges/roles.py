"""Which of a gripper's edges run along its fingers, face each other, or lie on one side of all of them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

PARALLEL_COSINE = 0.87
"""Edges within 30 degrees of the fingers' direction run along them."""

DISTINCT_M = 1e-4
"""A finger's edges that are nearer to each other than a gripper file's points may be have no inner and outer one, m."""


def along_fingers(gripper: Gripper) -> tuple[Array, NDArray[np.bool_]]:
    """The direction (3,) of most of the edges' length, gripper frame, and (e,) which edges run along it.

    It is that of one of them, or their principal one: the four sides of a finger that tapers two ways all lie within
    30 degrees of its middle, and of no side.  Where no way has most of the length: zero, and all True, so that nothing
    is an end.
    """
    points_m = gripper.points_grip_m()
    way = points_m[gripper.edge_points[:, 1]] - points_m[gripper.edge_points[:, 0]]
    length = np.linalg.norm(way, axis=1)
    direction = way / length[:, None]
    principal = np.linalg.svd(direction * np.sqrt(length)[:, None])[2][0]
    for ways in (direction, principal[None]):
        near = np.abs(ways @ direction.T) > PARALLEL_COSINE
        together = near @ length
        best = int(np.argmax(together))
        if together[best] >= 0.5 * length.sum():
            return ways[best], np.asarray(near[best])
    return np.zeros(3), np.ones(len(length), dtype=bool)


def receding(gripper: Gripper) -> NDArray[np.bool_]:
    """(e,) which edges of a file from images run along its fingers in its plane, but belong to an end: that of a thick
    finger recedes from the camera.  They lie between an edge across the finger and a longer one along it.
    """
    along, points = along_fingers(gripper)[1], gripper.edge_points
    if not gripper.model.tilt_sigma_rad:
        return np.zeros_like(along)
    points_m = gripper.points_grip_m()
    length_m = np.linalg.norm(points_m[points[:, 1]] - points_m[points[:, 0]], axis=1)
    meets = (points[:, :, None, None] == points).any(axis=3)  # (e, 2, e) at its one point, and at its other
    crossed = (meets & ~along).any(axis=2)
    goes_on = (meets & along & (length_m > length_m[:, None, None])).any(axis=2)
    return np.asarray(along & (crossed & ~goes_on & goes_on[:, ::-1]).any(axis=1))


def has_lone_end(gripper: Gripper) -> bool:
    """Whether the gripper has a single finger, whose end alone shows a motion along it."""
    return len(gripper.finger_ids) == 1 and not along_fingers(gripper)[1].all()


@lru_cache(maxsize=8)
def inner_edges(gripper: Gripper) -> NDArray[np.bool_]:
    """(e,) which edges face the other fingers, a lone one's the TCP, so that what is grasped touches them: those along
    the fingers that are nearer to the inmost one of their finger than to its middle, and the end between them.
    """
    axis, along = along_fingers(gripper)
    middle_m = gripper.points_grip_m()[gripper.edge_points].mean(axis=1)
    own = [along & (gripper.edge_finger == finger) for finger in np.unique(gripper.edge_finger[along])]
    centre_m = np.array([middle_m[edges].mean(axis=0) for edges in own])
    between_m = centre_m.mean(axis=0) if len(own) > 1 else np.zeros(3)
    inner = np.zeros(len(along), dtype=bool)
    for edges, centre in zip(own, centre_m, strict=True):
        inwards = between_m - centre
        inwards -= (inwards @ axis) * axis
        way_m = (middle_m - centre) @ inwards / max(float(np.linalg.norm(inwards)), DISTINCT_M)
        inmost_m = way_m[edges].max()
        inner |= edges & (way_m > 0.5 * inmost_m) & (inmost_m > DISTINCT_M)
    return inner | np.isin(gripper.edge_points, gripper.edge_points[inner]).all(axis=1)


@lru_cache(maxsize=8)
def sides(gripper: Gripper) -> tuple[NDArray[np.bool_], ...]:
    """Two of (e,): which edges lie on the one side of their fingers, and which on the other, along the line from the
    first finger to the last: the fingers' shadows fall beside those together.  None of a lone finger.
    """
    fingers = np.unique(gripper.point_finger)
    if len(fingers) < 2:
        return ()
    points_m, axis = gripper.points_grip_m(), along_fingers(gripper)[0]
    centre_m = np.array([points_m[gripper.point_finger == finger].mean(axis=0) for finger in fingers])
    across = centre_m[-1] - centre_m[0]
    across = across - (across @ axis) * axis
    beside_m = (points_m - centre_m[np.searchsorted(fingers, gripper.point_finger)]) @ across
    least_m = DISTINCT_M * float(np.linalg.norm(across))
    both_m = beside_m[gripper.edge_points]
    return tuple((way * both_m > least_m).all(axis=1) for way in (-1.0, 1.0))
