"""Points of a square lattice in an image; discs on a lattice; and an image's noise and sharpness.

A lattice is grown from a seed, point by point, by predictions from neighbours that are already known.  A part of a
plate is therefore enough, whatever lies on it, and lens distortion doesn't matter.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.model.records import Array, Image

GATE_STEPS = 0.35
"""Gate for a predicted point, in steps of the lattice: a fisheye's steps change by as much."""
SEEDS = 60
"""Maximum number of seeds that are tried."""
_NEIGHBOURS = 8
_STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
Index = tuple[int, int]


class LatticeRules(Protocol):
    """Which points can be neighbours on a lattice, besides their positions."""

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        """Whether point b, a step (2,) from a, can be its neighbour on the lattice."""

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        """Whether two steps from a point can be those of a *square* lattice."""


def find_lattice(points_px: Array, rules: LatticeRules) -> dict[Index, int]:
    """Lattice coordinates (column, row) -> index of the point, for the largest lattice among points (n, 2); the
    lattice's axes have the same handedness as the image's.  Empty if there is none of at least 3 x 3.
    """
    if len(points_px) < 9:
        return {}
    tree = cKDTree(points_px)
    best: dict[Index, int] = {}
    tried: set[int] = set()
    count = 0
    middle = np.median(points_px, axis=0)
    for seed in np.argsort(np.linalg.norm(points_px - middle, axis=1)).tolist():
        if seed in tried:
            continue
        bases = _bases(points_px, tree, seed, rules)
        count += bool(bases)
        for basis in bases:
            grown = _grow(points_px, tree, seed, basis, rules)
            tried.update(grown.values())
            if len(grown) > len(best):
                best = grown
        if len(best) > 0.5 * len(points_px) or count >= SEEDS:
            break
    best = _consistent(points_px, best)
    columns, rows = extent(best)
    return best if min(columns, rows) >= 3 and len(best) >= 9 else {}


def trimmed(lattice: dict[Index, int], columns: int, rows: int) -> dict[Index, int]:
    """Remove sparse outermost lines while the lattice is larger than ``columns`` x ``rows``, in either orientation:
    those are points beside the target that fit by chance.
    """
    out = dict(lattice)
    while out:
        seen = extent(out)
        excess = min(
            ((seen[0] - columns, seen[1] - rows), (seen[0] - rows, seen[1] - columns)),
            key=lambda e: max(e[0], 0) + max(e[1], 0),
        )
        lines: list[tuple[int, int, int]] = []
        for axis in (0, 1):
            if excess[axis] > 0:
                places = [cell[axis] for cell in out]
                lines += [(places.count(place), axis, place) for place in (min(places), max(places))]
        if not lines:
            return out
        fewest, axis, place = min(lines)
        if fewest >= 0.5 * len(out) / seen[axis]:
            return out
        out = {cell: index for cell, index in out.items() if cell[axis] != place}
    return out


def extent(lattice: dict[Index, int]) -> tuple[int, int]:
    """Columns and rows that a lattice spans."""
    if not lattice:
        return 0, 0
    cells = np.array(list(lattice))
    size = cells.max(axis=0) - cells.min(axis=0) + 1
    return int(size[0]), int(size[1])


def _bases(points: Array, tree: cKDTree, seed: int, rules: LatticeRules) -> list[tuple[Array, Array]]:
    """Pairs of steps from a point to neighbours that the opposite neighbours confirm, the shortest first."""
    count = min(_NEIGHBOURS + 1, len(points))
    _, near = tree.query(points[seed], count)
    confirmed = []
    for k in np.atleast_1d(near)[1:].tolist():
        step = points[k] - points[seed]
        back = _near(tree, points[seed] - step, float(np.hypot(*step)))
        if back is not None and rules.neighbours(seed, k, step) and rules.neighbours(seed, back, -step):
            confirmed.append(step)
    out = []
    for a, b in itertools.combinations(confirmed, 2):
        turning = float(a[0] * b[1] - a[1] * b[0])
        if abs(turning) < 0.2 * float(np.hypot(*a) * np.hypot(*b)) or not rules.basis(seed, a, b):
            continue
        if turning < 0.0:
            a, b = b, a
        corner = points[seed] + a + b
        if _near(tree, corner, min(float(np.hypot(*a)), float(np.hypot(*b)))) is not None:
            out.append((a, b))
    return sorted(out, key=lambda pair: float(pair[0] @ pair[0] + pair[1] @ pair[1]))[:3]


def _near(tree: cKDTree, where: Array, step_px: float) -> int | None:
    distance, index = tree.query(where)
    return int(index) if distance < GATE_STEPS * step_px else None


def _grow(points: Array, tree: cKDTree, seed: int, basis: tuple[Array, Array], rules: LatticeRules) -> dict[Index, int]:
    found: dict[Index, int] = {(0, 0): seed}
    taken = {seed}
    local: dict[Index, Array] = {(0, 0): np.stack(basis)}
    queue = deque([(0, 0)])
    while queue:
        at = queue.popleft()
        here = points[found[at]]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            to = (at[0] + sign, at[1]) if axis == 0 else (at[0], at[1] + sign)
            if to in found:
                continue
            behind = (at[0] - sign, at[1]) if axis == 0 else (at[0], at[1] - sign)
            step = here - points[found[behind]] if behind in found else sign * local[at][axis]
            index = _near(tree, here + step, float(np.hypot(*step)))
            if index is None or index in taken or not rules.neighbours(found[at], index, points[index] - here):
                continue
            found[to] = index
            taken.add(index)
            moved = local[at].copy()
            moved[axis] = sign * (points[index] - here)
            # The other step changes slowly: take the neighbour's where it is known.
            local[to] = _own_steps(points, found, to, moved)
            queue.append(to)
    return found


def _own_steps(points: Array, found: dict[Index, int], at: Index, otherwise: Array) -> Array:
    out = otherwise.copy()
    for dx, dy in _STEPS:
        neighbour = (at[0] + dx, at[1] + dy)
        if neighbour in found:
            out[0 if dx else 1] = (points[found[neighbour]] - points[found[at]]) * (dx + dy)
    return out


def _consistent(points: Array, lattice: dict[Index, int]) -> dict[Index, int]:
    """Remove points that lie off the midpoint of two neighbours on a line: they met a prediction by chance."""
    out = dict(lattice)
    for at, index in lattice.items():
        for axis in (0, 1):
            before = (at[0] - 1, at[1]) if axis == 0 else (at[0], at[1] - 1)
            after = (at[0] + 1, at[1]) if axis == 0 else (at[0], at[1] + 1)
            if before in lattice and after in lattice:
                low, high = points[lattice[before]], points[lattice[after]]
                off = np.hypot(*(points[index] - 0.5 * (low + high)))
                if off > 0.12 * float(np.hypot(*(high - low))):
                    out.pop(at, None)
    return out


Grey = NDArray[np.float32]
_TOP = 200.0
_DIM = 100.0
_SAMPLES = (33, 400)
_EDGE = float(np.sqrt(2.0 * np.pi))
"""For a blurred edge, height over greatest slope is this times the blur's standard deviation."""


def to_grey(image: Image) -> Grey:
    """Grey levels up to about 255 for any camera image: 8 bit as they are unless dark, which are brightened; 16 bit (of
    which 10 or 12 may be in use) and float scaled by their content.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = np.nan_to_num(np.ascontiguousarray(grey, np.float32), posinf=0.0, neginf=0.0)
    top = float(np.percentile(grey[::4, ::4], 99.5))
    if top > 0.0 and (image.dtype != np.uint8 or top < _DIM):
        grey = (grey * (_TOP / top)).astype(np.float32)
    return np.minimum(grey, np.float32(255.0))


def to_bytes(grey: Grey) -> NDArray[np.uint8]:
    """Bytes, as OpenCV's own detectors expect."""
    return np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)


def noise_of(grey: Grey) -> float:
    """Standard deviation of the image's noise, robust against its content (Immerkaer, "Fast noise variance estimation",
    1996, with a median); at least that of rounding.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return max(float(np.median(np.abs(cv2.filter2D(grey, cv2.CV_32F, kernel)))) / (6.0 * 0.6745), 0.3)


def edge_blur_px(grey: Grey, start: Array, end: Array) -> float:
    """Median standard deviation (px) of the blur of edges, one across each of the lines from ``start`` to ``end`` (n,
    2); infinity if there are none.
    """
    if not len(start):
        return float("inf")
    length = np.linalg.norm(end - start, axis=1)
    samples = int(np.clip(2.0 * length.max(), *_SAMPLES))
    share = np.linspace(0.0, 1.0, samples)[None, :, None]
    where = (start[:, None] * (1.0 - share) + end[:, None] * share).astype(np.float32)
    levels = cv2.remap(grey, where[:, :, 0], where[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    spacing = length / (samples - 1)
    # Over three samples: between two the noise would look like a slope.
    slope = np.abs(levels[:, 3:] - levels[:, :-3]).max(axis=1) / (3.0 * spacing)
    height = np.abs(levels[:, :4].mean(axis=1) - levels[:, -4:].mean(axis=1))
    return float(np.median(height / np.maximum(slope, 1e-6))) / _EDGE


def sharpest_blur_px(grey: Grey) -> float:
    """Standard deviation (px) of the blur of the image's strongest edges, whatever they are."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    slope = np.hypot(*(cv2.Sobel(smooth, cv2.CV_32F, *o, ksize=3, scale=0.125) for o in ((1, 0), (0, 1))))
    square = np.ones((31, 31), np.uint8)
    height = cv2.dilate(smooth, square) - cv2.erode(smooth, square)
    strongest = np.argpartition(slope.ravel(), -400)[-400:]
    blur = np.median(height.ravel()[strongest] / np.maximum(slope.ravel()[strongest], 1e-6)) / _EDGE
    return float(np.sqrt(max(float(blur) ** 2 - 1.0, 0.0)))


SMALLEST_PX = 4.0
"""Minimum diameter of a disc."""
LEAST_ROUNDNESS = 0.88
"""Minimum area of a blob over that of the ellipse with the same moments (the maximum is its inverse)."""
LEAST_AXIS_RATIO = 0.2
"""Minimum ratio of the axes of a disc's ellipse."""
MOST_BLOBS = 4000
LARGE_PX = 1600
"""Images larger than this are searched at half size first."""
SYSTEMATIC_PX = 0.02
"""Standard deviation of a centre that noise doesn't explain."""
ASYMMETRIC = 0.025
"""Largest root mean square asymmetry about a disc's centre, over its contrast: above it something covers the disc."""
_BLOCKS = (32, 12, 5)
"""Width of the image over that of the neighbourhood whose mean level is the threshold."""
_LATTICES = 3


@dataclass(frozen=True)
class Disc:
    """A blob's centre (2,), the covariance (2, 2) of its area, and whether it is darker than its surroundings."""

    centre_px: Array
    spread_px2: Array
    dark: bool


@dataclass(frozen=True)
class _Metric:
    """A disc's own shape predicts the apparent length of the lattice's steps, and whether they are square."""

    roots: Array
    expected: float

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        # By both discs: a lens may show one much larger than the other.
        one, other = (float(np.hypot(*(self.roots[k] @ step_px))) for k in (a, b))
        return 0.65 * self.expected < (one * other) ** 0.5 < 1.45 * self.expected

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        a, b = self.roots[at] @ a_px, self.roots[at] @ b_px
        return abs(float(a @ b)) < 0.45 * float(np.hypot(*a) * np.hypot(*b))


def find_discs(
    grey: Grey, columns: int, rows: int, spacing_per_diameter: float, count: int
) -> list[dict[Index, Disc]]:
    """Lattices of discs (column, row) -> disc: the largest that fits into ``columns`` x ``rows``, in either
    orientation, or otherwise the largest that was found; empty if there is none.  ``count``: when it is complete.
    """
    if max(grey.shape) > LARGE_PX:
        half: Grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        found = _search(half, columns, rows, spacing_per_diameter, count)
        if found and fits(found[0], columns, rows):
            return [
                {cell: Disc(2.0 * d.centre_px + 0.5, 4.0 * d.spread_px2, d.dark) for cell, d in one.items()}
                for one in found
            ]
    return _search(grey, columns, rows, spacing_per_diameter, count)


def _search(
    grey: Grey, columns: int, rows: int, spacing_per_diameter: float, count: int
) -> list[dict[Index, Disc]]:
    best: dict[Index, Disc] = {}
    others: list[dict[Index, Disc]] = []
    shown = to_bytes(grey)
    seen: dict[bool, tuple[Array, Array]] = {dark: (np.zeros((0, 2)), np.zeros((0, 2, 2))) for dark in (True, False)}
    for part in _BLOCKS:
        for dark in (True, False):
            # Discs of all sizes together: with a strong lens some are much larger than others.
            centres, spreads = seen[dark] = _united(seen[dark], _blobs(shown, grey.shape[1] // part, dark))
            for _ in range(_LATTICES):
                metric = _Metric(_inverse_roots(spreads), 4.0 * spacing_per_diameter)
                lattice = find_lattice(centres, metric)
                if not lattice:
                    break
                chosen = np.array(list(lattice.values()))
                lattice = trimmed(lattice, columns, rows)
                found = {cell: Disc(centres[i], spreads[i], dark) for cell, i in lattice.items()}
                if fits(found, columns, rows):
                    best = max(best, found, key=len)
                elif len(found) >= 9:
                    others.append(found)
                left = np.delete(np.arange(len(centres)), chosen)
                centres, spreads = centres[left], spreads[left]
            if len(best) == count:
                return [best]
    return [best or max(others, key=len)] if best or others else []


def _united(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """All of the first, and those of the second that aren't among the first."""
    if not len(first[0]) or not len(second[0]):
        return second if len(second[0]) else first
    distance, nearest = cKDTree(first[0]).query(second[0])
    new = distance > np.sqrt(np.einsum("nii->n", first[1])[nearest])
    return np.concatenate([first[0], second[0][new]]), np.concatenate([first[1], second[1][new]])


def fits(lattice: Mapping[Index, object], columns: int, rows: int, least: int = 1) -> bool:
    """Whether a lattice can be part of ``columns`` x ``rows``, in either orientation, and is large enough: nine points,
    and ``least`` in each of its rows and columns.
    """
    if len(lattice) < 9:
        return False
    cells = np.array(list(lattice))
    seen = cells.max(axis=0) - cells.min(axis=0) + 1
    return bool(max(seen) <= max(columns, rows) and least <= min(seen) <= min(columns, rows))


def _inverse_roots(spreads: Array) -> Array:
    if not len(spreads):
        return spreads
    values, vectors = np.linalg.eigh(spreads)
    out: Array = vectors / np.sqrt(values)[:, None, :] @ vectors.transpose(0, 2, 1)
    return out


def _blobs(shown: NDArray[np.uint8], block_px: int, dark: bool) -> tuple[Array, Array]:
    """Ellipses: centres (n, 2) and covariances (n, 2, 2) of their areas."""
    block_px = max(block_px, 11) | 1
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    mask = cv2.adaptiveThreshold(shown, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, block_px, 8 if dark else -8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    height, width = shown.shape
    x, y, w, h, area = stats.T
    fill = area / (w * h)
    good = (np.minimum(w, h) >= SMALLEST_PX) & (np.maximum(w, h) <= block_px) & (fill > 0.2) & (fill < 0.95)
    good &= (x > 0) & (y > 0) & (x + w < width) & (y + h < height)
    good[0] = False
    centres, spreads = [], []
    for k in np.flatnonzero(good)[:MOST_BLOBS].tolist():
        left, top, w_k, h_k, area_k = stats[k].tolist()
        rows, columns = np.nonzero(labels[top : top + h_k, left : left + w_k] == k)
        u, v = columns - columns.mean(), rows - rows.mean()
        # A pixel is a square, not a point.
        a, b, c = u @ u / area_k + 1.0 / 12.0, u @ v / area_k, v @ v / area_k + 1.0 / 12.0
        determinant = a * c - b * b
        roundness = area_k / (4.0 * np.pi * determinant**0.5)
        largest = 0.5 * (a + c) + (0.25 * (a - c) ** 2 + b * b) ** 0.5
        if LEAST_ROUNDNESS < roundness < 1.0 / LEAST_ROUNDNESS and determinant > (LEAST_AXIS_RATIO * largest) ** 2:
            centres.append((left + columns.mean(), top + rows.mean()))
            spreads.append(((a, b), (b, c)))
    return np.array(centres).reshape(-1, 2), np.array(spreads).reshape(-1, 2, 2)


def refined(grey: Grey, disc: Disc, noise: float) -> tuple[Array, Array] | None:
    """Centroid (2,) of a disc's missing (or extra) light, with its covariance (2, 2): no threshold biases it, and every
    pixel of the rim counts by its coverage.  None if the disc is hardly visible, or not completely.
    """
    centre, spread = disc.centre_px, disc.spread_px2
    half = np.ceil(2.0 * np.sqrt(spread.diagonal()) * 1.35 + 2.0).astype(int)
    low, high = np.rint(centre).astype(int) - half, np.rint(centre).astype(int) + half + 1
    if (low < 0).any() or (high > np.array(grey.shape[::-1])).any():
        return None
    patch = grey[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    offset = np.stack([u - centre[0], v - centre[1]], axis=-1)
    # In units of the ellipse's radius: inside is below 1.
    radius = np.sqrt(np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(4.0 * spread), offset))
    pixel = 1.0 / float(np.sqrt(4.0 * np.linalg.eigvalsh(spread)[0]))  # in these units, at most
    rim, ring = radius < 1.0 + 2.0 * pixel, (radius > 1.0 + 2.0 * pixel) & (radius < 1.35 + 2.0 * pixel)
    core = radius < max(1.0 - 2.0 * pixel, 0.4)
    if ring.sum() < 8 or not core.any():
        return None
    # The surrounding light may have a gradient.
    design = np.column_stack([np.ones(int(ring.sum())), offset[ring]])
    plane, *_ = np.linalg.lstsq(design, patch[ring], rcond=None)
    around = plane[0] + offset @ plane[1:]
    # Normalise to even light: otherwise the brighter side would weigh more.
    light = np.maximum(around, 0.3 * plane[0]) / plane[0] if plane[0] > 10.0 * noise else 1.0
    depth = ((around - patch) if disc.dark else (patch - around)) / light
    contrast = float(np.median(depth[core]))
    if contrast < 6.0 * noise or contrast < 5.0:
        return None
    total = float(depth[rim].sum())
    shift = depth[rim] @ offset[rim] / total
    if np.hypot(*shift) > 1.0 or _asymmetry(grey, centre + shift, offset[rim | ring], noise) > ASYMMETRIC * contrast:
        return None
    lever = offset[rim] - shift
    variance = noise**2 * (lever.T @ lever) / total**2 + np.eye(2) * SYSTEMATIC_PX**2
    return centre + shift, variance


def _asymmetry(grey: Grey, centre: Array, offsets: Array, noise: float) -> float:
    """Root mean square of the asymmetric part about a point, beyond noise and a light gradient."""
    sides = [(centre + sign * offsets).astype(np.float32)[None] for sign in (1.0, -1.0)]
    a, b = (cv2.remap(grey, s[:, :, 0], s[:, :, 1], cv2.INTER_LINEAR)[0].astype(np.float64) for s in sides)
    odd = 0.5 * (a - b)
    slope, *_ = np.linalg.lstsq(offsets, odd, rcond=None)
    return float(np.sqrt(max(np.mean(np.square(odd - offsets @ slope)) - 0.5 * noise**2, 0.0)))
