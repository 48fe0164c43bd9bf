"""Gripper models made of axis-aligned boxes, as dicts like a parsed gripper file; tests change them before loading."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

Model = dict[str, Any]


def box_finger(name: str, low_m: tuple[float, float, float], high_m: tuple[float, float, float]) -> Model:
    """Points ``<name>_abc`` (a, b, c: 0 for low, 1 for high along x, y, z), all twelve edges and six faces."""
    bounds = (low_m, high_m)
    label = {bits: f"{name}_{bits[0]}{bits[1]}{bits[2]}" for bits in itertools.product((0, 1), repeat=3)}
    points = {
        label[bits]: {"finger": name, "xyz_m": [bounds[bits[k]][k] for k in range(3)], "corner": True} for bits in label
    }
    edges = {}
    for start, end in itertools.combinations(label, 2):
        if sum(a != b for a, b in zip(start, end, strict=True)) == 1:
            edges[f"{label[start]}-{label[end]}"] = {"from": label[start], "to": label[end]}
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        # Round the face with first x second = +axis: counter-clockwise seen from +axis.
        around = [(0, 0), (1, 0), (1, 1), (0, 1)]
        loop = []
        for a, b in around if side else around[::-1]:
            bits = [0, 0, 0]
            bits[axis], bits[first], bits[second] = side, a, b
            loop.append(label[tuple(bits)])
        faces.append({"finger": name, "points": loop})
    return {"fingers": {name: {}}, "points": points, "edges": edges, "faces": faces}


def cube_model(side_m: float = 0.04) -> Model:
    """One cube around the TCP that doesn't move."""
    half = 0.5 * side_m
    return {"name": "cube", **box_finger("cube", (-half, -half, -half), (half, half, half))}


def two_fingers_model() -> Model:
    """Two boxes, jaw from 10 to 50 mm, nominal 30 mm; the left moves along an axis, the right one by a table."""
    left = box_finger("left", (-0.025, -0.008, -0.04), (-0.015, 0.008, 0.0))
    right = box_finger("right", (0.015, -0.008, -0.04), (0.025, 0.008, 0.0))
    left["fingers"]["left"] = {"motion": {"axis": [-0.5, 0.0, 0.0]}}
    right["fingers"]["right"] = {
        "motion": {"table": [[0.01, -0.010, 0.0, 0.002], [0.03, 0.0, 0.0, 0.0], [0.05, 0.010, 0.0, -0.004]]}
    }
    return {
        "name": "two_fingers",
        "jaw": {"nominal_m": 0.03, "min_m": 0.01, "max_m": 0.05},
        **{key: {**left[key], **right[key]} for key in ("fingers", "points", "edges")},
        "faces": left["faces"] + right["faces"],
    }


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniform rotation by the QR decomposition of a normal matrix."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0.0 else -q
