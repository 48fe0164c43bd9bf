"""Fingers' shapes as a gripper model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import msgspec

from gripmon.model.gripper import EdgeModel, FaceModel, FingerModel, GripperModel, PointModel, RoundModel
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array
from gripmon.teach.cad.jaw import Jaw
from gripmon.teach.cad.solid import Shape

_DIGITS = 7  # of a metre: a tenth of a micrometre


def model_of(
    name: str, shapes: Mapping[str, Shape], bevel_m: float, jaw: Jaw | None, provenance: Provenance | None
) -> GripperModel:
    """The gripper file's model.  Points are named FINGER_p1 and so on, from the tip backwards, edges FINGER_e1.
    ``bevel_m``: width of the bevels on edges that are sharp in the CAD.
    """
    points: dict[str, PointModel] = {}
    edges: dict[str, EdgeModel] = {}
    faces = []
    for finger, shape in shapes.items():
        used = sorted({p for edge in shape.edges for p in edge} | {p for loop in shape.loops for p in loop})
        used.sort(key=lambda p: (p not in shape.corners, -round(float(shape.points_m[p, 2]), 5)))
        names = {p: f"{finger}_p{k}" for k, p in enumerate(used, start=1)}
        for p, point in names.items():
            points[point] = PointModel(
                finger=finger, xyz_m=_rounded(shape.points_m[p]), corner=p in shape.corners, round=_round(shape, p)
            )
        for k, ((a, b), crease) in enumerate(zip(shape.edges, shape.crease, strict=True), start=1):
            kind: Literal["contour", "crease"] = "crease" if crease else "contour"
            # The model has a bevel's edge anywhere in its width: 1/sqrt(12) of that is its standard deviation.
            spread_m = shape.spread_m[k - 1] if shape.spread_m else 0.0
            width_m = round(math.sqrt(12.0) * spread_m, 6) if spread_m else bevel_m
            via = tuple(map(_rounded, shape.via_m[k - 1])) if shape.via_m else ()
            edges[f"{finger}_e{k}"] = EdgeModel(start=names[a], end=names[b], kind=kind, bevel_m=width_m, via=via)
        faces += [FaceModel(finger=finger, points=tuple(names[p] for p in loop)) for loop in shape.loops]
    fingers = {finger: FingerModel(motion=None if jaw is None else jaw.motion(finger)) for finger in shapes}
    return GripperModel(
        name=name,
        fingers=fingers,
        points=points,
        edges=edges,
        jaw=None if jaw is None else jaw.model,
        faces=tuple(faces),
        provenance=provenance,
    )


def _rounded(place: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(v), _DIGITS) + 0.0 for v in place)
    return x, y, z


def _round(shape: Shape, point: int) -> RoundModel | msgspec.UnsetType:
    found = shape.round_m.get(point)
    if found is None:
        return msgspec.UNSET
    centre, axis = found
    return RoundModel(centre_m=_rounded(centre), axis=_rounded(axis))
