"""What bevels that nobody stated do to corners and to the opening measured with the sharp model: they move all outlines
towards the finger by about the same length.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import EdgeView, Gripper
from gripmon.model.images import IMAGE_SUFFIXES
from gripmon.model.records import Array
from gripmon.track.edges import Measurement
from gripmon.track.edges.taught import sight_axes

INSET_SIGMA_M = 2.5e-4
"""Standard deviation of the shift towards the finger that bevels give all outlines in common: those of 0.7 mm, or
roundings of 1.2 mm radius, give 0.5 mm.
"""


def made_from_images(gripper: Gripper) -> bool:
    """Whether the gripper file was made from images: its edges lie where they show."""
    made_of = () if gripper.model.provenance is None else gripper.model.provenance.inputs
    return any(Path(each.file).suffix.lower() in IMAGE_SUFFIXES for each in made_of)


def unstated_inset_m(gripper: Gripper) -> float:
    """Standard deviation of the inset by bevels that the gripper file doesn't state (m); those that it states are in
    the edges' own deviations.
    """
    return 0.0 if made_from_images(gripper) or gripper.edge_bevel_m.any() else INSET_SIGMA_M


def finger_side(gripper: Gripper, points_grip_m: Array, cam_T_grip: Array, edges: EdgeView) -> Array:
    """Side (e,) of each edge on which its finger's visible face lies, without faces the middle of the finger's points;
    1: to the right of someone who walks along it in the image, -1: to the left.
    """
    middles = np.array([points_grip_m[gripper.point_finger == f].mean(axis=0) for f in range(len(gripper.finger_ids))])
    inside = np.where(np.isfinite(edges.inside_point_m), edges.inside_point_m, middles[gripper.edge_finger])
    ends = points_grip_m[gripper.edge_points]
    # To the right of the edge as the camera sees it: x right, y down, z forward.
    eye = invert(cam_T_grip)[:3, 3]
    right = np.cross(ends[:, 0] - eye, ends[:, 1] - eye)
    return np.sign(np.einsum("ei,ei->e", right, inside - eye))


def inset_corners_px(camera: Camera, gripper: Gripper, found: Measurement, inset_m: float) -> Array:
    """By how much (c, 2) the gripper's corners move in the image, where their outlines meet, if all of these lie
    ``inset_m`` towards the finger.
    """
    points_grip_m, cam_T_grip = gripper.points_grip_m(found.jaw_opening_m), found.cam_T_grip
    shift_grip_m, outline = _inset(gripper, found, inset_m)
    _, d_uv = camera.project_with_jacobian(points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    moved_px = np.zeros((len(gripper.corner_points), 2))
    for corner, point in enumerate(gripper.corner_points.tolist()):
        edges = gripper.edges_at_corner(corner)
        edges = edges[outline[edges]]
        ends = points_grip_m[gripper.edge_points[edges]]
        gradient = d_uv[point] @ cam_T_grip[:3, :3]
        tangent = (ends[:, 1] - ends[:, 0]) @ gradient.T
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
        offset_px = np.einsum("ei,ei->e", normal @ gradient, shift_grip_m[edges])
        moved_px[corner] = np.linalg.lstsq(normal, offset_px, rcond=0.1)[0]
    return moved_px


def inset_motion(gripper: Gripper, found: Measurement, inset_m: float) -> Array:
    """By how much (6,) or (7,) the measured pose, and opening, move for the same reason."""
    prediction, consensus = found.prediction, found.consensus
    sample = found.candidates.sample
    edge = prediction.layout.edge[sample]
    shift_grip_m, outline = _inset(gripper, found, inset_m)
    rows = prediction.jacobian[sample]
    # The Jacobian's rows by position are the gradient across the edge, camera frame.
    shift_px = np.einsum("ki,ki->k", rows[:, :3], shift_grip_m[edge] @ found.cam_T_grip[:3, :3].T) * outline[edge]
    pull = rows.T @ (consensus.weight * shift_px)
    return np.linalg.solve(consensus.information, pull)


def _inset(gripper: Gripper, found: Measurement, inset_m: float) -> tuple[Array, NDArray[np.bool_]]:
    """The shift (e, 3) of all edges towards their fingers across the line of sight, gripper frame; and which are
    visible outlines.
    """
    points_grip_m, cam_T_grip = gripper.points_grip_m(found.jaw_opening_m), found.cam_T_grip
    edges = gripper.edge_view(points_grip_m, invert(cam_T_grip)[:3, 3])
    across, _ = sight_axes(gripper, points_grip_m, cam_T_grip)
    side = finger_side(gripper, points_grip_m, cam_T_grip, edges)
    return inset_m * side[:, None] * across, edges.visible & ~edges.crease
