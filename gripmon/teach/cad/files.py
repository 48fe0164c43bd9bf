"""Reads meshes and ViSP's .cao files as meshes of trimesh, in metres."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import InputError, one_line
from gripmon.model.gripper.faces import triangles as cut_into_triangles
from gripmon.model.records import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MESHES = (".stl", ".obj", ".ply", ".dae")
LARGEST_TRIANGLES = 5_000_000
"""Most triangles: finding neighbours then takes about 2 GB of memory; no CAD export of a gripper needs more."""
ROUND = 96
"""Sides of a round part that a file gives by its radius: 0.0043 mm off a circle of 8 mm."""


def mesh_library(why: str) -> ModuleType:
    """The module trimesh; :class:`InputError` where the extra isn't installed."""
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{why}: needs the package trimesh; pip install 'gripmon[cad]'") from None
    return trimesh


def read_mesh(path: Path, unit: str | None, *, size: bool = True) -> Trimesh:
    """Read a mesh in metres; ``unit`` is one of :data:`UNITS_M`.  ``size``: refuse one that can't be a gripper's.

    Raises :class:`InputError` for a file that can't be read, has no triangles or too many, or whose unit wasn't given:
    of these formats only DAE contains it.  Its up axis is ignored, as ROS does.
    """
    trimesh = mesh_library(str(path))
    collada = path.suffix.lower() == ".dae"
    if collada and importlib.util.find_spec("collada") is None:
        raise InputError(f"{path}: needs the package pycollada; pip install 'gripmon[cad]'")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        if collada:
            mesh.apply_scale(trimesh.units.unit_conversion(mesh.units or "meters", "meters"))
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)  # without its looks
        mesh.remove_unreferenced_vertices()
    except Exception as error:  # noqa: BLE001  trimesh raises anything for a damaged file
        # A binary STL that is cut off is tried as text, for which trimesh wants one more library.
        cut_off = isinstance(error, ModuleNotFoundError)
        why = "it is damaged or cut off" if cut_off else f"{one_line(error):.120}"
        raise InputError(f"{path}: can't be read as a mesh ({why}); {', '.join(MESHES)} with triangles") from None
    if not len(mesh.faces):
        raise InputError(f"{path}: has no triangles, or is cut off; a mesh of the fingers' surface")
    if len(mesh.faces) > LARGEST_TRIANGLES:
        raise InputError(f"{path}: {len(mesh.faces)} triangles; at most {LARGEST_TRIANGLES}, exported more coarsely")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: holds a coordinate that is not finite; ordinary numbers")
    extent = mesh.extents
    unit = "m" if collada else unit
    if unit is None:
        raise InputError(f"is missing: {path} has no unit; {_as_units(extent)}", "unit")
    mesh.apply_scale(UNITS_M[unit])
    return checked_size(mesh, str(path), extent, "unit") if size else mesh


def checked_size(mesh: Trimesh, what: str, extent: Array, argument: str) -> Trimesh:
    """The mesh; :class:`InputError` if it is smaller than a finger's detail or larger than a robot's hand."""
    size_m = float(mesh.extents.max())
    if not 1e-3 <= size_m <= 1.0:
        raise InputError(f"{what} would be {1e3 * size_m:g} mm long; {_as_units(extent)}", argument)
    return mesh


def _as_units(extent: Array) -> str:
    """The extents (3,) of a file's numbers in each possible unit."""

    def rounded(value: float) -> str:
        return f"{float(f'{value:.3g}'):.7g}"  # to three digits, without a power of ten

    size = " x ".join(map(rounded, extent))
    sizes = (f"{unit}: {rounded(1e3 * float(extent.max()) * scale)} mm long" for unit, scale in UNITS_M.items())
    return f"it spans {size}, that is in {', in '.join(sizes)}; one of {', '.join(UNITS_M)}"


def separate(mesh: Trimesh) -> list[Trimesh]:
    """The mesh's connected pieces, the largest first."""
    graph = mesh_library("bodies").graph
    label = graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))[mesh.faces[:, 0]]
    pieces: list[Trimesh] = mesh.submesh([np.flatnonzero(label == one) for one in np.unique(label)], repair=False)  # type: ignore[assignment]
    return sorted(pieces, key=lambda piece: -float(np.prod(piece.extents + 1e-6)))


def joined(meshes: list[Trimesh]) -> Trimesh:
    """Several meshes as one."""
    return mesh_library("bodies").util.concatenate(meshes)


class _Cao:
    """Reads a .cao file section by section; of its lines what isn't a comment."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: can't be read ({error}); a .cao file of ViSP's") from None
        bare = (re.sub(r"(#|//).*", "", line).split() for line in text.splitlines())
        self._lines = iter([(number, words) for number, words in enumerate(bare, start=1) if words])
        self.number, words = next(self._lines, (1, [""]))
        if words[0].upper() != "V1":
            self.refuse("doesn't begin with V1; ViSP's format of 3D models, version 1")

    def refuse(self, wrong: str) -> NoReturn:
        raise InputError(f"{self.path}, line {self.number}: {wrong}")

    def _words(self) -> list[str]:
        """The next line's words, without settings such as ``name=…``; empty at the end."""
        self.number, words = next(self._lines, (self.number, []))
        if words and words[0].startswith("load("):
            self.refuse("loads another file; the models in one file")
        return [word for word in words if "=" not in word]

    def section(self, name: str, one: str, count: int) -> Iterator[list[float]]:
        """The first ``count`` numbers of each line of the next section; none where the file has ended."""
        for words in self._lines_of(name):
            try:
                values = [float(word) for word in words[:count]]
            except ValueError:
                values = []
            if len(values) < count or not np.isfinite(values).all():
                self.refuse(f"'{' '.join(words)}' is not {one}; {count} ordinary numbers")
            yield values

    def indices(self, name: str, one: str, count: int, below: int) -> Iterator[list[int]]:
        """The same of indices, at least ``count`` of them, from 0 to ``below`` - 1."""
        for words in self._lines_of(name):
            if len(words) < count or not all(word.isdecimal() and int(word) < below for word in words):
                self.refuse(f"'{' '.join(words)}' is not {one}; at least {count} numbers from 0 to {below - 1}")
            yield [int(word) for word in words]

    def _lines_of(self, name: str) -> Iterator[list[str]]:
        number, *_ = self._words() or ["0"]
        if not number.isdecimal():
            self.refuse(f"'{number}' is not a number of {name}; a whole number")
        for _ in range(int(number)):
            yield self._words()


def read_cao(path: Path) -> Trimesh:
    """Read a 3D model of ViSP's (https://visp-doc.inria.fr, tutorial "Markerless generic model-based tracking"),
    metres: points, lines, faces of lines, faces of points, cylinders, circles.  Faces that aren't flat become
    triangles; lines count as sides of faces alone, since nothing tells what a line by itself hides.
    """
    cao, trimesh = _Cao(path), mesh_library(str(path))
    points = np.reshape(np.array([*cao.section("points", "a point", 3)]), (-1, 3))
    most = len(points)
    lines = [line[:2] for line in cao.indices("lines", "a line's two points", 2, most)]
    loops = []
    for _, *sides in cao.indices("faces", "a face's lines", 4, max(len(lines), most) + 1):
        loops.append(_loop_of_lines(cao, [lines[k] for k in sides]))
    for number, *loop in cao.indices("faces", "a face's points", 4, most + 1):
        if len(loop) != number or max(loop) >= most:
            cao.refuse(f"names {len(loop)} points, not {number}, or one that isn't there; the points in turn")
        loops.append(loop)
    parts = [trimesh.Trimesh(points, _triangles_of(path, points, loops), process=False)] if loops else []
    for *ends, radius in cao.section("cylinders", "a cylinder's two points and radius", 3):
        segment = _places(cao, points, ends)
        parts.append(trimesh.creation.cylinder(radius, segment=segment, sections=ROUND))
    for radius, *three in cao.section("circles", "a circle's radius and three points", 4):
        centre, one, other = _places(cao, points, three)
        at = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], np.cross(one - centre, other - centre))
        at[:3, 3] = centre
        parts.append(trimesh.creation.revolve([[0.0, 0.0], [radius, 0.0]], sections=ROUND, transform=at))
    if not parts:
        cao.refuse("has no faces; the surface of a finger, by faces, cylinders or circles")
    mesh = joined(parts)
    mesh.remove_unreferenced_vertices()
    return checked_size(mesh, str(path), mesh.extents, "")


def _places(cao: _Cao, points_m: Array, numbers: list[float]) -> Array:
    """Points (n, 3) by their numbers."""
    if any(number != int(number) or not 0 <= number < len(points_m) for number in numbers):
        cao.refuse(f"names a point that isn't there; numbers from 0 to {len(points_m) - 1}")
    return points_m[[int(number) for number in numbers]]


def _loop_of_lines(cao: _Cao, sides: list[list[int]]) -> list[int]:
    """The corners of a face given by consecutive lines."""
    loop = []
    for one, after in zip(sides, [*sides[1:], sides[0]], strict=True):
        common = set(one) & set(after)
        if len(common) != 1:
            cao.refuse("its lines don't follow each other; the lines in turn around the face")
        loop.append(common.pop())
    return [*loop[-1:], *loop[:-1]]


def _triangles_of(path: Path, points_m: Array, loops: list[list[int]]) -> NDArray[np.intp]:
    out = []
    for number, loop in enumerate(loops):
        parts = cut_into_triangles(points_m[loop])
        if parts is None:
            raise InputError(f"{path}, face {number}: crosses itself; the points in turn around the face")
        out += [[loop[k] for k in part] for part in parts]
    return np.reshape(np.array(out, dtype=np.intp), (-1, 3))
