"""Reads a gripper's URDF: which links its joints move, and where they are at every opening.

https://wiki.ros.org/urdf/XML: metres and radians; of a link its ``visual`` geometry, else ``collision``.  The joints
are settled before any mesh is read, and only what the gripper's own base carries is read: an arm isn't.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.errors import InputError
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array
from gripmon.teach.cad.files import MESHES, Body, joined, mesh_library, read_mesh

STEPS = 41
"""Number of joint positions that are evaluated: an arc of 57 mm over 0.8 rad is 2.8 um off a table of 41 rows."""

TURNS_RAD = 1e-3
"""Largest turn, over the joint's range, of a link that counts as not turning: 0.02 mm at 20 mm."""

PAIR_COSINE = 0.9998
"""Axes of two jaws' joints are along one line to 1.1 degrees."""

PAIR_SHARE = 0.02
"""Largest difference of the ranges of two joints that move as a pair, over the range."""

NUMBERS = partial(np.linspace, 0.0, 1.0, STEPS)


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


@dataclass(frozen=True, slots=True)
class Drive:
    """What moves the jaws: by joint the position at the start and at the end of their way, and the positions of joints
    that ``stand``.
    """

    ways: dict[str, tuple[float, float]]
    stand: dict[str, float]
    notes: tuple[str, ...] = ()

    def values(self, share: float) -> dict[str, float]:
        return {**self.stand, **{name: a + share * (b - a) for name, (a, b) in self.ways.items()}}


@dataclass(frozen=True, slots=True)
class LinkGroup:
    """Links that move together: ``body`` in the base's frame as drawn, at the middle of the jaws' way or where the
    joints stand, ``path_m`` (s, 3) its shifts along the way, ``turns_rad`` its largest turn on it.
    """

    links: tuple[str, ...]
    body: Body
    path_m: Array
    turns_rad: float


@dataclass(frozen=True, slots=True)
class Linkage:
    """A URDF gripper in the frame of ``base``, the link that carries it: what the joints move, what stays (by link),
    and ``pivot``, place and direction (2, 3) of the first joint's axis if it turns.  ``moves``: whether the jaws move
    in the file.
    """

    joint: str
    base: str
    moving: list[LinkGroup]
    still: dict[str, Body]
    pivot: Array | None
    moves: bool
    notes: list[str] = field(default_factory=list)


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
        return [name for name in self.shown if ends & set(self._up(name))]

    def placed(self, base: str, values: dict[str, float]) -> dict[str, Array]:
        """``base_T_link`` of every link with a geometry that ``base`` carries, the joints at ``values``."""
        out = {}
        for name in self.shown:
            way = self._up(name)
            if base in way:
                carried = [self._holding[link].placed(values) for link in way[: way.index(base)]]
                out[name] = np.linalg.multi_dot([np.eye(4), *reversed(carried), np.eye(4)])
        return out

    def _up(self, link: str) -> list[str]:
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

    def body(self, name: str) -> Body:
        """A link's geometry in its own frame.  A visual mesh that can't be read is replaced by the collision's, with a
        note: that may be coarser.
        """
        visual, collision = self._links[name].findall("visual"), self._links[name].findall("collision")
        try:
            return joined([self._geometry(part, f"link '{name}'") for part in visual or collision], name)
        except NoMeshError as error:
            if not (visual and collision):
                raise
            try:
                body = joined([self._geometry(part, f"link '{name}'") for part in collision], name)
            except NoMeshError:
                raise error from None
            self.notes.append(f"link '{name}': its collision mesh is used, which may be coarser; {error.wrong}")
            return body

    def _geometry(self, part: ElementTree.Element, where: str) -> Body:
        geometry = part.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            raise self.refuse(where, "has no geometry; a mesh, box, cylinder or sphere")
        body = self._mesh(shape, where) if shape.tag == "mesh" else self._primitive(shape, where)
        return body.moved(self._origin(part, where))

    def _mesh(self, shape: ElementTree.Element, where: str) -> Body:
        name, scale = shape.get("filename", ""), self.numbers(shape, "scale", "1 1 1", where)
        path = self._find(name)
        if path is None:
            right = "the file beside the URDF, or the package's folder"
            raise NoMeshError(f"{self.path}: {where}: its mesh '{name}' isn't there; {right}")
        if path.suffix.lower() not in MESHES:
            raise NoMeshError(f"{self.path}: {where}: its mesh is '{path.name}'; {', '.join(MESHES)}: convert it")
        try:
            return read_mesh(path, "m", size=False).moved(np.diag([*scale, 1.0]))
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
    """Read a URDF's gripper.  ``joint``: NAME of the joint that opens the jaws, NAME=POSITION of one that stands there
    (m or rad), or two of these with a comma.  None: the only joint that moves by itself, or the only two if they are a
    pair: siblings that run the same way in opposite directions.

    :class:`InputError` for a file that isn't a URDF, or whose joints don't determine which opens the jaws; it comes
    before any mesh is read.
    """
    urdf = Urdf(path)
    drive = _driving(urdf, joint)
    first = next(j for j in urdf.joints if j.name == next(iter({**drive.ways, **drive.stand})))
    base = urdf.base_of(first.parent)
    # Where the jaws stand, a sweep of the joint tells what it moves.
    swept = drive if drive.ways else Drive({name: (v - 0.1, v + 0.1) for name, v in drive.stand.items()}, {})
    poses = [urdf.placed(base, swept.values(share)) for share in NUMBERS().tolist()]
    drawn = poses[STEPS // 2]
    bodies = {name: urdf.body(name).moved(drawn[name]) for name in drawn}
    groups: dict[bytes, list[str]] = {}
    still = {}
    for name in drawn:
        way = np.array([pose[name] for pose in poses])
        if np.abs(way - way[0]).max() < 1e-9:
            still[name] = bodies[name]
        else:  # links with the same motion are one body
            groups.setdefault(np.round(way @ invert(drawn[name]), 9).tobytes(), []).append(name)
    moving = []
    for names in groups.values():
        way = np.array([pose[names[0]] for pose in poses])
        turned = Rotation.from_matrix(way[:, :3, :3]) * Rotation.from_matrix(drawn[names[0]][:3, :3]).inv()
        body = joined([bodies[name] for name in names], names[0])
        moving.append(
            LinkGroup(tuple(names), body, way[:, :3, 3] - drawn[names[0]][:3, 3], float(turned.magnitude().max()))
        )
    if not moving:
        raise urdf.refuse(f"joint '{first.name}'", "moves no link that has a geometry; the joint of the jaws")
    pivot = None
    if first.kind != "prismatic":
        at = _carried(urdf, base, first)
        pivot = np.stack([at[:3, 3], at[:3, :3] @ first.axis])
    return Linkage(first.name, base, moving, still, pivot, bool(drive.ways), [*drive.notes, *urdf.notes])


def _carried(urdf: Urdf, base: str, joint: Joint) -> Array:
    """``base_T_joint`` (4, 4), all joints at zero."""
    transform = joint.origin
    link = joint.parent
    while link != base and (holding := next((j for j in urdf.joints if j.child == link), None)) is not None:
        transform, link = holding.placed({}) @ transform, holding.parent
    return transform


def _driving(urdf: Urdf, text: str | None) -> Drive:
    """What opens the jaws: what ``--joint`` names, and with it its twin."""
    free = {j.name: j for j in urdf.joints if j.kind != "fixed" and j.mimic is None and urdf.moved_by(j)}
    if text is None:
        if not free:
            right = "prismatic or revolute joints, or its meshes by themselves"
            raise InputError(f"{urdf.path}: no joint moves; {right}")
        if len(free) == 1 or (len(free) == 2 and _twin(urdf, *free.values())):
            return _ways(urdf, list(free.values()), {}, ())
        leading = {j.mimic[0] for j in urdf.joints if j.mimic} & set(free)
        hint = f" ({', '.join(sorted(leading))} also leads others)" if leading else ""
        raise InputError(
            f"is missing: {urdf.path} has {len(free)} joints that move by themselves; one of {', '.join(free)}{hint}",
            "joint",
        )
    asked = _asked(text)
    strange = next((name for name in asked if name not in free), None)
    if strange is not None:
        follows = next((j.mimic[0] for j in urdf.joints if j.name == strange and j.mimic), None)
        raise InputError(
            f"{strange}: {urdf.path} has no such joint that drives others; "
            + (follows or f"one of {', '.join(free) or 'none'}"),
            "joint",
        )
    stand = {name: value for name, value in asked.items() if value is not None}
    chosen = [free[name] for name in asked if name not in stand]
    if len(chosen) > 2:
        raise InputError(
            f"{text}: opens the jaws by {len(chosen)} joints; one or two, the others as NAME=0.01", "joint"
        )
    first = free[next(iter(asked))]
    notes: tuple[str, ...] = ()
    others = [j for name, j in free.items() if name not in asked and _siblings(urdf, first, j)]
    if others:
        if len(others) == len(chosen) == 1 and _twin(urdf, chosen[0], others[0]):
            chosen.append(others[0])
            notes = (f"joint '{others[0].name}' opens the jaws together with '{first.name}'",)
        else:
            left = others[0]
            link = urdf.moved_by(left)[0]
            raise InputError(
                f"{text}: leaves out link '{link}', which joint '{left.name}' moves; {first.name},{left.name} if both "
                f"open the jaws, or {text},{left.name}=POSITION where it stands",
                "joint",
            )
    return _ways(urdf, chosen, stand, notes)


def _asked(text: str) -> dict[str, float | None]:
    """Joints by name, with their positions where they stand."""
    asked: dict[str, float | None] = {}
    for word in text.split(","):
        name, equals, position = word.strip().partition("=")
        try:
            asked[name] = float(position) if equals else None
        except ValueError:
            raise InputError(f"'{word}' isn't NAME=POSITION; a number, in metres or radians", "joint") from None
        if equals and not np.isfinite(float(position)):
            raise InputError(f"'{word}': is not a position; an ordinary number, in metres or radians", "joint")
    return asked


def _siblings(urdf: Urdf, one: Joint, other: Joint) -> bool:
    return urdf.base_of(one.parent) == urdf.base_of(other.parent)


def _against(urdf: Urdf, one: Joint, other: Joint) -> float:
    """Cosine between the axes of two joints on one base."""
    base = urdf.base_of(one.parent)
    a, b = (_carried(urdf, base, j)[:3, :3] @ j.axis for j in (one, other))
    return float(a @ b)


def _twin(urdf: Urdf, one: Joint, other: Joint) -> bool:
    """Whether two joints move a pair of jaws: on one base, along (or about) parallel axes, over ranges of one size."""
    alike = one.kind == other.kind and _siblings(urdf, one, other) and one.range > 0.0
    return (
        alike
        and abs(one.range - other.range) <= PAIR_SHARE * one.range
        and abs(_against(urdf, one, other)) >= PAIR_COSINE
    )


def _ways(urdf: Urdf, chosen: list[Joint], stand: dict[str, float], notes: tuple[str, ...]) -> Drive:
    """The way of each joint over its range; of two the second in the other direction in space."""
    for joint in chosen:
        if not joint.range > 0.0:
            raise urdf.refuse(
                f"joint '{joint.name}'",
                f"moves from {joint.limits[0]:g} to {joint.limits[1]:g}; limit lower < upper",
            )
    ways = {joint.name: joint.limits for joint in chosen}
    if len(chosen) == 2 and _siblings(urdf, *chosen) and _against(urdf, *chosen) > 0.0:
        ways[chosen[1].name] = (chosen[1].limits[1], chosen[1].limits[0])
    return Drive(ways, stand, notes)
