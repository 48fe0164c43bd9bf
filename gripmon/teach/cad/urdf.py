"""Reads a URDF's links and joints.

https://wiki.ros.org/urdf/XML: metres and radians; of a link its ``visual`` geometry, else ``collision``.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.errors import InputError
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array
from gripmon.teach.cad.files import MESHES, ROUND, joined, mesh_library, read_mesh

if TYPE_CHECKING:
    from trimesh import Trimesh


class NoMeshError(InputError):
    """A link's mesh isn't there, or nothing here reads it."""


@dataclass(frozen=True, slots=True)
class Joint:
    """``parent_T_child`` at zero is ``origin`` (4, 4); ``axis`` (3,) in the child's frame; ``mimic``: the joint that it
    follows, factor, offset.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    limits: tuple[float, float]
    mimic: tuple[str, float, float] | None

    @property
    def range(self) -> float:
        return self.limits[1] - self.limits[0]

    def placed(self, values: dict[str, float]) -> Array:
        """``parent_T_child`` (4, 4) with the joints at ``values``; those that it doesn't name at zero."""
        name, times, plus = self.mimic or (self.name, 1.0, 0.0)
        value = times * values.get(name, 0.0) + plus
        moved = np.eye(4)
        if self.kind == "prismatic":
            moved[:3, 3] = value * self.axis
        elif self.kind in ("revolute", "continuous"):
            moved[:3, :3] = Rotation.from_rotvec(value * self.axis).as_matrix()
        return self.origin @ moved


class Urdf:
    """A file's links and joints.  :class:`InputError` for a file that isn't a URDF."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        try:
            root = ElementTree.parse(path).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise InputError(f"{path}: can't be read as URDF ({error}); XML, xacro expanded") from None
        if root.tag != "robot":
            raise InputError(f"{path}: its root is <{root.tag}>; <robot>, a URDF")
        if any("xacro" in part.tag or part.tag.endswith("}macro") or "${" in str(part.attrib) for part in root.iter()):
            raise InputError(f"{path}: holds xacro macros; expand it first: xacro {path} > {path.stem}.urdf")
        self._links = {link.get("name", "?"): link for link in root.findall("link")}
        self.joints = [self._joint(part) for part in root.findall("joint")]
        self._holding = {joint.child: joint for joint in self.joints}
        leading = {joint.name for joint in self.joints if joint.mimic is None}
        for joint in self.joints:
            if joint.mimic is not None and joint.mimic[0] not in leading:
                raise self.refuse(f"joint '{joint.name}'", f"follows '{joint.mimic[0]}'; a joint that follows no other")
        self.shown = [n for n, link in self._links.items() if link.findall("visual") or link.findall("collision")]
        if not self.shown:
            raise InputError(f"{path}: no link has a geometry; visual meshes or boxes")

    def refuse(self, where: str, wrong: str) -> InputError:
        return InputError(f"{self.path}: {where}: {wrong}")

    def base_of(self, link: str) -> str:
        """The link that carries ``link`` rigidly, and that no fixed joint carries further."""
        seen = {link}
        while (joint := self._holding.get(link)) is not None and joint.kind == "fixed" and joint.parent not in seen:
            link = joint.parent
            seen.add(link)
        return link

    def moved_by(self, joint: Joint) -> list[str]:
        """The links with a geometry that a joint moves, and those that follow it."""
        ends = {joint.child, *(j.child for j in self.joints if j.mimic and j.mimic[0] == joint.name)}
        return [name for name in self.shown if ends & set(self.up(name))]

    def placed(self, base: str, values: dict[str, float]) -> dict[str, Array]:
        """``base_T_link`` of every link with a geometry that ``base`` carries, the joints at ``values``."""
        return {name: self.carried(base, name, values) for name in self.shown if base in self.up(name)}

    def carried(self, base: str, link: str, values: dict[str, float]) -> Array:
        """``base_T_link`` (4, 4) of a link that ``base`` carries."""
        way, base_T_link = self.up(link), np.eye(4)
        for each in way[: way.index(base)]:
            base_T_link = self._holding[each].placed(values) @ base_T_link
        return base_T_link

    def up(self, link: str) -> list[str]:
        """The link, its parent, and so on."""
        way = [link]
        while (joint := self._holding.get(way[-1])) is not None and joint.parent not in way:
            way.append(joint.parent)
        return way

    def numbers(self, part: ElementTree.Element | None, key: str, default: str, where: str, count: int = 3) -> Array:
        text = default if part is None else part.get(key, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            raise self.refuse(where, f"{key} is '{text}'; {count} ordinary numbers")
        return values

    def _origin(self, part: ElementTree.Element, where: str) -> Array:
        given = part.find("origin")
        turn = Rotation.from_euler("xyz", self.numbers(given, "rpy", "0 0 0", where)).as_matrix()
        return make_transform(turn, self.numbers(given, "xyz", "0 0 0", where))

    def _joint(self, part: ElementTree.Element) -> Joint:
        name, kind = part.get("name", "?"), part.get("type", "?")
        where = f"joint '{name}'"
        if kind not in ("fixed", "prismatic", "revolute", "continuous"):
            raise self.refuse(where, f"is of type '{kind}'; fixed, prismatic, revolute or continuous")
        parent, child = (str(end.get("link")) if (end := part.find(k)) is not None else "" for k in ("parent", "child"))
        if not (parent and child):
            raise self.refuse(where, "has no parent or no child; a link each")
        axis = self.numbers(part.find("axis"), "xyz", "1 0 0", where)
        if kind != "fixed" and not np.linalg.norm(axis) > 0.0:
            raise self.refuse(where, "has an axis without direction; a unit vector")
        limit = next((each for each in part.findall("limit") if each.get("lower") or each.get("upper")), None)
        low, high = (float(self.numbers(limit, key, "0", where, 1)[0]) for key in ("lower", "upper"))
        mimic = part.find("mimic")
        follows = None
        if mimic is not None:
            times, plus = (self.numbers(mimic, k, d, where, 1)[0] for k, d in (("multiplier", "1"), ("offset", "0")))
            follows = (str(mimic.get("joint")), float(times), float(plus))
        axis = axis / max(float(np.linalg.norm(axis)), 1e-30)
        return Joint(name, kind, parent, child, self._origin(part, where), axis, (low, high), follows)

    def body(self, name: str) -> Trimesh:
        """A link's geometry in its own frame.  A visual mesh that can't be read is replaced by the collision's, with a
        note: that may be coarser.
        """
        visual, collision = self._links[name].findall("visual"), self._links[name].findall("collision")
        try:
            return joined([self._geometry(part, f"link '{name}'") for part in visual or collision])
        except NoMeshError as error:
            if not (visual and collision):
                raise
            try:
                body = joined([self._geometry(part, f"link '{name}'") for part in collision])
            except NoMeshError:
                raise error from None
            self.notes.append(f"link '{name}': its collision mesh is used, which may be coarser; {error.wrong}")
            return body

    def _geometry(self, part: ElementTree.Element, where: str) -> Trimesh:
        geometry = part.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            raise self.refuse(where, "has no geometry; a mesh, box, cylinder or sphere")
        body = self._mesh(shape, where) if shape.tag == "mesh" else self._primitive(shape, where)
        return body.apply_transform(self._origin(part, where))

    def _mesh(self, shape: ElementTree.Element, where: str) -> Trimesh:
        name, scale = shape.get("filename", ""), self.numbers(shape, "scale", "1 1 1", where)
        path = self._find(name)
        if path is None:
            right = "the file beside the URDF, or the package's folder"
            raise NoMeshError(f"{self.path}: {where}: its mesh '{name}' isn't there; {right}")
        if path.suffix.lower() not in MESHES:
            raise NoMeshError(f"{self.path}: {where}: its mesh is '{path.name}'; {', '.join(MESHES)}: convert it")
        try:
            return read_mesh(path, "m", size=False).apply_transform(np.diag([*scale, 1.0]))
        except InputError as error:
            raise NoMeshError(error.wrong) from None

    def _find(self, name: str) -> Path | None:
        """Find a mesh file; ``package://NAME/…`` is searched for from the URDF's folder upwards."""
        plain = name.removeprefix("file://").removeprefix("package://")
        parts = Path(plain).parts
        tries = [Path(plain)] if plain.startswith("/") else []
        for folder in (self.path.resolve().parent, *self.path.resolve().parents):
            tries += [folder / plain, *([folder.joinpath(*parts[1:])] if name.startswith("package://") else [])]
        return next((path for path in tries if path.is_file()), None)

    def _primitive(self, shape: ElementTree.Element, where: str) -> Trimesh:
        creation = mesh_library(str(self.path)).creation
        if shape.tag == "box":
            return creation.box(extents=self.numbers(shape, "size", "", where))
        if shape.tag == "cylinder":
            radius, length = (float(self.numbers(shape, key, "", where, 1)[0]) for key in ("radius", "length"))
            return creation.cylinder(radius=radius, height=length, sections=ROUND)
        if shape.tag == "sphere":
            return creation.icosphere(subdivisions=4, radius=float(self.numbers(shape, "radius", "", where, 1)[0]))
        raise self.refuse(where, f"has a <{shape.tag}>; a mesh, box, cylinder or sphere")
