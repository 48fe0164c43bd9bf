"""How perspective and lens bend a lattice in its image, as far as its own points tell; no camera need be known.

A pixel p leads to coordinates of the lattice by g = (homography) o (radial polynomial about a centre), a plane seen
through a lens.  Where g isn't linear, steps of the lattice and their opposites aren't opposite in the image:

    g(c + d + q) + g(c - d + q) = 2 g(c)    with    q = -1/2 G^-1 g''[d, d],  G = g'(c), to fourth order in d.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.optimize import least_squares

from gripmon.model.records import Array

FEWEST = 9
"""Points that determine how a plane looks, with some to spare."""
_LENS = 3
_NOISE_PX = 0.05
_CENTRE_SHARE = 0.1
"""Of the image's size: the standard deviation of the lens's centre about the image's, before the points are seen; and
of the lens's own part in the image's corner."""
_LENS_SHARE = 0.5
_STEP_PX = 2.0


def bends(cells: Array, at: Array, size_px: tuple[int, int]) -> Array:
    """(n, 3, 2): q of ``d`` = (x, y) px is ``[x², xy, y²]`` times these, at the points ``at`` (n, 2) px with the
    lattice coordinates ``cells`` (n, 2); 0 where fewer than :data:`FEWEST` don't tell, or all lie on a line.
    """
    out = np.zeros((len(at), 3, 2))
    if len(at) < FEWEST or np.linalg.svd(cells - cells.mean(axis=0), compute_uv=False)[1] < 1.0:
        return out
    view = _View(cells, at, size_px)
    unknown = view.fitted()
    if unknown is None:
        return out
    east, south = np.array([_STEP_PX, 0.0]), np.array([0.0, _STEP_PX])
    here = view.to_cells(unknown, at)
    e, w, s, n = (view.to_cells(unknown, at + way) for way in (east, -east, south, -south))
    diagonal = (
        view.to_cells(unknown, at + east + south)
        + view.to_cells(unknown, at - east - south)
        - view.to_cells(unknown, at + east - south)
        - view.to_cells(unknown, at - east + south)
    )
    slopes = np.stack([e - w, s - n], axis=2) / (2.0 * _STEP_PX)
    # Of g's second derivatives those by x x, x y (twice, as it stands twice in the form), y y.
    second = np.stack([e + w - 2.0 * here, 0.5 * diagonal, s + n - 2.0 * here], axis=2) / _STEP_PX**2
    out[:] = -0.5 * np.linalg.solve(slopes, second).transpose(0, 2, 1)
    return out


class _View:
    """A lattice in an image, scaled to about one."""

    def __init__(self, cells: Array, at: Array, size_px: tuple[int, int]) -> None:
        self._middle_px, self._scale_px = 0.5 * np.asarray(size_px, float), 0.5 * float(np.hypot(*size_px))
        self._middle, self._extent = cells.mean(axis=0), float(np.ptp(cells, axis=0).max())
        self._cells, self._at = (cells - self._middle) / self._extent, at
        # Of a residual on the lattice, in pixels.
        self._px = float(np.sqrt(np.linalg.det(np.cov(at.T)) / np.linalg.det(np.cov(self._cells.T))) ** 0.5)

    def fitted(self) -> Array | None:
        """Homography (8), lens (3) and its centre (2); None if there is no such view."""
        plane, _ = cv2.findHomography(self._normal(self._at), self._cells)
        if plane is None or not np.isfinite(plane).all() or plane[2, 2] == 0.0:
            return None
        start = np.concatenate([(plane / plane[2, 2]).ravel()[:8], np.zeros(_LENS + 2)])
        with np.errstate(all="ignore"):
            for loss in ("linear", "soft_l1"):
                found = least_squares(self._residuals, start, loss=loss, x_scale="jac", max_nfev=60)
                start = found.x
        return start if np.isfinite(start).all() and np.isfinite(found.cost) else None

    def to_cells(self, unknown: Array, at: Array) -> Array:
        """Pixels (n, 2) -> the lattice."""
        return self._to_plane(unknown, at) * self._extent + self._middle

    def _residuals(self, unknown: Array) -> Array:
        off = (self._to_plane(unknown, self._at) - self._cells).ravel() * (self._px / _NOISE_PX)
        lens, centre = unknown[8 : 8 + _LENS], unknown[8 + _LENS :]
        return np.concatenate([np.nan_to_num(off, nan=1e6), lens / _LENS_SHARE, centre / _CENTRE_SHARE])

    def _to_plane(self, unknown: Array, at: Array) -> Array:
        plane = np.append(unknown[:8], 1.0).reshape(3, 3)
        lens, centre = unknown[8 : 8 + _LENS], unknown[8 + _LENS :]
        off = self._normal(at) - centre
        r2 = np.square(off).sum(axis=1)
        ideal = centre + off * (1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[2])))[:, None]
        x, y, w = plane @ np.stack([*ideal.T, np.ones(len(at))])
        out: Array = np.stack([x / w, y / w], axis=1)
        return out

    def _normal(self, at: Array) -> Array:
        out: Array = (at - self._middle_px) / self._scale_px
        return out
