"""What CAD files hold: the fingers, how they move, and what else may hide them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gripmon.model.errors import InputError
from gripmon.model.progress import Progress
from gripmon.model.records import Array
from gripmon.teach.cad.files import MESHES, joined, mesh_library, read_cao, read_mesh, separate
from gripmon.teach.cad.frame import AXES, approach_of
from gripmon.teach.cad.linkage import STEPS, TURNS_RAD, Linkage, LinkGroup, read_urdf
from gripmon.teach.cad.surface import Surface, surface_of, welded

if TYPE_CHECKING:
    from trimesh import Trimesh

FORMATS = (*MESHES, ".urdf", ".cao")
LONGEST_M = 0.3
"""Largest length of a finger: a longer one is an arm, or in another unit."""

SHORTEST_M = 0.005
"""A finger shorter than this spans a few tens of pixels at most, or is in another unit: it gets a note."""

MOST_NAMED = 6
"""Most bodies of a mesh that a question lists."""

STRAIGHT_NOTE = "the fingers move straight along x, half of the opening each; if theirs is an arc: their URDF"


@dataclass(frozen=True)
class Parts:
    """The fingers and the bodies ``around`` them, in the CAD frame.  ``paths_m``: for each finger its shifts (s, 3) by
    the joint, empty where none moves them; ``along`` (3,): the direction in which the jaws move, ``pivot`` (2, 3):
    place and axis about which one turns, ``approach``: the axis out of the gripper, None where unknown; ``origins``:
    for each finger, where it comes from.
    """

    fingers: dict[str, Surface]
    origins: tuple[str, ...]
    notes: list[str]
    around: list[Surface] = field(default_factory=list)
    paths_m: list[Array] = field(default_factory=list)
    along: Array | None = None
    pivot: Array | None = None
    approach: str | None = None


def read_parts(
    paths: Sequence[Path],
    unit: str | None,
    joint: str | None,
    body: str | None,
    approach: str | None,
    progress: Progress,
) -> Parts:
    """Read files: a mesh or .cao for each finger, one with several bodies, or a URDF.  :class:`InputError` says what
    can't be read, and asks which body is a finger.
    """
    _check(paths)
    if any(path.suffix.lower() == ".urdf" for path in paths):
        if len(paths) > 1:
            raise InputError(f"{paths[0]}: and {len(paths) - 1} more files; a URDF by itself")
        with progress(2, "step") as step:
            linkage = read_urdf(paths[0], joint)
            step()
            parts = _of_linkage(paths[0], linkage, body, approach)
            step()
        return parts
    if joint is not None:
        raise InputError(f"{joint}: {paths[0]} has no joints; a URDF", "joint")
    with progress(2 * len(paths), "step") as step:
        bodies = []
        for path in paths:
            bodies.append(read_cao(path) if path.suffix.lower() == ".cao" else read_mesh(path, unit))
            step()
        if len(paths) == 1:
            bodies, origins, notes = _bodies_in(bodies[0], body, str(paths[0]))
        elif body is not None:
            raise InputError(f"{body}: chooses bodies of one file, and there are {len(paths)}; one file", "body")
        else:
            origins, notes = tuple(path.name for path in paths), []
        surfaces = []
        for each, origin in zip(bodies, origins, strict=True):
            surfaces.append(_checked(surface_of(each), origin))
            step()
    return _named(surfaces, origins, [*notes, *_odd(surfaces, origins)])


def _check(paths: Sequence[Path]) -> None:
    if not paths:
        raise InputError("from-cad: no file; a mesh or .cao for each finger, or a URDF")
    for k, path in enumerate(paths):
        if path.suffix.lower() not in FORMATS:
            raise InputError(f"{path}: is not a format of CAD that is read here; one of {', '.join(FORMATS)}")
        if not path.is_file():
            raise InputError(f"{path}: there is no such file; one of {', '.join(FORMATS)}")
        if path.resolve() in [other.resolve() for other in paths[:k]]:
            raise InputError(f"{path}: is named twice; a mesh for each finger, where it stands, or both in one file")


def _bodies_in(whole: Trimesh, text: str | None, path: str) -> tuple[list[Trimesh], tuple[str, ...], list[str]]:
    """The fingers of a file with several bodies, as ``text`` chooses them: "all" for one finger, or numbers from 1, the
    largest body first, joined by + within a finger and separated by commas.
    """
    pieces = separate(mesh_library(path).Trimesh(*welded(whole), process=False))
    if text is None:
        if len(pieces) == 1:
            return pieces, (path,), []
        listed = [f"{k}: {_size(piece.extents)}" for k, piece in enumerate(pieces[:MOST_NAMED], start=1)]
        more = f", and {len(pieces) - MOST_NAMED} smaller" if len(pieces) > MOST_NAMED else ""
        raise InputError(
            f"is missing: {path} holds {len(pieces)} bodies ({'; '.join(listed)}{more}); all, if they are one finger, "
            "or numbers: 1,2 are two fingers, 1+3,2 two of three bodies",
            "body",
        )
    if text == "all":
        return [whole], (path,), []
    fingers = []
    for words in text.split(","):
        numbers = [int(word) if word.isdecimal() else 0 for word in words.split("+")]
        if not all(1 <= n <= len(pieces) for n in numbers):
            raise InputError(f"'{words}': {path} has the bodies 1 to {len(pieces)}; all, 1, 1,2 or 1+3,2", "body")
        fingers.append(numbers)
    chosen = list(itertools.chain.from_iterable(fingers))
    if len(set(chosen)) < len(chosen):
        raise InputError(f"{text}: names a body twice; each for one finger", "body")
    left = len(pieces) - len(chosen)
    notes = [f"{path}: {left} of {len(pieces)} bodies are left out"] if left else []
    names = tuple(f"{path}, body {'+'.join(map(str, numbers))}" for numbers in fingers)
    return [joined([pieces[n - 1] for n in numbers]) for numbers in fingers], names, notes


def _size(extents_m: Array) -> str:
    return " x ".join(f"{1e3 * v:.1f}" for v in extents_m) + " mm"


def _of_linkage(path: Path, linkage: Linkage, body: str | None, approach: str | None) -> Parts:
    """A URDF's fingers: the links named by ``body``, else those that move without turning; with a single one of these,
    the link beside it that stands.
    """
    notes = list(linkage.notes)
    straight = [group for group in linkage.moving if group.turns_rad <= TURNS_RAD]
    chosen, still = (straight or linkage.moving, []) if body is None else _chosen(path, linkage, body)
    if linkage.moves and (turning := [g for g in chosen if g.turns_rad > TURNS_RAD]):
        raise _turning(path, linkage, turning[0])
    pivot = None if straight else linkage.pivot
    along = _along(chosen if chosen and linkage.moves else straight)
    surfaces = [_checked(surface_of(group.body), group.links[0]) for group in chosen]
    if approach is None:
        reaching = [group.body.vertices for group in straight or linkage.moving]
        approach = approach_of(reaching, [each.vertices for each in linkage.still.values()], along, pivot)
    if body is None and len(chosen) == 1:
        still = _beside(path, linkage, chosen[0], AXES[approach.split(",")[0]])
        if not still:
            notes.append(f"one finger, link {chosen[0].links[0]}: no link that stands reaches as far")
    surfaces += [_checked(surface_of(linkage.still[link]), link) for link in still]
    hiding = [group for group in linkage.moving if group not in chosen]
    if hiding:
        names = ", ".join(link for group in hiding for link in group.links)
        notes.append(f"these links aren't fingers, they only hide what is behind them: {names}")
    around = [group.body for group in hiding] + [each for link, each in linkage.still.items() if link not in still]
    paths = [group.path_m for group in chosen] + [np.zeros((STEPS, 3))] * len(still)
    if not linkage.moves:
        notes.append("the fingers stand as drawn: the file is for this opening; another file for another one")
    elif not chosen:
        notes.append("the fingers stand: what moves isn't in the file")
    if not (linkage.moves and chosen):
        paths = []
    origins = tuple([", ".join(group.links) for group in chosen] + still)
    notes += [f"the CAD frame is that of link '{linkage.base}'", *_odd(surfaces, origins)]
    return replace(
        _named(surfaces, origins, notes, paths),
        around=[surface_of(each) for each in around],
        approach=approach,
        along=along,
        pivot=pivot,
    )


def _chosen(path: Path, linkage: Linkage, text: str) -> tuple[list[LinkGroup], list[str]]:
    """The moving groups and the standing links that ``--body`` names."""
    names = [word.strip() for word in text.replace("+", ",").split(",")]
    there = [link for group in linkage.moving for link in group.links] + list(linkage.still)
    strange = next((name for name in names if name not in there), None)
    if strange is not None:
        raise InputError(f"{strange}: {path} has no such link with a geometry; of {', '.join(there)}", "body")
    return [g for g in linkage.moving if set(g.links) & set(names)], [name for name in names if name in linkage.still]


def _turning(path: Path, linkage: Linkage, turning: LinkGroup) -> InputError:
    link, turns = turning.links[0], np.degrees(turning.turns_rad)
    return InputError(
        f"{path}: its finger '{link}' turns by {turns:.0f} degrees to either side while joint '{linkage.joint}' moves, "
        f"and a gripper file holds fingers that don't turn; --joint {linkage.joint}=POSITION (rad) for the opening in "
        "use, or --body LINK of a finger that stands"
    )


def _along(groups: Sequence[LinkGroup]) -> Array | None:
    """The direction (3,) in which the jaws move against each other where they are drawn."""
    if not groups:
        return None
    way = groups[-1].path_m - (groups[0].path_m if len(groups) > 1 else 0.0)
    middle = len(way) // 2
    step = way[middle + 1] - way[middle - 1]
    length = float(np.linalg.norm(step))
    return step / length if length > 1e-9 else None


def _beside(path: Path, linkage: Linkage, group: LinkGroup, z: Array) -> list[str]:
    """The link that stands beside a single finger that moves: one that reaches into its front half."""
    ends = group.body.vertices @ z
    middle = 0.5 * (ends.min() + ends.max())
    reaching = [link for link, each in linkage.still.items() if (each.vertices @ z).max() > middle]
    if len(reaching) > 1:
        raise InputError(
            f"is missing: {path}: beside finger {group.links[0]} stand the links {', '.join(reaching)}; the fingers, "
            f"as --body {group.links[0]},{reaching[0]}",
            "body",
        )
    return reaching


def _named(surfaces: list[Surface], origins: tuple[str, ...], notes: list[str], paths_m: Sequence[Array] = ()) -> Parts:
    """The fingers by name: of two, left and right as their own names say, else along the axis of the CAD frame along
    which they are farthest apart.
    """
    middles = np.array([0.5 * (s.points_m.min(axis=0) + s.points_m.max(axis=0)) for s in surfaces])
    order = np.argsort(middles[:, int(np.ptp(middles, axis=0).argmax())], kind="stable").tolist()
    own = [Path(origin.split(", ")[0]).stem for origin in origins]
    sides = [_says(name, "left") - _says(name, "right") for name in own]
    if sorted(sides) == [-1, 1]:
        order = [sides.index(1), sides.index(-1)]
    count = len(surfaces)
    named = {1: ["finger"], 2: ["left", "right"]}.get(count) or [own[k] for k in order]
    if len(set(named)) < count:
        named = [f"finger{k + 1}" for k in range(count)]
    fingers = {name: surfaces[k] for name, k in zip(named, order, strict=True)}
    paths = [paths_m[k] for k in order] if paths_m else []
    return Parts(fingers, tuple(origins[k] for k in order), notes, paths_m=paths)


def _says(name: str, side: str) -> bool:
    return side in name.lower() or name.lower().startswith(f"{side[0]}_")


def _checked(surface: Surface, name: str) -> Surface:
    if not len(surface.triangles):
        raise InputError(f"{name}: no triangle has an area; a mesh of the finger's surface")
    if float(np.ptp(surface.points_m, axis=0).max()) > LONGEST_M:
        size = " x ".join(f"{1e3 * v:.0f}" for v in np.ptp(surface.points_m, axis=0))
        raise InputError(
            f"{name}: a finger of {size} mm; at most {1e3 * LONGEST_M:.0f} mm: its unit, or only the finger"
        )
    return surface


def _odd(surfaces: Sequence[Surface], origins: Sequence[str]) -> list[str]:
    """Notes on surfaces too small for their unit, and on those that aren't closed: their borders show as edges."""
    out = []
    for surface, origin in zip(surfaces, origins, strict=True):
        longest_m = float(np.ptp(surface.points_m, axis=0).max())
        if longest_m < SHORTEST_M:
            out.append(f"{origin}: a finger of {1e3 * longest_m:.2g} mm: is its unit right?")
        count = int(np.count_nonzero(surface.border))
        if count:
            no = f"{count} sides of triangles have no neighbour"
            out.append(f"{origin}: the surface is open ({no}): borders are taken as edges")
    return out
