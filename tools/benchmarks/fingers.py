"""Grippers of the benchmarks' scenes: those that are shipped, tapered and wedge-shaped ones, and changed ones."""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec
import yaml

from benchmarks.machine import ROOT
from gripmon.model.gripper import Gripper, GripperModel

Model = dict[str, Any]
"""A gripper file's content."""


def gripper_of(model: Model) -> Gripper:
    return Gripper(msgspec.convert(model, GripperModel))


@cache
def shipped(name: str) -> Model:
    """A file of ``configs/grippers``."""
    model: Model = yaml.safe_load((ROOT / "configs" / "grippers" / f"{name}.yaml").read_text(encoding="utf-8"))
    return model


@cache
def gripper_models() -> tuple[Model, ...]:
    """Models of the grippers that scenes take in turn."""
    box = shipped("two_box_fingers")
    return box, tapered_gripper(box), shipped("adaptive_arc_fingers")


def tapered_gripper(box: Model) -> Model:
    """Fingers of 7 x 11 mm at the tip and 12 x 18 mm at the root, 34 mm long, sharp; names as in the box fingers."""
    nominal_m = 0.026
    points = {}
    for name, point in box["points"].items():
        back = name.endswith("_back")
        side = -1.0 if point["finger"] == "left" else 1.0
        x = side * (0.5 * nominal_m + (0.0 if "_in_" in name else 0.012 if back else 0.007))
        y = (-1.0 if "_near" in name else 1.0) * (0.009 if back else 0.0055)
        points[name] = {**point, "xyz_m": [x, y, -0.034 if back else 0.0]}
    edges = {name: {key: end for key, end in edge.items() if key != "bevel_m"} for name, edge in box["edges"].items()}
    jaw = {"nominal_m": nominal_m, "min_m": 0.0, "max_m": 0.05}
    return {**box, "name": "tapered_fingers", "jaw": jaw, "points": points, "edges": edges}


@cache
def wedge_fingers() -> Model:
    """Slim fingers of five-sided outline: the outer side slopes towards the tip."""
    outline = ((0.0, 0.0), (0.004, 0.0), (0.011, -0.016), (0.011, -0.045), (0.0, -0.045))  # x outward, z
    hidden = "34"  # the back end lies in the body that carries the finger
    points, edges, faces, fingers = {}, {}, [], {}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        fingers[name] = {"motion": {"axis": [0.5 * sign, 0.0, 0.0]}}
        for side, y in (("near", -0.006), ("far", 0.006)):
            for k, (x, z) in enumerate(outline):
                points[f"{name}_{side}_{k}"] = {
                    "finger": name, "xyz_m": [sign * (0.014 + x), y, z], "corner": k < 3,
                }  # fmt: skip
        count = len(outline)
        for k in range(count):
            after = (k + 1) % count
            near, far = (f"{name}_near_{k}", f"{name}_near_{after}"), (f"{name}_far_{k}", f"{name}_far_{after}")
            for start, end in (near, far, (near[0], far[0])):
                if start[-1] not in hidden or end[-1] not in hidden:
                    edges[f"{start}-{end}"] = {"from": start, "to": end}
            loop = [near[0], far[0], far[1], near[1]]
            faces.append({"finger": name, "points": loop if sign < 0.0 else loop[::-1]})
        for side in ("near", "far"):
            loop = [f"{name}_{side}_{k}" for k in range(count)]
            faces.append({"finger": name, "points": loop if (side == "far") == (sign > 0.0) else loop[::-1]})
    jaw = {"nominal_m": 0.028, "min_m": 0.0, "max_m": 0.05}
    return {"name": "wedge_fingers", "jaw": jaw, "fingers": fingers, "points": points, "edges": edges, "faces": faces}


def bevelled(model: Model, width_m: float) -> Model:
    """The model with a bevel on every edge."""
    edges = {name: {**edge, "bevel_m": width_m} for name, edge in model["edges"].items()}
    return {**model, "edges": edges}


def without_finger(model: Model, finger: str) -> Model:
    """The model without one of its fingers."""
    points = {name: point for name, point in model["points"].items() if point["finger"] != finger}
    return {
        **model,
        "fingers": {name: motion for name, motion in model["fingers"].items() if name != finger},
        "points": points,
        "edges": {name: edge for name, edge in model["edges"].items() if edge["from"] in points},
        "faces": [face for face in model["faces"] if face["finger"] != finger],
    }


def first_finger(model: Model) -> Model:
    """A model's first finger alone, which stands still; the TCP stays where it is."""
    own, *others = model["fingers"]
    for other in others:
        model = without_finger(model, other)
    parts = {part: model[part] for part in ("points", "edges", "faces")}
    return {"name": f"{model['name']}, one", "fingers": {own: {}}, **parts}
