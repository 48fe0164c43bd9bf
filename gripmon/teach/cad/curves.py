"""The lines of a surface that an eye sees: sharp edges, borders, and the outlines of round parts."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import InputError
from gripmon.model.records import Array
from gripmon.teach.cad.surface import Surface, radius_m, shading_of

MOST_PIECES = 200_000
"""Most sharp edges: more aren't a gripper's, and chaining them would take minutes."""

Key = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Pieces:
    """Straight pieces of lines: ends ``points_m`` (n, 2, 3) with ``keys`` (n pairs, equal where two pieces meet);
    ``crease`` (n,): whether the body is seen on both sides; ``centre_m`` (n, 2, 3): centre of the rounding at each end,
    NaN on a sharp edge; ``wanders`` (n,): whether it is the outline of a round part, which moves over it as the view
    changes.
    """

    points_m: Array
    keys: list[tuple[Key, Key]]
    crease: NDArray[np.bool_]
    centre_m: Array
    wanders: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Curve:
    """Consecutive pieces: ``points_m`` (n, 3), ``centre_m`` (n, 3); a closed curve ends where it begins."""

    points_m: Array
    centre_m: Array
    crease: bool


def pieces_of(surface: Surface, eye_m: Array) -> Pieces:
    """All lines of a surface that the eye (3,) may see, including those that something hides."""
    facing = _Facing(surface, eye_m)
    found = [*facing.rounds(), facing.sharp_edges()]
    return Pieces(
        np.concatenate([p.points_m for p in found]),
        list(itertools.chain.from_iterable(p.keys for p in found)),
        np.concatenate([p.crease for p in found]),
        np.concatenate([p.centre_m for p in found]),
        np.concatenate([p.wanders for p in found]),
    )


class _Facing:
    """Which way a surface faces: ``towards`` (t, 3) is the height of the eye above the smooth surface, at each corner
    of each triangle, m.
    """

    def __init__(self, surface: Surface, eye_m: Array) -> None:
        self._surface = surface
        shading = shading_of(surface)
        self._normals = shading.normals[shading.corner]
        self._places = surface.points_m[surface.triangles]
        towards = np.einsum("tki,tki->tk", self._normals, eye_m - self._places)
        self._towards = np.where(towards == 0.0, 1e-12, towards)
        self._split: dict[tuple[int, int], list[tuple[float, Key]]] = {}

    def rounds(self) -> list[Pieces]:
        """Outlines of round parts: where the smooth surface turns away from the eye (Hertzmann 1999)."""
        signs = self._towards > 0.0
        mixed = np.flatnonzero(signs.any(axis=1) & ~signs.all(axis=1))
        if not len(mixed):
            return []
        places, normals, towards = self._places[mixed], self._normals[mixed], self._towards[mixed]
        own = self._surface.triangles[mixed]
        # The single corner on its side of the outline, which crosses the two sides of the triangle that end there.
        positive = signs[mixed].sum(axis=1)
        alone = np.where(positive == 1, signs[mixed].argmax(axis=1), (~signs[mixed]).argmax(axis=1))
        rows = np.arange(len(mixed))
        points, turned, keys = [], [], []
        for step in (1, 2):
            other = (alone + step) % 3
            a, b, na, nb = places[rows, alone], places[rows, other], normals[rows, alone], normals[rows, other]
            ga, gb = towards[rows, alone], towards[rows, other]
            share = (ga / (ga - gb))[:, None]
            points.append(_lifted(a, b, na, nb, share))
            normal = (1.0 - share) * na + share * nb
            turned.append(normal / np.linalg.norm(normal, axis=1)[:, None])
            keys.append(self._keys(mixed, own[rows, alone], own[rows, other], share[:, 0]))
        ends, normal = np.stack(points, axis=1), np.stack(turned, axis=1)
        way = ends[:, 1] - ends[:, 0]
        kept = np.linalg.norm(way, axis=1) > 1e-9
        centres = np.full(ends.shape, np.nan)
        for k in (0, 1):
            across = np.cross(normal[:, k], way)
            across[~kept] = (1.0, 0.0, 0.0)
            # A visible outline is convex; a surface turned inside out has its normals the other way.
            radius = np.abs(radius_m(places, normals, across))
            centres[:, k] = np.where(np.isfinite(radius)[:, None], ends[:, k] - radius[:, None] * normal[:, k], np.nan)
        both = [(one, other) for one, other, keep in zip(*keys, kept.tolist(), strict=True) if keep]
        return [Pieces(ends[kept], both, np.zeros(len(both), bool), centres[kept], np.ones(len(both), bool))]

    def _keys(self, triangle: NDArray[np.intp], a: NDArray[np.intp], b: NDArray[np.intp], share: Array) -> list[Key]:
        """A key for each crossing of a side of a patch."""
        patch = self._surface.patch[triangle].tolist()
        out: list[Key] = []
        for one, other, s, p in zip(a.tolist(), b.tolist(), share.tolist(), patch, strict=True):
            low, high, along = (one, other, s) if one < other else (other, one, 1.0 - s)
            out.append((low, high, p))
            self._split.setdefault((low, high), []).append((along, (low, high, p)))
        return out

    def sharp_edges(self) -> Pieces:
        """Sharp edges and borders, cut where an outline meets them."""
        surface = self._surface
        which = np.flatnonzero(surface.sharp)
        if len(which) > MOST_PIECES:
            raise InputError(
                f"{len(which)} edges turn by more than 30 degrees, more than {MOST_PIECES}: a rough scan?  A smoothed "
                "surface, or the CAD's own export"
            )
        sides = np.stack([self._at_ends(which, 0), self._at_ends(which, 1)], axis=1)
        points: list[Array] = []
        keys: list[tuple[Key, Key]] = []
        crease: list[bool] = []
        closed = surface.closed
        for k, edge in enumerate(which.tolist()):
            low, high = surface.edges[edge].tolist()
            stops = [(0.0, (low, low, -1)), *sorted(self._split.get((low, high), [])), (1.0, (high, high, -1))]
            one_sided = surface.sides[edge, 1] < 0
            for (start, first), (end, last) in itertools.pairwise(stops):
                middle = 0.5 * (start + end)
                seen = (1.0 - middle) * sides[k, :, 0] + middle * sides[k, :, 1]
                if end - start < 1e-9 or (closed and not (seen > 0.0).any()):
                    continue
                a, b = surface.points_m[low], surface.points_m[high]
                points.append(np.stack([a + start * (b - a), a + end * (b - a)]))
                keys.append((first, last))
                both = seen[0] * seen[1] * (1.0 if surface.alike[edge] else -1.0) > 0.0
                crease.append(bool(both and not one_sided))
        ends = np.reshape(points, (-1, 2, 3))
        return Pieces(ends, keys, np.array(crease, dtype=bool), np.full(ends.shape, np.nan), np.zeros(len(keys), bool))

    def _at_ends(self, which: NDArray[np.intp], side: int) -> Array:
        """Height (n, 2) of the eye above one side's surface at both ends of edges."""
        surface = self._surface
        triangle = surface.sides[which, side]
        out = np.full((len(which), 2), np.nan)
        for end in (0, 1):
            match = surface.triangles[triangle] == surface.edges[which, end, None]
            out[:, end] = self._towards[triangle, match.argmax(axis=1)]
        out[triangle < 0] = -1.0
        return out


def _lifted(a: Array, b: Array, na: Array, nb: Array, share: Array) -> Array:
    """Points between ``a`` and ``b`` (n, 3), lifted from the chord onto the arc given by the normals at its ends: by
    half of the distance to their tangent planes, which for a circle is exact to the second order.
    """
    p = a + share * (b - a)
    below_a = np.einsum("ni,ni->n", p - a, na)[:, None] * na
    below_b = np.einsum("ni,ni->n", p - b, nb)[:, None] * nb
    return p - 0.5 * ((1.0 - share) * below_a + share * below_b)


def curves_of(pieces: Pieces) -> list[Curve]:
    """Pieces joined into curves, which end where three pieces meet, or two of different kinds."""
    at: dict[Key, list[int]] = {}
    for number, (first, last) in enumerate(pieces.keys):
        at.setdefault(first, []).append(number)
        at.setdefault(last, []).append(number)
    kind = list(zip(pieces.crease.tolist(), pieces.wanders.tolist(), strict=True))

    def through(key: Key) -> bool:
        own = at[key]
        return len(own) == 2 and own[0] != own[1] and kind[own[0]] == kind[own[1]]

    left = set(range(len(pieces.keys)))
    ends = [n for n in range(len(pieces.keys)) if not all(map(through, pieces.keys[n]))]
    out = []
    # Start at ends first; what is left is closed.
    for start in itertools.chain(ends, range(len(pieces.keys))):
        if start not in left:
            continue
        forward = not through(pieces.keys[start][0]) or through(pieces.keys[start][1])
        row, key, number = [], pieces.keys[start][0 if forward else 1], start
        while number in left:
            left.discard(number)
            turned = pieces.keys[number][0] != key
            row.append((number, turned))
            key = pieces.keys[number][0 if turned else 1]
            if not through(key):
                break
            number = next((n for n in at[key] if n != number), number)
        out.append(_curve(pieces, row))
    return out


def _curve(pieces: Pieces, row: list[tuple[int, bool]]) -> Curve:
    number, turned = row[0]
    places = [(number, int(turned)), *((n, 0 if back else 1) for n, back in row)]
    index, end = np.array(places).T
    return Curve(pieces.points_m[index, end], pieces.centre_m[index, end], bool(pieces.crease[row[0][0]]))
