"""Corners of a chequerboard in an image: where four squares meet, dark and light by turns."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.calibrate.detection.lattice import Index, find_lattice, trimmed
from gripmon.calibrate.detection.pictures import Grey
from gripmon.model.records import Array

SCALES = (1.0, 2.0, 3.5)
"""Standard deviations (px) of the smoothing at which corners are looked for."""
MOST_CANDIDATES = 4000
WEAKEST = 0.02
"""Of the strongest candidates' strength."""
_RING = 32
_SECOND = 2
_LATTICES = 3


@dataclass(frozen=True)
class _Turns:
    """Neighbouring corners are each other's negative: where one has dark squares, the other has light ones."""

    second: NDArray[np.complex128]

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        product = complex(self.second[a] * np.conj(self.second[b]))
        return product.real < -0.4 * abs(product)

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        # A knight's move leads to a negative, too; then less two steps the other way it is shorter.
        return all(
            np.hypot(*(one + side * two)) > np.hypot(*one)
            for one, two in ((a_px, 2.0 * b_px), (b_px, 2.0 * a_px))
            for side in (1.0, -1.0)
        )


def find_corners(grey: Grey, columns: int, rows: int) -> list[dict[Index, tuple[float, float]]]:
    """Lattices of corners (column, row) -> (u, v), to about a pixel: the one that fits into ``columns`` x ``rows``,
    either way round, and shows the most contrast in all its corners together, or else what was found instead; empty if
    there is none.
    """
    best: dict[Index, tuple[float, float]] = {}
    shown = 0.0
    others: list[dict[Index, tuple[float, float]]] = []
    for scale in SCALES:
        candidates = saddles(grey, scale)
        good, second = crossing(grey, candidates, np.full(len(candidates), 2.0 * scale + 2.0))
        candidates, second = candidates[good], second[good]
        for _ in range(_LATTICES):
            lattice = find_lattice(candidates, _Turns(second))
            if not lattice:
                break
            chosen = np.array(list(lattice.values()))
            lattice = trimmed(_wide(grey, candidates, lattice), columns, rows)
            found = {cell: (float(candidates[i, 0]), float(candidates[i, 1])) for cell, i in lattice.items()}
            contrast = float(np.abs(second[list(lattice.values())]).sum())
            if fits(found, columns, rows):
                if contrast > shown:
                    best, shown = found, contrast
            elif len(found) >= 9:
                others.append(found)
            left = np.delete(np.arange(len(candidates)), chosen)
            candidates, second = candidates[left], second[left]
        if len(best) == columns * rows:
            break
    return [best or max(others, key=len)] if best or others else []


def fits(lattice: dict[Index, tuple[float, float]], columns: int, rows: int) -> bool:
    """Whether it can be a part of so many columns and rows, either way round, and is enough of it to be told."""
    if len(lattice) < 9:
        return False
    cells = np.array(list(lattice))
    seen = cells.max(axis=0) - cells.min(axis=0) + 1
    return bool(max(seen) <= max(columns, rows) and min(seen) <= min(columns, rows) and min(seen) >= 2)


def _wide(grey: Grey, candidates: Array, lattice: dict[Index, int]) -> dict[Index, int]:
    """Looked at once more, in rings as wide as the squares allow: corners of the board's rim are none of its own."""
    indices = np.array(list(lattice.values()))
    steps = cKDTree(candidates[indices]).query(candidates[indices], 2)[0][:, 1]
    good, _ = crossing(grey, candidates[indices], 0.35 * steps)
    kept = set(indices[good].tolist())
    return {cell: index for cell, index in lattice.items() if index in kept}


def saddles(grey: Grey, sigma_px: float) -> Array:
    """Candidates (n, 2): where the image bends up one way and down the other the most, the strongest ones."""
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3)
    strength = xy * xy - xx * yy  # all three kernels have a gain of 4
    radius = round(2.0 * sigma_px) + 1
    peak = cv2.dilate(strength, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    floor = WEAKEST * float(np.partition(strength.ravel(), -64)[-64])
    rows, columns = np.nonzero((strength >= peak) & (strength > max(floor, 1e-3)))
    if len(rows) > MOST_CANDIDATES:
        strongest = np.argsort(strength[rows, columns])[-MOST_CANDIDATES:]
        rows, columns = rows[strongest], columns[strongest]
    return np.stack([columns, rows], axis=1).astype(np.float64)


def crossing(grey: Grey, points: Array, radius_px: Array) -> tuple[NDArray[np.bool_], NDArray[np.complex128]]:
    """(n,) where a ring about a point is dark, light, dark, light: two edges cross there, rather than meet; and which
    way and how strongly, as the ring's second harmonic.
    """
    if not len(points):
        return np.zeros(0, bool), np.zeros(0, np.complex128)
    angles = 2.0 * np.pi / _RING * np.arange(_RING)
    ring = points[:, None] + radius_px[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    at = ring.astype(np.float32)
    levels = cv2.remap(grey, at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    harmonics = np.fft.rfft(levels.astype(np.float64), axis=1)[:, 1:]
    power = np.square(np.abs(harmonics))
    # Two crossing edges have even harmonics alone: what is opposite is alike.
    even, odd = power[:, 1::2].sum(axis=1), power[:, 0::2].sum(axis=1)
    second = harmonics[:, _SECOND - 1]
    inside = ((points - radius_px[:, None] > 0) & (points + radius_px[:, None] < np.array(grey.shape[::-1]) - 1)).all(
        axis=1
    )
    good = (odd < 0.25 * even) & (power[:, _SECOND - 1] > 0.5 * even) & (even > (3.0 * _RING) ** 2 / 4.0) & inside
    return good, second
