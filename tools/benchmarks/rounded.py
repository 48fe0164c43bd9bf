"""Fingers whose tips are rounded: as solids with many flat facets for the simulator, and as a file with curved edges.

All sides of a finger slant away from the camera behind its near face, so that the outline is exactly that face's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gripmon.model.gripper import Gripper, gripper_from_dict

THICK_M, SLANT_M, LENGTH_M, GAP_M = 0.006, 0.003, 0.045, 0.030
MOTION = {"left": {"motion": {"axis": [-0.5, 0.0, 0.0]}}, "right": {"motion": {"axis": [0.5, 0.0, 0.0]}}}
JAW = {"nominal_m": GAP_M, "min_m": 0.01, "max_m": 0.06}


def outline_m(width_m: float, radius_m: float, step_m: float) -> np.ndarray:
    """(n, 2) x, z of a finger's tip from its left side to its right one, corners rounded by a radius; tip at z = 0."""
    half = 0.5 * width_m
    angle = np.linspace(0.0, 0.5 * np.pi, max(round(0.5 * np.pi * radius_m / step_m), 2) + 1)
    left = np.column_stack([radius_m - half - radius_m * np.cos(angle), radius_m * np.sin(angle) - radius_m])
    right = left[::-1] * (-1.0, 1.0)
    flat = np.linspace(left[-1], right[0], max(round((width_m - 2.0 * radius_m) / step_m), 1) + 1)[1:-1]
    if np.allclose(left[-1], right[0]):
        return np.vstack([left, right[1:]])
    return np.vstack([left, flat, right])


def middle_x_m(width_m: float) -> dict[str, float]:
    return {"left": -0.5 * (GAP_M + width_m), "right": 0.5 * (GAP_M + width_m)}


def rounded_solids(width_m: float = 0.012, radius_m: float = 0.004, step_m: float = 1.5e-4) -> Gripper:
    """For the simulator: prisms with a facet each ``step_m``."""
    tip = outline_m(width_m, radius_m, step_m)
    near = np.vstack([[-0.5 * width_m, -LENGTH_M], tip, [0.5 * width_m, -LENGTH_M]])
    # The far face is the same, smaller by the slant on every side.
    middle = np.array([0.0, -0.5 * LENGTH_M])
    size = np.ptp(near, axis=0)
    far = middle + (near - middle) * (size - 2.0 * SLANT_M) / size
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    faces: list[dict[str, Any]] = []
    count = len(near)
    for finger, x_m in middle_x_m(width_m).items():
        for rim, loop, y_m in (("n", near, -0.5 * THICK_M), ("f", far, 0.5 * THICK_M)):
            for i, (x, z) in enumerate(loop.tolist()):
                points[f"{finger}_{rim}{i}"] = {
                    "finger": finger,
                    "xyz_m": [x_m + x, y_m, z],
                    "corner": 0 < i < count - 1,
                }
        names = {rim: [f"{finger}_{rim}{i}" for i in range(count)] for rim in "nf"}
        for i in range(count):
            k = (i + 1) % count
            edges.update({f"{finger}_{rim}{i}": {"from": each[i], "to": each[k]} for rim, each in names.items()})
            faces.append({"finger": finger, "points": [names["n"][i], names["f"][i], names["f"][k], names["n"][k]]})
        faces.append({"finger": finger, "points": names["n"]})
        faces.append({"finger": finger, "points": names["f"][::-1]})
    return gripper_from_dict(
        {
            "name": "rounded",
            "jaw": JAW,
            "fingers": MOTION,
            "points": points,
            "edges": edges,
            "faces": _outwards(points, faces),
        }
    )


def rounded_model(width_m: float = 0.012, radius_m: float = 0.004, step_m: float = 1e-3) -> Gripper:
    """For the monitor: two straight sides and one curved edge a finger, and no corner at all."""
    tip = outline_m(width_m, radius_m, step_m)
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    for finger, x_m in middle_x_m(width_m).items():
        places = {
            "a_back": (-0.5 * width_m, -LENGTH_M),
            "a": tip[0],
            "b": tip[-1],
            "b_back": (0.5 * width_m, -LENGTH_M),
        }
        for name, (x, z) in places.items():
            points[f"{finger}_{name}"] = {"finger": finger, "xyz_m": [float(x_m + x), -0.5 * THICK_M, float(z)]}
        via = [[x_m + x, -0.5 * THICK_M, z] for x, z in tip[1:-1].tolist()]
        edges[f"{finger}_side_a"] = {"from": f"{finger}_a_back", "to": f"{finger}_a"}
        edges[f"{finger}_tip"] = {"from": f"{finger}_a", "to": f"{finger}_b", "via": via}
        edges[f"{finger}_side_b"] = {"from": f"{finger}_b", "to": f"{finger}_b_back"}
    return gripper_from_dict({"name": "rounded", "jaw": JAW, "fingers": MOTION, "points": points, "edges": edges})


def _outwards(points: dict[str, Any], faces: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Faces with their points counter-clockwise seen from outside."""
    out = []
    for face in faces:
        own = np.array([points[name]["xyz_m"] for name in face["points"]])
        whole = np.array([p["xyz_m"] for p in points.values() if p["finger"] == face["finger"]])
        normal = np.cross(own, np.roll(own, -1, axis=0)).sum(axis=0)
        inwards = normal @ (own.mean(axis=0) - whole.mean(axis=0)) < 0.0
        out.append({**face, "points": face["points"][::-1] if inwards else face["points"]})
    return out
