"""Calibration plates as a camera sees them: light on the sensor, ray by ray, from lens, pose and print.

Every border of the print is a ramp one sample wide at its true position, so that an outline is correct to first order
with any number of samples per pixel.  Nothing of the detection is used here.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array
from gripmon.model.targets import Charuco, Chequerboard, CircleGrid, StaggeredCircles, Target

SAMPLES = 2
"""Samples per pixel along each axis."""
_BEHIND_DN = 120.0
"""Grey value where a ray doesn't meet the plate's plane in front of the camera."""
_BAND_ROWS = 32
"""Rows of samples that are drawn at once: what is between stays in the processor's cache."""
Grey = NDArray[np.float32]


@dataclass(frozen=True)
class Print:
    """A plate's appearance.  ``dark`` and ``light``: grey values (DN); ``margin`` of the plate around its pattern, in
    squares or spacings, inf for a plate without a border; ``clutter``: what lies in its plane beyond that border;
    ``inverted``: dark and light exchanged; ``errors_m`` (rows, columns, 2): error of each point of the print.
    """

    dark: float = 40.0
    light: float = 200.0
    margin: float = 0.7
    clutter: Literal["waves", "mosaic", "plain"] = "waves"
    inverted: bool = False
    errors_m: Array | None = None


def points_of(target: Target) -> Array:
    """All points (n, 3) of a target by rows, in its frame (m)."""
    if isinstance(target, CircleGrid):
        return np.column_stack([np.array(target.places) * target.step_m, np.zeros(len(target.places))])
    if isinstance(target, Charuco):
        columns, rows, first = target.columns - 1, target.rows - 1, target.square_m
    else:
        columns, rows, first = target.columns, target.rows, 0.0
    step = _spacing_m(target)
    r, c = np.mgrid[:rows, :columns]
    return np.stack([first + step * c.ravel(), first + step * r.ravel(), np.zeros(columns * rows)], axis=1)


def facing(target: Target, middle_m: Sequence[float], tilt_rad: Sequence[float], roll_rad: float = 0.0) -> Array:
    """``cam_T_plate`` (4, 4) of a plate whose centre is at ``middle_m`` (3,), camera frame; it is rolled about the
    optical axis, then tilted about the camera's x and y axes.
    """
    rotation = exp_rotation(np.array([*tilt_rad, 0.0])) @ exp_rotation(np.array([0.0, 0.0, roll_rad]))
    return make_transform(rotation, np.asarray(middle_m) - rotation @ points_of(target).mean(axis=0))


@functools.lru_cache(maxsize=3)
def sample_rays(lens: LensSettings, samples: int = SAMPLES) -> Array:
    """Ideal coordinates (rows * samples, columns * samples, 2) of all samples; NaN outside the lens's domain."""
    u = (np.arange(lens.width_px * samples) + 0.5) / samples - 0.5
    v = (np.arange(lens.height_px * samples) + 0.5) / samples - 0.5
    camera = make_camera(lens)
    with np.errstate(invalid="ignore"):
        return np.stack([camera.undistort(np.stack([u, np.full(len(u), row)], axis=1)) for row in v])


def develop(grey: NDArray[np.floating], samples: int, blur_px: float) -> Grey:
    """Light (rows, columns) on the sensor from that of all samples, blurred by the lens."""
    light = np.asarray(grey, np.float32)
    if blur_px > 0.0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur_px * samples), np.float32)
    rows, columns = light.shape
    shape = (rows // samples, samples, columns // samples, samples)
    return np.ascontiguousarray(light.reshape(shape).mean(axis=(1, 3)), np.float32)


@dataclass(frozen=True)
class Plate:
    """A flat target at ``cam_T_plate`` (4, 4)."""

    target: Target
    cam_T_plate: Array
    print: Print = Print()

    def light(self, lens: LensSettings, blur_px: float, samples: int = SAMPLES) -> Grey:
        """Light (rows, columns) on the sensor, DN."""
        return develop(self.grey(sample_rays(lens, samples)), samples, blur_px)

    def grey(self, xy: Array) -> Array:
        """Grey values (rows, columns) that rays (rows, columns, 2) in ideal coordinates meet, DN; 0 where NaN."""
        to_plate = np.linalg.inv(np.column_stack([self.cam_T_plate[:3, :2], self.cam_T_plate[:3, 3]]))
        out = np.empty(xy.shape[:2])
        for top in range(0, len(xy), _BAND_ROWS):
            end, first = top + _BAND_ROWS, max(top - 1, 0)
            # With a row more on either side, which the slopes of the outer ones need.
            out[top:end] = self._grey_of(xy[first : end + 1], to_plate)[top - first :][:_BAND_ROWS]
        return out

    def _grey_of(self, xy: Array, to_plate: Array) -> Array:
        u, v = xy[..., 0], xy[..., 1]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            x, y, w = (row[0] * u + row[1] * v + row[2] for row in to_plate)
            print_ = self._print(_Grid(x / w, y / w))
            seen = np.where(w > 0.0, np.nan_to_num(print_, nan=_BEHIND_DN), _BEHIND_DN)
        return np.where(np.isfinite(u) & np.isfinite(v), seen, 0.0)

    def _print(self, grid: _Grid) -> Array:
        look, target, step = self.print, self.target, _spacing_m(self.target)
        if isinstance(target, CircleGrid):
            right, below = target.last
            dark, low, high = _discs(target, look.errors_m, grid), -0.5, (right + 0.5, below + 0.5)
        else:
            printed = grid if look.errors_m is None else grid.moved(*_shift(target, look.errors_m, grid))
            if isinstance(target, Charuco):
                low, high = 0.0, (float(target.columns), float(target.rows))
                dark = _squares(printed, step, low, high) + _marks(target, printed)
            else:
                low, high = -1.0, (float(target.columns), float(target.rows))
                dark = _squares(printed, step, low, high)
        if look.inverted:
            dark = 1.0 - dark
        plate = look.light + (look.dark - look.light) * dark
        if not np.isfinite(look.margin):
            return np.asarray(plate)
        m = look.margin
        inside = _box(grid, step * (low - m), (step * (high[0] + m), step * (high[1] + m)))
        beyond = ~(inside == 1.0)  # NaN, too
        share = inside[beyond]
        plate[beyond] = share * plate[beyond] + (1.0 - share) * _clutter(look.clutter, grid.x[beyond], grid.y[beyond])
        return np.asarray(plate)


class PlateBackdrop:
    """A plate behind the simulator's gripper, fixed to the camera."""

    def __init__(self, plate: Plate, lens: LensSettings, blur_px: float) -> None:
        self._light = plate.light(lens, blur_px)

    def render(self, cam_T_grip: Array, t_s: float, exposure_s: float) -> Grey:
        """As :class:`gripmon.simulate.render.Backdrop` requires."""
        return self._light.copy()


class _Grid:
    """Where the samples' rays meet the plate, x and y (rows, columns), m; and the size of one sample there."""

    def __init__(self, x: Array, y: Array) -> None:
        self.x, self.y = x, y
        self._slopes = np.gradient(x), np.gradient(y)

    @functools.cached_property
    def steps(self) -> tuple[Array, Array]:
        """Lengths (m) of a sample along x and along y."""
        (x_v, x_u), (y_v, y_u) = self._slopes
        return np.maximum(_length(x_u, x_v), 1e-12), np.maximum(_length(y_u, y_v), 1e-12)

    def moved(self, dx: Array, dy: Array) -> _Grid:
        return _Grid(self.x - dx, self.y - dy)

    def step(self, nx: Array | float, ny: Array | float) -> Array:
        """Length (m) of a sample along directions (nx, ny) on the plate."""
        (x_v, x_u), (y_v, y_u) = self._slopes
        return np.maximum(_length(nx * x_u + ny * y_u, nx * x_v + ny * y_v), 1e-12)


def _length(x: Any, y: Any) -> Array:
    """As np.hypot, in a fraction of its time: nothing here is too small or large to be squared."""
    return np.asarray(np.sqrt(x * x + y * y))


def _spacing_m(target: Target) -> float:
    return target.step_m if isinstance(target, CircleGrid) else target.square_m


def _covered(samples: Array) -> Array:
    """Part of a sample on the inner side of a border at this distance, in samples."""
    return np.asarray(np.clip(0.5 + samples, 0.0, 1.0))


def _discs(target: CircleGrid, errors_m: Array | None, grid: _Grid) -> Array:
    i, j = np.rint(grid.x / target.step_m), np.rint(grid.y / target.step_m)
    column = 0.5 * (i - j % 2) if isinstance(target, StaggeredCircles) else i
    inside = (column >= 0) & (column < target.columns) & (column % 1 == 0) & (j >= 0) & (j < target.rows)
    dx, dy = grid.x - i * target.step_m, grid.y - j * target.step_m
    if errors_m is not None:
        off = errors_m[np.where(inside, j, 0).astype(int), np.where(inside, column, 0).astype(int)]
        dx, dy = dx - off[..., 0], dy - off[..., 1]
    r = np.maximum(_length(dx, dy), 1e-9)
    return np.where(inside, _covered((0.5 * target.diameter_m - r) / grid.step(dx / r, dy / r)), 0.0)


def _squares(grid: _Grid, square_m: float, low: float, high: tuple[float, float]) -> Array:
    """Every second square from ``low`` to ``high`` (columns, rows), dark where the sum of its indices is even."""
    signs = []
    for value, step, end in zip((grid.x, grid.y), grid.steps, high, strict=True):
        square = value / square_m
        whole = np.clip(np.floor(square), low, end - 1.0)
        # Only lines between two squares change the colour, not the pattern's border.
        before = np.where(whole > low, square - whole, np.inf)
        behind = np.where(whole < end - 1.0, whole + 1.0 - square, np.inf)
        to_line = np.minimum(before, behind) * np.where(whole % 2 == 0, 1.0, -1.0) * square_m
        signs.append(2.0 * _covered(to_line / step) - 1.0)
    inside = _box(grid, low * square_m, (high[0] * square_m, high[1] * square_m))
    return np.asarray(inside * (0.5 + 0.5 * signs[0] * signs[1]))


def _box(grid: _Grid, low_m: float, high_m: tuple[float, float]) -> Array:
    """Part of each sample within a rectangle from (``low_m``, ``low_m``) to ``high_m``."""
    out = np.ones_like(grid.x)
    for value, step, high in zip((grid.x, grid.y), grid.steps, high_m, strict=True):
        out *= _covered((0.5 * (high - low_m) - np.abs(value - 0.5 * (high + low_m))) / step)
    return out


def _marks(target: Charuco, grid: _Grid) -> Array:
    """Only the markers in the white squares: they don't touch the squares' borders."""
    dark = _modules(target)
    modules = dark.shape[1] - 2
    i, j = np.floor(grid.x / target.square_m), np.floor(grid.y / target.square_m)
    white = (i >= 0) & (i < target.columns) & (j >= 0) & (j < target.rows) & ((i + j) % 2 == 1)
    number = np.where(white, (j * target.columns + i) // 2, 0).astype(int)
    sides = []
    for value, whole, step in zip((grid.x, grid.y), (i, j), grid.steps, strict=True):
        at = (value - (whole + 0.5) * target.square_m) * modules / target.marker_m + 0.5 * modules + 1.0
        border = np.clip(np.rint(np.nan_to_num(at)), 1, modules + 1)  # the nearest one between two modules
        beyond = _covered((at - border) * target.marker_m / modules / step)
        sides.append(((border.astype(int) - 1, 1.0 - beyond), (border.astype(int), beyond)))
    columns, rows = sides
    return white * sum(dark[number, v, u] * share_v * share_u for u, share_u in columns for v, share_v in rows)


@functools.lru_cache(maxsize=2)
def _modules(target: Charuco) -> NDArray[np.bool_]:
    """Which modules (markers, rows, columns) are dark, with one of white around each marker."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = dictionary.markerSize + 2
    marks = (dictionary.generateImageMarker(number, size) for number in range(target.columns * target.rows // 2))
    return np.array([np.pad(mark < 128, 1) for mark in marks])


def _shift(target: Chequerboard | Charuco, errors_m: Array, grid: _Grid) -> tuple[Array, Array]:
    """The print's error at each sample: linear between the corners."""
    first = target.square_m if isinstance(target, Charuco) else 0.0
    at = np.stack([np.nan_to_num((value - first) / target.square_m) for value in (grid.y, grid.x)])
    dx, dy = (map_coordinates(errors_m[:, :, k], at, order=1, mode="nearest") for k in (0, 1))
    return dx, dy


def _clutter(kind: str, x: Array, y: Array) -> Array:
    if kind == "plain":
        return np.full(x.shape, 130.0)
    waves = 130.0 + 40.0 * np.sin(300.0 * x) * np.cos(170.0 * y)
    if kind == "waves":
        return np.asarray(waves)
    # Two grids of patches, each patch with a value of its own, rotated against each other: corners everywhere.
    out = waves
    for angle, step in ((0.4, 0.013), (1.1, 0.007)):
        a = np.floor((x * np.cos(angle) - y * np.sin(angle)) / step)
        b = np.floor((x * np.sin(angle) + y * np.cos(angle)) / step)
        value = np.sin(12.9898 * a + 78.233 * b) * 43758.5453
        value = value - np.floor(value)
        out = np.where(value > 0.55, 255.0 * (value - 0.55) / 0.45, out)
    return np.asarray(out)
