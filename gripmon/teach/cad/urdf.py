"""Reads a gripper's URDF: which links its joint moves, and their positions at every opening.

https://wiki.ros.org/urdf/XML: metres and radians; of a link its ``visual`` geometry, else ``collision``.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.errors import InputError
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array
from gripmon.teach.cad.files import MESHES, Body, joined, mesh_library, read_mesh

STEPS = 41
"""Number of joint positions that are evaluated: an arc of 57 mm over 0.8 rad is 2.8 um off a table of 41 rows."""

TURNS_RAD = 1e-3
"""Largest turn, over the joint's range, of a link that counts as not turning: 0.02 mm at 20 mm."""


@dataclass(frozen=True, slots=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    limits: tuple[float, float]
    mimic: tuple[str, float, float] | None

    def placed(self, values: dict[str, float]) -> Array:
        """``parent_T_child`` (4, 4) with the driving joints at ``values``."""
        name, times, plus = self.mimic or (self.name, 1.0, 0.0)
        value = times * values.get(name, 0.0) + plus
        moved = np.eye(4)
        if self.kind == "prismatic":
            moved[:3, 3] = value * self.axis
        elif self.kind in ("revolute", "continuous"):
            moved[:3, :3] = Rotation.from_rotvec(value * self.axis).as_matrix()
        return self.origin @ moved


@dataclass(frozen=True, slots=True)
class LinkGroup:
    """A group of links that move together: ``body`` in the base's frame at the middle of the joint's range, ``path_m``
    (s, 3) its shifts from there, and ``turns_rad``, its largest turn over the range.
    """

    body: Body
    path_m: Array
    turns_rad: float


@dataclass(frozen=True, slots=True)
class Linkage:
    """A URDF gripper: the bodies that the joint moves, the fixed one (``base``), and the driving ``joint``."""

    moving: list[LinkGroup]
    base: Body | None
    joint: str
    notes: list[str] = field(default_factory=list)


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.root = ElementTree.parse(path).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise InputError(f"{path}: can't be read as URDF ({error}); XML, xacro expanded") from None
        if self.root.tag != "robot":
            raise InputError(f"{path}: its root is <{self.root.tag}>; <robot>, a URDF")
        if any(
            "xacro" in part.tag or part.tag.endswith("}macro") or "${" in str(part.attrib) for part in self.root.iter()
        ):
            raise InputError(f"{path}: holds xacro macros; expand it first: xacro {path} > {path.stem}.urdf")

    def refuse(self, where: str, wrong: str) -> InputError:
        return InputError(f"{self.path}: {where}: {wrong}")

    def numbers(self, part: ElementTree.Element | None, key: str, default: str, where: str, count: int = 3) -> Array:
        text = default if part is None else part.get(key, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            raise self.refuse(where, f"{key} is '{text}'; {count} ordinary numbers")
        return values

    def origin(self, part: ElementTree.Element, where: str) -> Array:
        given = part.find("origin")
        turn = Rotation.from_euler("xyz", self.numbers(given, "rpy", "0 0 0", where)).as_matrix()
        return make_transform(turn, self.numbers(given, "xyz", "0 0 0", where))

    def joints(self) -> list[_Joint]:
        return [self._joint(part) for part in self.root.findall("joint")]

    def _joint(self, part: ElementTree.Element) -> _Joint:
        name, kind = part.get("name", "?"), part.get("type", "?")
        where = f"joint '{name}'"
        if kind not in ("fixed", "prismatic", "revolute", "continuous"):
            raise self.refuse(where, f"is of type '{kind}'; fixed, prismatic, revolute or continuous")
        parent, child = (str(end.get("link")) if (end := part.find(k)) is not None else "" for k in ("parent", "child"))
        axis = self.numbers(part.find("axis"), "xyz", "1 0 0", where)
        if kind != "fixed" and not np.linalg.norm(axis) > 0.0:
            raise self.refuse(where, "has an axis without direction; a unit vector")
        limit = part.find("limit")
        low, high = (float(self.numbers(limit, key, "0", where, 1)[0]) for key in ("lower", "upper"))
        mimic = part.find("mimic")
        follows = None
        if mimic is not None:
            times, plus = (self.numbers(mimic, k, d, where, 1)[0] for k, d in (("multiplier", "1"), ("offset", "0")))
            follows = (str(mimic.get("joint")), float(times), float(plus))
        axis = axis / max(float(np.linalg.norm(axis)), 1e-30)
        return _Joint(name, kind, parent, child, self.origin(part, where), axis, (low, high), follows)

    def bodies(self) -> dict[str, Body]:
        """Each link's geometry in its own frame; links without any are left out."""
        out = {}
        for link in self.root.findall("link"):
            name = link.get("name", "?")
            shown = link.findall("visual") or link.findall("collision")
            parts = [self._geometry(part, f"link '{name}'") for part in shown]
            if parts:
                out[name] = joined(parts, name)
        return out

    def _geometry(self, part: ElementTree.Element, where: str) -> Body:
        geometry = part.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            raise self.refuse(where, "has no geometry; a mesh, box, cylinder or sphere")
        body = self._mesh(shape, where) if shape.tag == "mesh" else self._primitive(shape, where)
        return body.moved(self.origin(part, where))

    def _mesh(self, shape: ElementTree.Element, where: str) -> Body:
        name, scale = shape.get("filename", ""), self.numbers(shape, "scale", "1 1 1", where)
        path = self._find(name)
        if path is None:
            raise self.refuse(
                where, f"its mesh '{name}' isn't there; the file beside the URDF, or the package's folder"
            )
        if path.suffix.lower() not in MESHES:
            raise self.refuse(where, f"its mesh is '{path.name}'; {', '.join(MESHES)}: convert it")
        return read_mesh(path, "m", size=False).moved(np.diag([*scale, 1.0]))

    def _find(self, name: str) -> Path | None:
        """Find a mesh file; ``package://NAME/…`` is searched for from the URDF's folder upwards."""
        plain = name.removeprefix("file://").removeprefix("package://")
        parts = Path(plain).parts
        tries = [Path(plain)] if plain.startswith("/") else []
        for folder in (self.path.resolve().parent, *self.path.resolve().parents):
            tries += [folder / plain, *([folder.joinpath(*parts[1:])] if name.startswith("package://") else [])]
        return next((path for path in tries if path.is_file()), None)

    def _primitive(self, shape: ElementTree.Element, where: str) -> Body:
        creation = mesh_library(str(self.path)).creation
        if shape.tag == "box":
            mesh = creation.box(extents=self.numbers(shape, "size", "", where))
        elif shape.tag == "cylinder":
            radius, length = (float(self.numbers(shape, key, "", where, 1)[0]) for key in ("radius", "length"))
            mesh = creation.cylinder(radius=radius, height=length, sections=96)
        elif shape.tag == "sphere":
            mesh = creation.icosphere(subdivisions=4, radius=float(self.numbers(shape, "radius", "", where, 1)[0]))
        else:
            raise self.refuse(where, f"has a <{shape.tag}>; a mesh, box, cylinder or sphere")
        triangles = np.asarray(mesh.faces, dtype=np.intp)
        return Body(shape.tag, np.asarray(mesh.vertices, dtype=float), triangles, np.zeros((0, 2), np.intp))


def read_urdf(path: Path, joint: str | None) -> Linkage:
    """Read a URDF's gripper, moved by ``joint``.  None: by the only joint that moves and mimics no other, or by two
    such joints of one kind and range on one link, together.

    Raises :class:`InputError` for a file that isn't a URDF, or whose joints don't determine which one opens the jaws.
    """
    reader = _Reader(path)
    joints, bodies = reader.joints(), reader.bodies()
    if not bodies:
        raise InputError(f"{path}: no link has a geometry; visual meshes or boxes")
    driving, together = _driving(reader, joints, joint)
    lowest, highest = driving.limits
    if not highest > lowest:
        raise reader.refuse(f"joint '{driving.name}'", f"moves from {lowest:g} to {highest:g}; limit lower < upper")
    values = np.linspace(lowest, highest, STEPS)
    poses = [_placed(joints, {name: share * v for name, share in together.items()}) for v in values.tolist()]
    groups: dict[bytes, list[str]] = {}
    for name in bodies:
        way = np.array([pose.get(name, np.eye(4)) for pose in poses])
        middle = np.linalg.inv(way[STEPS // 2])
        # Links with the same motion are one body.
        groups.setdefault(np.round(way @ middle, 9).tobytes(), []).append(name)
    moving, base = [], None
    for names in groups.values():
        way = np.array([pose.get(names[0], np.eye(4)) for pose in poses])
        body = joined([bodies[name].moved(poses[STEPS // 2].get(name, np.eye(4))) for name in names], names[0])
        if np.abs(way - way[0]).max() < 1e-9:
            base = body
            continue
        turned = Rotation.from_matrix(way[:, :3, :3]) * Rotation.from_matrix(way[STEPS // 2, :3, :3]).inv()
        turns_rad = float(turned.magnitude().max())
        moving.append(LinkGroup(body, way[:, :3, 3] - way[STEPS // 2, :3, 3], turns_rad))
    if not moving:
        raise reader.refuse(f"joint '{driving.name}'", "moves no link that has a geometry; the joint of the jaws")
    return Linkage(moving, base, driving.name)


def _driving(reader: _Reader, joints: list[_Joint], name: str | None) -> tuple[_Joint, dict[str, float]]:
    """The jaws' joint, and the joints driven with it, by name: the ratio of their values to its value."""
    free = [j for j in joints if j.kind != "fixed" and j.mimic is None]
    if name is not None:
        chosen = [j for j in free if j.name == name]
        if not chosen:
            names = ", ".join(j.name for j in free) or "none"
            raise InputError(f"{name}: {reader.path} has no such joint that drives others; one of {names}", "joint")
        return chosen[0], {name: 1.0}
    if not free:
        raise InputError(f"{reader.path}: no joint moves; prismatic or revolute joints, or its meshes by themselves")
    alike = all(j.kind == free[0].kind and j.limits == free[0].limits for j in free)
    if len(free) == 1 or (len(free) == 2 and alike and free[0].parent == free[1].parent):
        return free[0], {j.name: 1.0 for j in free}
    names = ", ".join(j.name for j in free)
    raise InputError(
        f"is missing: {reader.path} has {len(free)} joints that move by themselves; one of {names}", "joint"
    )


def _placed(joints: list[_Joint], values: dict[str, float]) -> dict[str, Array]:
    """``base_T_link`` of every link held by a joint; a link without one is at the base."""
    children = {j.child: j for j in joints}
    out: dict[str, Array] = {}

    def at(link: str, seen: tuple[str, ...]) -> Array:
        joint = children.get(link)
        if joint is None or link in seen:
            return np.eye(4)
        if link not in out:
            out[link] = at(joint.parent, (*seen, link)) @ joint.placed(values)
        return out[link]

    for link in children:
        at(link, ())
    return out
