"""Images of calibration plates, ray cast through :mod:`gripmon.model.camera`: nothing of the detection is in here."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import exp_rotation
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, Chequerboard, CircleGrid, Target

Cover = tuple[Array, float]
"""A polygon (k, 2) in the image (px) and its grey value: something in front of the plate."""


@dataclass(frozen=True)
class Look:
    """How the image is taken.  ``falloff``: part of the light that is gone at the darkest border; ``clutter`` "waves",
    "mosaic" (full of corners) or "plain" beyond the plate; ``margin``: of the plate around its pattern, in squares or
    spacings; ``inverted``: light and dark of the plate exchanged; ``errors_m`` (rows, columns, 2): of the print, at its
    points.
    """

    supersampling: int = 3
    blur_px: float = 0.6
    noise: float = 1.5
    dark: float = 40.0
    light: float = 200.0
    falloff: float = 0.0
    clutter: str = "waves"
    margin: float = 0.7
    inverted: bool = False
    mirrored: bool = False
    errors_m: Array | None = None


def points_of(target: Target) -> Array:
    """All points (n, 3) of a target by rows, in its frame (m)."""
    if isinstance(target, Charuco):
        columns, rows, step, first = target.columns - 1, target.rows - 1, target.square_m, target.square_m
    else:
        step = target.square_m if isinstance(target, Chequerboard) else target.spacing_m
        columns, rows, first = target.columns, target.rows, 0.0
    r, c = np.mgrid[:rows, :columns]
    return np.stack([first + step * c.ravel(), first + step * r.ravel(), np.zeros(columns * rows)], axis=1)


def pose(target: Target, centre_m: Sequence[float], tilt_rad: Sequence[float], roll_rad: float = 0.0) -> Array:
    """``cam_T_plate`` (4, 4), its middle at ``centre_m`` (camera frame), rolled, then tilted about x, y."""
    out = np.eye(4)
    out[:3, :3] = exp_rotation(np.array([*tilt_rad, 0.0])) @ exp_rotation(np.array([0.0, 0.0, roll_rad]))
    out[:3, 3] = np.asarray(centre_m) - out[:3, :3] @ points_of(target).mean(axis=0)
    return out


def true_uv(settings: LensSettings, cam_T_plate: Array, plate_m: Array) -> Array:
    """Pixels (n, 2) of points on the plate."""
    return make_camera(settings).project(plate_m @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])


def fingers(settings: LensSettings, reach: float = 0.3, height: float = 0.35) -> list[Cover]:
    """Two fingers from the left and the right border, each over this part of the image's width."""
    w, h = settings.width_px, settings.height_px
    top, bottom = (0.5 - 0.5 * height) * h, (0.5 + 0.5 * height) * h
    left = np.array([[-5, top - 9], [reach * w, top], [reach * w + 4, bottom], [-5, bottom + 6]])
    right = np.array([[w + 5, top + 4], [(1 - reach) * w, top], [(1 - reach) * w - 6, bottom], [w + 5, bottom]])
    return [(left, 115.0), (right, 85.0)]


def render(
    settings: LensSettings,
    cam_T_plate: Array,
    target: Target,
    look: Look = Look(),
    *,
    covers: Sequence[Cover] = (),
    solid: Callable[[Array, Array], Array] | None = None,
    seed: int = 0,
) -> Image:
    """An image (H, W) of 8 bit.  ``solid`` takes ideal coordinates (n, 2) and what is seen there, (n,) grey values, and
    gives what is seen with something in front.
    """
    rng, ss = np.random.default_rng(seed), look.supersampling
    xy = _rays(settings, ss)
    normal = cam_T_plate[:3, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (normal @ cam_T_plate[:3, 3]) / (xy @ normal[:2] + normal[2])
        rotation = cam_T_plate[:3, :3].astype(np.float64)
        offset = rotation.T @ cam_T_plate[:3, 3]
        x = depth * (xy @ rotation[:2, 0] + rotation[2, 0]) - offset[0]
        y = depth * (xy @ rotation[:2, 1] + rotation[2, 1]) - offset[1]
        grey = np.where(depth > 0.0, _grey(target, look, x, y), 120.0)
    if solid is not None:
        grey = solid(xy, grey)
    grey = np.nan_to_num(grey, nan=0.0).reshape(settings.height_px * ss, settings.width_px * ss).astype(np.float32)
    if look.mirrored:
        grey = np.ascontiguousarray(grey[:, ::-1])
    for polygon, level in covers:
        # A pixel's centre has an integer coordinate, before supersampling and after.
        corners = np.rint(((np.asarray(polygon) + 0.5) * ss - 0.5) * 256.0).astype(np.int32)
        cv2.fillPoly(grey, [corners], level, lineType=cv2.LINE_8, shift=8)
    if look.blur_px > 0.0:
        grey = cv2.GaussianBlur(grey, (0, 0), look.blur_px * ss)
    image = grey.reshape(settings.height_px, ss, settings.width_px, ss).mean(axis=(1, 3), dtype=np.float64)
    if look.falloff:
        image = image * (1.0 - look.falloff * np.linspace(0.0, 1.0, settings.width_px))
    return np.clip(np.rint(image + rng.normal(0.0, look.noise, image.shape)), 0, 255).astype(np.uint8)


@functools.lru_cache(maxsize=3)
def _rays(settings: LensSettings, ss: int) -> Array:
    """Ideal coordinates (n, 2) of all samples, row by row."""
    u = (np.arange(settings.width_px * ss) + 0.5) / ss - 0.5
    v = (np.arange(settings.height_px * ss) + 0.5) / ss - 0.5
    camera = make_camera(settings)
    with np.errstate(invalid="ignore"):
        return np.concatenate([camera.undistort(np.stack([u, np.full(len(u), row)], axis=1)) for row in v])


def _grey(target: Target, look: Look, x: Array, y: Array) -> Array:
    if look.errors_m is not None:
        x, y = _as_printed(target, look.errors_m, x, y)
    if isinstance(target, Charuco):
        dark = _charuco(target, x, y)
        inside = _within(x, y, target.square_m, 0.0, (target.columns, target.rows), look.margin)
    elif isinstance(target, Chequerboard):
        i, j = np.floor(x / target.square_m), np.floor(y / target.square_m)
        squares = (i >= -1) & (i < target.columns) & (j >= -1) & (j < target.rows)
        dark = squares & ((i + j) % 2 == 0)
        inside = _within(x, y, target.square_m, -1.0, (target.columns, target.rows), look.margin)
    else:
        i, j = np.rint(x / target.spacing_m), np.rint(y / target.spacing_m)
        lattice = (i >= 0) & (i < target.columns) & (j >= 0) & (j < target.rows)
        distance = np.hypot(x - i * target.spacing_m, y - j * target.spacing_m)
        dark = lattice & (distance < 0.5 * target.diameter_m)
        last = (target.columns - 0.5, target.rows - 0.5)
        inside = _within(x, y, target.spacing_m, -0.5, last, look.margin)
    plate = np.where(dark != look.inverted, look.dark, look.light)
    return np.where(inside, plate, _clutter(look.clutter, x, y))


def _within(x: Array, y: Array, step_m: float, low: float, high: tuple[float, float], margin: float) -> Array:
    """On the plate, whose pattern reaches from ``low`` to ``high`` (columns, rows), in steps."""
    right, bottom = ((h + margin) * step_m for h in high)
    return (x > (low - margin) * step_m) & (x < right) & (y > (low - margin) * step_m) & (y < bottom)


def _clutter(kind: str, x: Array, y: Array) -> Array:
    if kind == "plain":
        return np.full(x.shape, 130.0)
    waves = 130.0 + 40.0 * np.sin(300.0 * x) * np.cos(170.0 * y)
    if kind == "waves":
        return waves
    # Two grids of patches with a value of their own each, turned against each other: corners everywhere.
    out = waves
    for angle, step in ((0.4, 0.013), (1.1, 0.007)):
        a = np.floor((x * np.cos(angle) - y * np.sin(angle)) / step)
        b = np.floor((x * np.sin(angle) + y * np.cos(angle)) / step)
        value = np.sin(12.9898 * a + 78.233 * b) * 43758.5453
        value = value - np.floor(value)
        out = np.where(value > 0.55, 255.0 * (value - 0.55) / 0.45, out)
    return out


def _charuco(target: Charuco, x: Array, y: Array) -> Array:
    board, square_px = _board(target, 120), 120
    with np.errstate(invalid="ignore"):
        column = np.floor(x / target.square_m * square_px)
        row = np.floor(y / target.square_m * square_px)
        inside = (column >= 0) & (row >= 0) & (column < board.shape[1]) & (row < board.shape[0])
    at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    return inside & (board[at] < 128)


@functools.lru_cache(maxsize=2)
def _board(target: Charuco, square_px: int) -> Image:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.columns, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.square_m, target.marker_m, dictionary)
    return board.generateImage((target.columns * square_px, target.rows * square_px), marginSize=0, borderBits=1)


def _as_printed(target: Target, errors_m: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Where on the perfect pattern the print shows at (x, y): discs move as a whole, between corners it is linear."""
    first = target.square_m if isinstance(target, Charuco) else 0.0
    step = target.spacing_m if isinstance(target, CircleGrid) else target.square_m
    at = np.stack([np.nan_to_num((y - first) / step), np.nan_to_num((x - first) / step)])
    order = 0 if isinstance(target, CircleGrid) else 1
    dx, dy = (map_coordinates(errors_m[:, :, k], at, order=order, mode="nearest") for k in (0, 1))
    return x - dx, y - dy
