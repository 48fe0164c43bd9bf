"""How deep a bevelled edge lies: what teaching images at one pose can't show, but the shape of a bevel tells.

A bevel or a rounding cuts an edge off; what shows instead is its rim, which lies on one of the two faces that would
have met in the sharp edge.  So an offset across the line of sight goes with one along it: the rim lies in the face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

LARGEST_SLOPE = 5.0
"""Depth for each metre of offset at most: a face that is seen more grazingly than 11° tells no depth."""

UNKNOWN_SLOPE = 2.0
"""Standard deviation of the depth, for each metre of offset, where faces don't tell it."""

SLOPE_SHARE = 0.5
"""Standard deviation of a depth that faces tell, as a share of it: a rounding's line lies less deep than a bevel's."""


def slopes(
    gripper: Gripper, points_grip_m: Array, crease: NDArray[np.bool_], axes: tuple[Array, Array], offset_m: Array
) -> Array:
    """(e,) depth of an edge's rim for each metre of its offset across the line of sight (e,); NaN where the gripper
    file has no two faces at the edge.

    ``axes`` as :func:`sight_axes` gives them.  An outline of equal bevels is the rim that lies
    farther out, a crease shows the rim on the side to which it is shifted.
    """
    across, depth = axes
    out = np.full(len(gripper.edge_ids), np.nan)
    members = [set(face.points.tolist()) for face in gripper.faces]
    for edge, (start, end) in enumerate(gripper.edge_points.tolist()):
        faces = [face for face, m in zip(gripper.faces, members, strict=True) if {start, end} <= m]
        if len(faces) != 2:
            continue
        along = points_grip_m[end] - points_grip_m[start]
        along = along / np.linalg.norm(along)
        into = np.array([points_grip_m[face.points].mean(axis=0) - points_grip_m[start] for face in faces])
        into -= np.outer(into @ along, along)
        into /= np.linalg.norm(into, axis=1)[:, None]
        shift, deeper = into @ across[edge], into @ depth[edge]
        rim = int(np.argmax(shift * offset_m[edge])) if crease[edge] else int(np.argmin(np.abs(shift)))
        if shift[rim] * offset_m[edge] > 0.0:
            out[edge] = np.clip(deeper[rim] / shift[rim], -LARGEST_SLOPE, LARGEST_SLOPE)
    return out
