"""Exact coverage of polygons seen through a lens: the share of each pixel that a face fills, blurred by the lens.

A mask M is the face's indicator convolved with the camera's point spread function (a Gaussian) and with the square
pixel, sampled at pixel centres.  By the divergence theorem its derivative along a row is an integral over the boundary,

    dM/dx (x, y) = ∮ K(x - x_b) K(y - y_b) dy_b,     K = Gaussian * unit box,

so each short piece of the boundary adds a small patch, and a running sum along the rows gives M.  K is smooth, so two
Gauss points per piece are enough, and curved boundaries cost nothing extra.  There is no supersampling and no aliasing:
the mask is what a sensor with full fill factor would see.

This module also has the ideal viewing rays of all pixels, on a coarse grid: smooth maps computed there are interpolated
to the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array

_PHASES = 2048
_REACH_SIGMAS = 3.3
_STEP_SIGMAS = 1.6
_GAUSS_POINTS = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
_VIEW_MARGIN = 1.06
_FARTHEST_IDEAL = 100.0
_OUTSIDE_PX = 16.0
_PROBES = 8

Mask = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Coverage:
    """The mask of one face in the window that it covers, clipped to the image: ``mask[v - top, u - left]``."""

    left: int
    top: int
    mask: Mask


class CoverageRaster:
    """Computes masks of faces in the camera frame, for one camera and one point spread function."""

    def __init__(self, camera: Camera, psf_sigma_px: float) -> None:
        self._camera = camera
        self._step_px = _STEP_SIGMAS * psf_sigma_px
        self._radius = _lens_radius(camera)
        self._reach = math.ceil(0.5 + _REACH_SIGMAS * psf_sigma_px)
        self._rows, self._columns = _kernel_tables(psf_sigma_px, self._reach)
        self._view_planes = _view_planes(camera)
        self._where, self._what = np.empty((0, 0, 0), dtype=np.intp), np.empty((0, 0, 0))

    def masks(self, polygons_cam_m: list[Array]) -> list[Coverage | None]:
        """One mask per polygon (k, 3), planar, counter-clockwise seen from the camera; None if it is out of view."""
        loops = [_clip(polygon, self._view_planes) for polygon in polygons_cam_m]
        pieces = _trace(self._camera, loops, self._step_px, self._radius)
        return [None if piece is None else self._accumulate(*piece) for piece in pieces]

    def _accumulate(self, points_px: Array, dy_px: Array) -> Coverage | None:
        """Sum the patches of boundary points (n, 2) with their vertical extents (n,), then integrate along the rows."""
        reach, width, height = self._reach, self._camera.width_px, self._camera.height_px
        left = max(int(points_px[:, 0].min()) - reach, 0)
        right = min(int(points_px[:, 0].max()) + reach + 2, width)
        top = max(int(points_px[:, 1].min()) - reach, 0)
        bottom = min(int(points_px[:, 1].max()) + reach + 2, height)
        if left >= right or top >= bottom:
            return None
        # A boundary left of the window still counts for all of its rows: move it just outside.
        u = np.maximum(points_px[:, 0] - left, -(reach + 1.5))
        v = points_px[:, 1] - top
        near = (u < right - left + reach - 1) & (v > -reach) & (v < bottom - top + reach - 1)
        u, v, dy = u[near], v[near], dy_px[near]
        if not len(u):
            return None  # no boundary in the window or left of it: nothing is covered
        column, row = np.floor(u), np.floor(v)
        weights_u = self._columns[((u - column) * _PHASES).astype(np.intp)]
        weights_v = self._rows[((v - row) * _PHASES).astype(np.intp)]
        pad = 2 * reach + 1
        stride = right - left + 2 * pad
        first = (row.astype(np.intp) + (pad - reach + 1)) * stride + (column.astype(np.intp) + (pad - reach + 1))
        patch = np.arange(2 * reach)[:, None] * stride + np.arange(2 * reach + 1)
        where, what = self._scratch(len(first))
        np.add(first[:, None, None], patch, out=where)
        np.multiply((weights_v * dy[:, None])[:, :, None], weights_u[:, None, :], out=what)
        rows = bottom - top + 2 * pad
        slopes = np.bincount(where.ravel(), what.ravel(), minlength=rows * stride).reshape(rows, stride)
        # Running sums along the rows as differences of an integral image: much faster than a cumulative sum.
        sums = np.asarray(cv2.integral(slopes))[pad : rows - pad + 1, pad + 1 : stride - pad + 1]
        mask = np.empty((bottom - top, right - left), np.float32)
        np.subtract(sums[1:], sums[:-1], out=mask)
        return Coverage(left, top, mask)

    def _scratch(self, count: int) -> tuple[NDArray[np.intp], Array]:
        """Index and weight arrays (count, rows, columns) of patches, reused: fresh memory costs more than the sums."""
        if len(self._where) < count:
            shape = (count + count // 2, 2 * self._reach, 2 * self._reach + 1)
            self._where, self._what = np.empty(shape, dtype=np.intp), np.empty(shape)
        return self._where[:count], self._what[:count]


def _kernel_tables(sigma_px: float, reach: int) -> tuple[Array, Array]:
    """Weights by sub-pixel phase: of K at 2 reach rows, and of K's integral over one step at 2 reach + 1 columns."""
    phase = (np.arange(_PHASES) + 0.5) / _PHASES
    offsets = np.arange(2 * reach + 2) - reach + 0.5  # of pixel borders
    distance = offsets[None, :] - phase[:, None]
    # K's integral up to a pixel border, and the integral of that: closed forms of a Gaussian's integrals.
    erf = np.vectorize(math.erf)
    cumulative = 0.5 * (1.0 + erf(distance / (sigma_px * math.sqrt(2.0))))
    integral = distance * cumulative + sigma_px / math.sqrt(2.0 * math.pi) * np.exp(-0.5 * (distance / sigma_px) ** 2)
    rows = np.diff(cumulative[:, : 2 * reach + 1], axis=1)
    step = np.diff(integral, axis=1, prepend=0.0)
    columns = np.diff(step, axis=1)
    return rows / rows.sum(axis=1, keepdims=True), columns / columns.sum(axis=1, keepdims=True)


def _view_planes(camera: Camera) -> Array:
    """Planes (p, 3) through the camera's centre, ``a·X >= 0`` inside: a convex cone, slightly wider than the view."""
    xy = _view_border(camera)
    centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    angle = np.linspace(0.0, 2.0 * np.pi, 17)[:-1]
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Each plane touches the field of view (its support function), widened by a margin.
    support = ((xy - centre) @ directions.T).max(axis=0) * _VIEW_MARGIN
    return np.column_stack([-directions, support + directions @ centre])


def _view_border(camera: Camera) -> Array:
    """Ideal coordinates (n, 2) of the image's border, where the lens maps it."""
    share = np.linspace(0.0, 1.0, 49)[:-1]
    zero, one = np.zeros_like(share), np.ones_like(share)
    sides = ((share, zero), (one, share), (1.0 - share, one), (zero, 1.0 - share))
    border = np.concatenate([np.stack(side, axis=1) for side in sides])
    xy = camera.undistort(border * (camera.width_px, camera.height_px) - 0.5)
    return xy[np.isfinite(xy).all(axis=1)]


def _lens_radius(camera: Camera) -> float:
    """Ideal radius up to which outlines are followed: the end of the lens model, or earlier, just outside the image.

    Infinite for a model without end.  A model stretches without bounds towards its end, so the radius is only as large
    as needed.
    """
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    centre = np.array([camera.cx_px, camera.cy_px])
    corner = np.maximum(centre, np.array([camera.width_px, camera.height_px]) - 1.0 - centre)
    enough_px = float(np.hypot(*corner)) + _OUTSIDE_PX

    def within(radius: float) -> bool:
        reach = np.hypot(*(camera.distort(radius * ring) - centre).T)
        return bool(np.isfinite(reach).all() and reach.min() < enough_px)

    if np.isfinite(camera.distort(_FARTHEST_IDEAL * ring)).all():
        return math.inf
    good, bad = 0.0, _FARTHEST_IDEAL
    for _ in range(60):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if within(middle) else (good, middle)
    return good * (1.0 - 1e-7)


def _clip(polygon: Array, planes: Array) -> Array:
    """Cut a planar polygon (k, 3) by half spaces ``a·X >= 0`` (Sutherland-Hodgman); the result may be empty."""
    heights = polygon @ planes.T
    crossed = (heights < 0.0).any(axis=0)
    if not crossed.any():
        return polygon
    if (heights < 0.0).all(axis=0).any():
        return polygon[:0]
    corners: list[tuple[float, float, float]] = [tuple(p) for p in polygon.tolist()]
    for a, b, c in planes[crossed].tolist():
        kept: list[tuple[float, float, float]] = []
        x0, y0, z0 = corners[-1]
        h0 = a * x0 + b * y0 + c * z0
        for x1, y1, z1 in corners:
            h1 = a * x1 + b * y1 + c * z1
            if (h0 < 0.0) != (h1 < 0.0):
                s = h0 / (h0 - h1)
                kept.append((x0 + s * (x1 - x0), y0 + s * (y1 - y0), z0 + s * (z1 - z0)))
            if h1 >= 0.0:
                kept.append((x1, y1, z1))
            x0, y0, z0, h0 = x1, y1, z1, h1
        if len(kept) < 3:
            return polygon[:0]
        corners = kept
    return np.array(corners)


def _trace(camera: Camera, loops: list[Array], step_px: float, radius: float) -> list[tuple[Array, Array] | None]:
    """Points (n, 2) on each loop's boundary in the distorted image, and the vertical extent (n,) of each."""
    visible = [k for k, loop in enumerate(loops) if len(loop)]
    out: list[tuple[Array, Array] | None] = [None] * len(loops)
    if not visible:
        return out
    starts = np.concatenate([loops[k] for k in visible])
    ends = np.concatenate([np.roll(loops[k], -1, axis=0) for k in visible])
    a, b = starts[:, :2] / starts[:, 2:], ends[:, :2] / ends[:, 2:]
    counts = _piece_counts(camera, a, b, step_px, radius)
    nodes = counts + 1
    edge = np.repeat(np.arange(len(a)), nodes)
    index = np.arange(len(edge)) - np.repeat(np.cumsum(nodes) - nodes, nodes)
    share = (index / counts[edge])[:, None]
    uv = _distort(camera, a[edge] + share * (b - a)[edge], radius)
    pieces = np.flatnonzero(index[1:] > 0)
    begin, extent = uv[pieces], uv[pieces + 1] - uv[pieces]
    points = (begin[:, None] + _GAUSS_POINTS[:, None] * extent[:, None]).reshape(-1, 2)
    dy = np.repeat(0.5 * extent[:, 1], 2)
    loop_pieces = 2 * np.add.reduceat(counts, np.cumsum([0] + [len(loops[k]) for k in visible[:-1]]))
    limits = np.cumsum(loop_pieces)
    for k, end, size in zip(visible, limits.tolist(), loop_pieces.tolist(), strict=True):
        out[k] = (points[end - size : end], dy[end - size : end])
    return out


def _piece_counts(camera: Camera, a: Array, b: Array, step_px: float, radius: float) -> NDArray[np.intp]:
    """Number of pieces (e,) into which the lines from a to b (e, 2) are cut, none longer than the step."""
    share = np.linspace(0.0, 1.0, _PROBES + 1)[None, :, None]
    probes = a[:, None] + share * (b - a)[:, None]
    uv = _distort(camera, probes.reshape(-1, 2), radius).reshape(len(a), _PROBES + 1, 2)
    longest = np.linalg.norm(np.diff(uv, axis=1), axis=2).max(axis=1)
    return np.ceil(longest * (_PROBES / step_px)).astype(np.intp) + 1


def _distort(camera: Camera, xy: Array, radius: float) -> Array:
    """Ideal points (n, 2) -> pixels; points beyond the radius are moved to it, which is still outside the image."""
    if math.isfinite(radius):
        xy = xy * np.minimum(1.0, radius / np.maximum(np.hypot(xy[:, 0], xy[:, 1]), radius))[:, None]
    return camera.distort(xy)


CELL_PX = 8
_FARTHEST_TEXEL = 15000.0


class RayGrid:
    """Rays through the centres of 8 x 8 px cells, with one cell of margin around the image."""

    def __init__(self, camera: Camera) -> None:
        self.width_px, self.height_px = camera.width_px, camera.height_px
        columns, rows = -(-self.width_px // CELL_PX) + 2, -(-self.height_px // CELL_PX) + 2
        u = (np.arange(columns) - 0.5) * CELL_PX - 0.5
        v = (np.arange(rows) - 0.5) * CELL_PX - 0.5
        grid = np.stack(np.meshgrid(u, v), axis=-1)
        xy = camera.undistort(grid.reshape(-1, 2))
        if not np.isfinite(xy).all():  # outside the lens's domain: repeat the image's border
            inside = np.clip(grid, 0.0, (self.width_px - 1.0, self.height_px - 1.0))
            xy = np.where(np.isfinite(xy), xy, camera.undistort(inside.reshape(-1, 2)))
        self.seen = np.isfinite(xy).all(axis=1).reshape(rows, columns)
        self._xy1 = np.concatenate([np.nan_to_num(xy), np.ones((len(xy), 1))], axis=1).reshape(rows, columns, 3)
        centre = camera.undistort(np.array([[0.5 * self.width_px, 0.5 * self.height_px]]))[0]
        self.view_centre = np.array([centre[0], centre[1], 1.0]) / np.sqrt(centre @ centre + 1.0)

    def plane_coordinates(
        self, cam_T_plane: Array, px_per_m: float, window: tuple[slice, slice] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where the rays of a window of cells meet the plane z = 0 of a frame: its x and y times ``px_per_m``."""
        rays = self._xy1 if window is None else self._xy1[window]
        matrix = np.linalg.inv(np.column_stack([cam_T_plane[:3, :2], cam_T_plane[:3, 3]]))
        matrix[:2] *= px_per_m
        x, y, w = np.moveaxis(rays @ matrix.T, -1, 0)
        w = np.maximum(w, 1e-9)  # rays above the plane's horizon meet nothing: send them far away
        limit = _FARTHEST_TEXEL
        return (
            np.clip(x / w, -limit, limit).astype(np.float32),
            np.clip(y / w, -limit, limit).astype(np.float32),
        )

    def enlarge(self, coarse: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate a map on all cells to all pixels."""
        large = enlarge_cells(coarse)
        return large[CELL_PX : CELL_PX + self.height_px, CELL_PX : CELL_PX + self.width_px]

    def window(self, left: int, top: int, width: int, height: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Cells that cover a pixel window with margin, and the window's position in the enlarged cells."""
        first_u, first_v = left // CELL_PX, top // CELL_PX
        last_u, last_v = (left + width - 1) // CELL_PX + 3, (top + height - 1) // CELL_PX + 3
        u, v = left - (first_u - 1) * CELL_PX, top - (first_v - 1) * CELL_PX
        return (slice(first_v, last_v), slice(first_u, last_u)), (slice(v, v + height), slice(u, u + width))


def enlarge_cells(coarse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values at cell centres -> at the pixels of these cells, linear between; constant beyond the outermost centres."""
    rows, columns = coarse.shape
    large = cv2.resize(coarse, (columns * CELL_PX, rows * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, dtype=np.float32)
