"""Fingers' shapes as a gripper model, and the model as a file with comments."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import msgspec
import yaml

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


def gripper_text(model: GripperModel, notes: Sequence[str]) -> str:
    """The file, commented as those in ``configs/grippers``; values at their default are left out."""
    return "\n".join(_lines(model, notes)) + "\n"


def _lines(model: GripperModel, notes: Sequence[str]) -> Iterator[str]:
    yield f"# Gripper '{model.name}', made from CAD by gripmon gripper from-cad."
    for note in notes:
        yield f"# {note}"
    yield "# Gripper frame, metres: origin at the TCP, x across the jaws, z out of it, unless a note above differs."
    yield f"name: {_flow(model.name)}  # any text; appears in recordings"
    if model.jaw is not None:
        yield "jaw:"
        yield f"  nominal_m: {model.jaw.nominal_m!r}  # jaw opening at which the coordinates below hold (m)"
        yield f"  min_m: {model.jaw.min_m!r}  # smallest opening (m)"
        yield f"  max_m: {model.jaw.max_m!r}  # largest opening (m)"
    yield "fingers:  # how each moves: `axis` (m of motion for each m of opening) or `table` (opening, dx, dy, dz, m)"
    for name, finger in model.fingers.items():
        motion = {} if finger.motion is None else {"motion": finger.motion}
        yield f"  {_flow(name)}: {_flow(motion)}"
    yield "points:  # x, y, z (m) at the nominal opening; `corner: true`: measured as a fingertip corner"
    yield "  # `round`: on the outline of a part that is round about an axis; it moves over it as the view changes"
    for name, point in model.points.items():
        yield f"  {_flow(name)}: {_flow(_without_defaults(point))}"
    yield "edges:  # between two points, straight, or curved through the points `via`; `kind`: where faces don't say,"
    yield "  # `bevel_m`: width of a bevel or rounding; an untaught edge may appear anywhere in it (m, default 0)"
    for name, edge in model.edges.items():
        yield f"  {_flow(name)}: {_flow(_without_defaults(edge))}"
    if model.faces:
        yield "faces:  # loops of points, counter-clockwise seen from outside; they decide what is visible"
        for face in model.faces:
            yield f"  - {_flow(msgspec.to_builtins(face))}"
    if model.provenance is not None:
        yield "provenance:"
        for key, value in msgspec.to_builtins(model.provenance).items():
            yield f"  {key}: {_flow(value)}"


def _without_defaults(part: PointModel | EdgeModel) -> dict[str, Any]:
    values: dict[str, Any] = msgspec.to_builtins(part)
    defaults = {"corner": False, "kind": "contour", "brighter": "any", "bevel_m": 0.0, "via": []}
    return {key: value for key, value in values.items() if key not in defaults or value != defaults[key]}


def _flow(value: Any) -> str:
    """A value as one line of YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**9, allow_unicode=True)
    return re.sub(r"\n\.\.\.$", "", text.strip())
