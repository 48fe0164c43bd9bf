"""Fingers whose tips are rounded: as solids with many flat facets for the simulator, and as a file with curved edges.

All sides of a finger slant away from the camera behind its near face, so that the outline is exactly that face's.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper, GripperModel

Array = NDArray[np.float64]

THICK_M, LENGTH_M, GAP_M = 0.003, 0.045, 0.030
FAR_SHARE, THINNER_FROM_M = 0.6, 0.008
"""Width of the far face over the near one's: of 8 mm, no side is seen at up to 28 degrees.  What is narrower is as much
thinner.
"""

LEAST_FLAT_M = 1e-3
"""Half of the flat part of a tip, below which it has none."""

MOTION = {"left": {"motion": {"axis": [-0.5, 0.0, 0.0]}}, "right": {"motion": {"axis": [0.5, 0.0, 0.0]}}}
JAW = {"nominal_m": GAP_M, "min_m": 0.01, "max_m": 0.06}


def outline_m(width_m: float, radius_m: float, step_m: float) -> Array:
    """(n, 2) x, z of a finger's tip from its left side to its right one, corners rounded by a radius (0: sharp); tip at
    z = 0.  With too little flat between them it is wholly round, whatever the step: a file of wider steps is the same.
    """
    half = 0.5 * width_m
    if radius_m == 0.0:
        return np.array([[-half, 0.0], [half, 0.0]])
    radius_m = half if half - radius_m < LEAST_FLAT_M else radius_m
    angle = np.linspace(0.0, 0.5 * np.pi, max(round(0.5 * np.pi * radius_m / step_m), 2) + 1)
    left = np.column_stack([radius_m - half - radius_m * np.cos(angle), radius_m * np.sin(angle) - radius_m])
    right = left[::-1] * (-1.0, 1.0)
    if np.allclose(left[-1], right[0]):
        return np.vstack([left, right[1:]])
    flat = np.linspace(left[-1], right[0], max(round((width_m - 2.0 * radius_m) / step_m), 1) + 1)
    return np.vstack([left, flat[1:-1], right])


def facetted_m(facet_m: float) -> Array:
    """(n, 2) as :func:`outline_m`: a tip of three facets of the same length, turned by 45 degrees each."""
    half, back = 0.5 * facet_m, np.sqrt(0.5) * facet_m
    return np.array([[-half - back, -back], [-half, 0.0], [half, 0.0], [half + back, -back]])


def rounded_solids(width_m: float = 0.012, radius_m: float = 0.004) -> Gripper:
    """For the simulator: prisms with a facet each 0.2 mm; their vertices lie on the rounded outline."""
    return solids(outline_m(width_m, radius_m, 2e-4))


def solids(tip: Array) -> Gripper:
    """For the simulator: prisms whose near face ends in a ``tip`` (n, 2), see :func:`outline_m`."""
    width_m = float(np.ptp(tip[:, 0]))
    near = np.vstack([[-0.5 * width_m, -LENGTH_M], tip, [0.5 * width_m, -LENGTH_M]])
    middle = np.array([0.0, -0.5 * LENGTH_M])
    inset_m = (1.0 - FAR_SHARE) * width_m
    far = middle + (near - middle) * (FAR_SHARE, 1.0 - inset_m / LENGTH_M)
    count = len(near)
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    faces: list[tuple[str, list[str]]] = []
    half_m = 0.5 * _thick_m(width_m)
    for finger, x_m in _middles_m(width_m).items():
        rims = {rim: [f"{finger}_{rim}{i}" for i in range(count)] for rim in ("near", "far")}
        for names, loop, y_m in zip(rims.values(), (near, far), (-half_m, half_m), strict=True):
            for i, (x, z) in enumerate(loop.tolist()):
                at_tip = 0 < i < count - 1
                points[names[i]] = {"finger": finger, "xyz_m": [x_m + x, y_m, z], "corner": at_tip}
            edges |= {f"{names[i]}-": {"from": names[i], "to": names[(i + 1) % count]} for i in range(count)}
            faces.append((finger, names))
        one, other = rims.values()
        pairs = ((i, (i + 1) % count) for i in range(count))
        faces += [(finger, [one[i], other[i], other[k], one[k]]) for i, k in pairs]
    return _gripper(points, edges, [_outwards(points, *face) for face in faces])


def rounded_model(width_m: float = 0.012, radius_m: float = 0.004, step_m: float = 1e-3) -> Gripper:
    """For the monitor: two straight sides and a curved edge a finger, and no corner; sharp ones with a radius of 0."""
    tip = outline_m(width_m, radius_m, step_m)
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    for finger, x_m in _middles_m(width_m).items():
        backs = (-0.5 * width_m, -LENGTH_M), (0.5 * width_m, -LENGTH_M)
        for name, (x, z) in {"a_back": backs[0], "a": tip[0], "b": tip[-1], "b_back": backs[1]}.items():
            corner = radius_m == 0.0 and "back" not in name
            xyz_m = [float(x_m + x), -0.5 * _thick_m(width_m), float(z)]
            points[f"{finger}_{name}"] = {"finger": finger, "xyz_m": xyz_m, "corner": corner}
        via = [[x_m + x, -0.5 * _thick_m(width_m), z] for x, z in tip[1:-1].tolist()]
        edges[f"{finger}_side_a"] = {"from": f"{finger}_a_back", "to": f"{finger}_a"}
        edges[f"{finger}_tip"] = {"from": f"{finger}_a", "to": f"{finger}_b", "via": via}
        edges[f"{finger}_side_b"] = {"from": f"{finger}_b", "to": f"{finger}_b_back"}
    return _gripper(points, edges, [])


def facetted_model(tip: Array) -> Gripper:
    """For the monitor: straight edges alone, with a corner between each two of them; ``tip`` (n, 2) as for
    :func:`solids`.
    """
    width_m = float(np.ptp(tip[:, 0]))
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    for finger, x_m in _middles_m(width_m).items():
        outline = np.vstack([[tip[0, 0], -LENGTH_M], tip, [tip[-1, 0], -LENGTH_M]])
        for i, (x, z) in enumerate(outline.tolist()):
            xyz_m = [x_m + x, -0.5 * _thick_m(width_m), z]
            points[f"{finger}{i}"] = {"finger": finger, "xyz_m": xyz_m, "corner": 0 < i < len(outline) - 1}
        for i in range(len(outline) - 1):
            edges[f"{finger}_edge{i}"] = {"from": f"{finger}{i}", "to": f"{finger}{i + 1}"}
    return _gripper(points, edges, [])


def _thick_m(width_m: float) -> float:
    return THICK_M * min(width_m / THINNER_FROM_M, 1.0)


def _middles_m(width_m: float) -> dict[str, float]:
    """x of each finger's middle at the nominal opening."""
    return {"left": -0.5 * (GAP_M + width_m), "right": 0.5 * (GAP_M + width_m)}


def _outwards(points: dict[str, Any], finger: str, names: list[str]) -> dict[str, Any]:
    """A face with its points counter-clockwise seen from outside."""
    own = np.array([points[name]["xyz_m"] for name in names])
    whole = np.array([point["xyz_m"] for point in points.values() if point["finger"] == finger])
    normal = np.cross(own, np.roll(own, -1, axis=0)).sum(axis=0)
    inwards = normal @ (own.mean(axis=0) - whole.mean(axis=0)) < 0.0
    return {"finger": finger, "points": names[::-1] if inwards else names}


def _gripper(points: dict[str, Any], edges: dict[str, Any], faces: list[dict[str, Any]]) -> Gripper:
    parts = {"points": points, "edges": edges, "faces": faces}
    value = {"name": "rounded_fingers", "jaw": JAW, "fingers": MOTION, **parts}
    return Gripper(msgspec.convert(value, GripperModel))
