"""A finger's points, edges and faces, however they were found, and the gripper model made of such fingers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import msgspec

from gripmon.model.gripper import (
    WIDEST_BEVEL_M,
    EdgeModel,
    FaceModel,
    FingerModel,
    GripperModel,
    JawModel,
    PointModel,
    RoundModel,
)
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array

_DIGITS = 7  # of a metre: a tenth of a micrometre


@dataclass(slots=True)
class Shape:
    """One finger in the gripper frame: ``points_m`` (p, 3), which of them are ``corners``, ``edges`` as pairs of points
    with ``crease`` or not, ``loops`` of faces.  ``round_m``: by point, centre and axis of the rounding it lies on.
    ``spread_m``: by edge, the standard deviation of the observed edge from it, 0 for a sharp edge; empty where all are
    sharp.  ``via_m``: by edge, the points (n, 3) that a curved one passes between its ends; empty where none is curved.
    ``brighter``: the brighter side of those edges of which it is known, by their numbers.
    """

    points_m: Array
    corners: set[int]
    edges: list[tuple[int, int]]
    crease: list[bool]
    loops: list[list[int]] = field(default_factory=list)
    round_m: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    spread_m: list[float] = field(default_factory=list)
    via_m: list[Array] = field(default_factory=list)
    brighter: dict[int, Literal["left", "right"]] = field(default_factory=dict)

    def moved(self, to_T_shape: Array) -> Shape:
        """The same in another frame (4, 4)."""
        rotation, translation = to_T_shape[:3, :3], to_T_shape[:3, 3]
        rounds: dict[int, tuple[Array, Array]] = {
            k: (centre @ rotation.T + translation, axis @ rotation.T) for k, (centre, axis) in self.round_m.items()
        }
        return replace(
            self,
            points_m=self.points_m @ rotation.T + translation,
            round_m=rounds,
            via_m=[via @ rotation.T + translation for via in self.via_m],
        )


def model_of(
    name: str,
    shapes: Mapping[str, Shape],
    bevel_m: float,
    fingers: dict[str, FingerModel],
    jaw: JawModel | None,
    provenance: Provenance | None,
) -> GripperModel:
    """The gripper file's model.  Points are named FINGER_p1 and so on, from the tip backwards, edges FINGER_e1.
    ``bevel_m``: width of the bevels on sharp edges; ``fingers``: how each moves with the ``jaw``.
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
        for k, ((a, b), crease) in enumerate(zip(shape.edges, shape.crease, strict=True)):
            # The model has a bevel's edge anywhere in its width: 1/sqrt(12) of that is its standard deviation.
            spread_m = shape.spread_m[k] if shape.spread_m else 0.0
            edges[f"{finger}_e{k + 1}"] = EdgeModel(
                start=names[a],
                end=names[b],
                kind="crease" if crease else "contour",
                brighter=shape.brighter.get(k, "any"),
                bevel_m=round(min(math.sqrt(12.0) * spread_m, WIDEST_BEVEL_M), _DIGITS) if spread_m else bevel_m,
                via=tuple(map(_rounded, shape.via_m[k])) if shape.via_m else (),
            )
        faces += [FaceModel(finger=finger, points=tuple(names[p] for p in loop)) for loop in shape.loops]
    return GripperModel(
        name=name, fingers=fingers, points=points, edges=edges, jaw=jaw, faces=tuple(faces), provenance=provenance
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
