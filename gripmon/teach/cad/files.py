"""Reads meshes and ViSP's .cao files into bodies in metres."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import InputError, one_line
from gripmon.model.gripper.faces import triangles as cut_into_triangles
from gripmon.model.records import Array

Triangles = NDArray[np.intp]

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MESHES = (".stl", ".obj", ".ply", ".dae")
LARGEST_TRIANGLES = 5_000_000
"""Most triangles: finding neighbours then takes about 2 GB of memory; no CAD export of a gripper needs more."""


@dataclass(frozen=True, slots=True)
class Body:
    """Triangles (t, 3) over points (p, 3), metres, in the frame of its file; ``lines`` (l, 2): edges that the file has
    without a face.  Triangles share their common points.
    """

    name: str
    points_m: Array
    triangles: Triangles
    lines: NDArray[np.intp]

    def moved(self, to_T_body: Array) -> Body:
        """The same in another frame (4, 4); a mirroring transform reverses the triangles."""
        triangles = self.triangles if np.linalg.det(to_T_body[:3, :3]) > 0.0 else self.triangles[:, ::-1]
        return Body(self.name, self.points_m @ to_T_body[:3, :3].T + to_T_body[:3, 3], triangles, self.lines)


def mesh_library(why: str) -> ModuleType:
    """The module trimesh; :class:`InputError` where the extra isn't installed."""
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{why}: needs the package trimesh; pip install 'gripmon[cad]'") from None
    return trimesh


def read_mesh(path: Path, unit: str | None, *, size: bool = True) -> Body:
    """Read a mesh in metres; ``unit`` is one of :data:`UNITS_M`.  ``size``: refuse one that can't be a gripper's.

    Raises :class:`InputError` for a file that can't be read, has no triangles or too many, or whose unit wasn't given:
    of these formats only DAE contains it.  Its up axis is ignored, as ROS does.
    """
    trimesh = mesh_library(str(path))
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; a mesh ({', '.join(MESHES)}), URDF or .cao")
    collada = path.suffix.lower() == ".dae"
    if collada and importlib.util.find_spec("collada") is None:
        raise InputError(f"{path}: needs the package pycollada; pip install 'gripmon[cad]'")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        if collada:
            mesh.apply_scale(trimesh.units.unit_conversion(mesh.units or "meters", "meters"))
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        points, triangles = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.intp)
    except Exception as error:  # noqa: BLE001  trimesh raises anything for a damaged file
        # A binary STL that is cut off is tried as text, for which trimesh wants one more library.
        cut_off = isinstance(error, ModuleNotFoundError)
        why = "it is damaged or cut off" if cut_off else f"{one_line(error):.120}"
        raise InputError(f"{path}: can't be read as a mesh ({why}); {', '.join(MESHES)} with triangles") from None
    if not len(triangles):
        raise InputError(f"{path}: has no triangles, or is cut off; a mesh of the fingers' surface")
    if len(triangles) > LARGEST_TRIANGLES:
        raise InputError(f"{path}: {len(triangles)} triangles; at most {LARGEST_TRIANGLES}, exported more coarsely")
    if not np.isfinite(points[triangles]).all():
        raise InputError(f"{path}: holds a coordinate that is not finite; ordinary numbers")
    extent = np.ptp(points[np.unique(triangles)], axis=0)
    unit = "m" if collada else unit
    if unit is None:
        raise InputError(f"is missing: {path} has no unit; {_as_units(extent)}", "unit")
    body = Body(path.stem, points * UNITS_M[unit], triangles, np.zeros((0, 2), np.intp))
    return checked_size(body, str(path), extent, "unit") if size else body


def checked_size(body: Body, what: str, extent: Array, argument: str) -> Body:
    """The body; :class:`InputError` if it is smaller than a finger's detail or larger than a robot's hand."""
    size_m = float(np.ptp(body.points_m, axis=0).max())
    if not 1e-3 <= size_m <= 1.0:
        raise InputError(f"{what} would be {1e3 * size_m:g} mm long; {_as_units(extent)}", argument)
    return body


def _as_units(extent: Array) -> str:
    """The extents (3,) of a file's numbers in each possible unit."""

    def rounded(value: float) -> str:
        return f"{float(f'{value:.3g}'):.7g}"  # to three digits, without a power of ten

    size = " x ".join(map(rounded, extent))
    sizes = (f"{unit}: {rounded(1e3 * float(extent.max()) * scale)} mm long" for unit, scale in UNITS_M.items())
    return f"it spans {size}, that is in {', in '.join(sizes)}; one of {', '.join(UNITS_M)}"


def separate(body: Body) -> list[Body]:
    """The body's connected pieces, the largest first; pieces of lines alone count, too."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([body.triangles[:, [0, 1]], body.triangles[:, [1, 2]], body.lines])
    count = len(body.points_m)
    graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    of_triangle, of_line = label[body.triangles[:, 0]], label[body.lines[:, 0]]
    used = np.unique(np.concatenate([of_triangle, of_line]))
    pieces = []
    for one in used:
        points = np.flatnonzero(label == one)
        renumbered = np.zeros(count, dtype=np.intp)
        renumbered[points] = np.arange(len(points))
        own = renumbered[body.triangles[of_triangle == one]], renumbered[body.lines[of_line == one]]
        pieces.append(Body(body.name, body.points_m[points], *own))
    return sorted(pieces, key=lambda piece: -float(np.prod(np.ptp(piece.points_m, axis=0) + 1e-6)))


def joined(bodies: list[Body], name: str) -> Body:
    """Several bodies as one."""
    first = np.cumsum([0] + [len(b.points_m) for b in bodies[:-1]]).tolist()
    return Body(
        name,
        np.concatenate([b.points_m for b in bodies]),
        np.concatenate([b.triangles + n for b, n in zip(bodies, first, strict=True)]),
        np.concatenate([b.lines + n for b, n in zip(bodies, first, strict=True)]),
    )


class _Cao:
    """Reads the lines of a .cao file, without comments, one after another."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: can't be read ({error}); a .cao file of ViSP's") from None
        bare = (re.sub(r"(#|//).*", "", line).strip() for line in text.splitlines())
        self._lines: Iterator[tuple[int, list[str]]] = iter(
            [(number, line.split()) for number, line in enumerate(bare, start=1) if line]
        )
        self.number, words = next(self._lines, (1, [""]))
        if words[0].upper() != "V1":
            self.refuse("doesn't begin with V1; ViSP's format of 3D models, version 1")

    def refuse(self, wrong: str) -> NoReturn:
        raise InputError(f"{self.path}, line {self.number}: {wrong}")

    def words(self) -> list[str]:
        """The next line's words, without settings such as ``name=…``; empty at the end."""
        self.number, words = next(self._lines, (self.number, []))
        if words and words[0].startswith("load("):
            self.refuse("loads another file; the models in one file")
        return [word for word in words if "=" not in word]

    def count(self, what: str) -> int:
        """The number of items that follow; 0 at the end of the file."""
        words = self.words()
        if not words:
            return 0
        if not words[0].isdecimal():
            self.refuse(f"'{words[0]}' is not a number of {what}; a whole number")
        return int(words[0])

    def indices(self, count: int, below: int, what: str) -> list[int]:
        """The next line's indices, at least ``count`` of them, from 0 to ``below`` - 1."""
        words = self.words()
        if len(words) < count or not all(word.isdecimal() and int(word) < below for word in words):
            self.refuse(f"'{' '.join(words)}' is not {what}; at least {count} numbers from 0 to {below - 1}")
        return [int(word) for word in words]

    def numbers(self, count: int, what: str) -> list[float]:
        words = self.words()
        try:
            values = [float(word) for word in words[:count]]
        except ValueError:
            values = []
        if len(values) < count or not np.isfinite(values).all():
            self.refuse(f"'{' '.join(words)}' is not {what}; {count} ordinary numbers")
        return values


def read_cao(path: Path) -> Body:
    """Read a 3D model of ViSP's (https://visp-doc.inria.fr, tutorial "Markerless generic model-based tracking"),
    metres: points, lines, faces of lines, faces of points, cylinders, circles.  Faces that aren't flat become
    triangles.
    """
    cao = _Cao(path)
    points = [cao.numbers(3, "a point") for _ in range(cao.count("points"))]
    most = len(points)
    lines = [cao.indices(2, most, "a line's two points")[:2] for _ in range(cao.count("lines"))]
    loops = []
    for _ in range(cao.count("faces")):
        _, *sides = cao.indices(4, max(len(lines), most) + 1, "a face's lines")
        loops.append(_loop_of_lines(cao, [lines[k] for k in sides]))
    for _ in range(cao.count("faces")):
        number, *loop = cao.indices(4, most + 1, "a face's points")
        if len(loop) != number or max(loop) >= most:
            cao.refuse(f"names {len(loop)} points, not {number}, or one that isn't there; the points in turn")
        loops.append(loop)
    places = np.reshape(np.array(points, dtype=float), (-1, 3))
    if not most:
        cao.refuse("has no points; at least three")
    whole = [Body(path.stem, places, _triangles_of(path, places, loops), np.reshape(lines, (-1, 2)).astype(np.intp))]
    whole += [_cylinder(cao, places) for _ in range(cao.count("cylinders"))]
    for _ in range(cao.count("circles")):
        radius, a, b, c = cao.numbers(4, "a circle's radius and three points")
        whole.append(_disc(radius, places[[int(a), int(b), int(c)]]))
    body = joined(whole, path.stem)
    return checked_size(body, str(path), np.ptp(body.points_m, axis=0), "")


def _loop_of_lines(cao: _Cao, sides: list[list[int]]) -> list[int]:
    """The corners of a face given by consecutive lines."""
    loop = []
    for one, after in zip(sides, [*sides[1:], sides[0]], strict=True):
        common = set(one) & set(after)
        if len(common) != 1:
            cao.refuse("its lines don't follow each other; the lines in turn around the face")
        loop.append(common.pop())
    return [*loop[-1:], *loop[:-1]]


def _triangles_of(path: Path, points_m: Array, loops: list[list[int]]) -> Triangles:
    out = []
    for number, loop in enumerate(loops):
        parts = cut_into_triangles(points_m[loop])
        if parts is None:
            raise InputError(f"{path}, face {number}: crosses itself; the points in turn around the face")
        out += [[loop[k] for k in part] for part in parts]
    return np.reshape(np.array(out, dtype=np.intp), (-1, 3))


_ROUND = 96  # sides of a .cao file's circles: 0.0043 mm off a circle of 8 mm


def _ring(radius_m: float, centre: Array, axis: Array) -> Array:
    """Points (n, 3) of a circle."""
    across = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    across /= np.linalg.norm(across)
    turn = 2.0 * np.pi * np.arange(_ROUND)[:, None] / _ROUND
    return centre + radius_m * (np.cos(turn) * across + np.sin(turn) * np.cross(axis, across))


def _cylinder(cao: _Cao, points_m: Array) -> Body:
    words = cao.numbers(3, "a cylinder's two points and radius")
    ends = points_m[[int(words[0]), int(words[1])]]
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    rings = np.concatenate([_ring(words[2], end, axis) for end in ends])
    k, j = np.arange(_ROUND), np.roll(np.arange(_ROUND), -1)
    wall = np.concatenate([np.column_stack([k, j, j + _ROUND]), np.column_stack([k, j + _ROUND, k + _ROUND])])
    return Body("cylinder", rings, wall.astype(np.intp), np.zeros((0, 2), np.intp))


def _disc(radius_m: float, places: Array) -> Body:
    normal = np.cross(places[1] - places[0], places[2] - places[0])
    ring = _ring(radius_m, places[0], normal / np.linalg.norm(normal))
    fan = [(0, k, k + 1) for k in range(1, _ROUND - 1)]
    return Body("circle", ring, np.array(fan, dtype=np.intp), np.zeros((0, 2), np.intp))
