"""Surfaces of the simulated world, drawn once from a seed: brushed metal, print, skin, and cluttered tables.

Textures of solids are float32 factors with mean near 1; tables are uint8 grey values that tile without a seam.

Lines and areas at given positions of a body are factors on its faces' textures: marks on fingers, lines on objects.
Sharp borders are spread over a texel, and blurred like the lens does: a texel is about a pixel.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.simulate.scenario import Background, FingerMark, ObjectLook
from gripmon.simulate.solids import Solid

Factor = NDArray[np.float32]
Grey = NDArray[np.uint8]
Rng = np.random.Generator

_SCRATCH_PX = 8
"""Around a scratch: its blur of 0.6 px (sigma) reaches 3 px."""


def metal(rng: Rng, height_px: int, width_px: int, px_per_m: float, strength: float) -> Factor:
    """Metal brushed along the rows, with clouds, grain and a few scratches; ``strength`` is roughly their contrast."""
    out, generator = _metal(json.dumps(rng.bit_generator.state), height_px, width_px, px_per_m, strength)
    rng.bit_generator.state = json.loads(generator)
    return out


@functools.lru_cache(maxsize=64)
def _metal(generator: str, height_px: int, width_px: int, px_per_m: float, strength: float) -> tuple[Factor, str]:
    """Many sequences show the same fingers, and a texture takes as long as half a frame.  ``generator``: the state of
    what it is drawn from, before and after.
    """
    rng = np.random.default_rng()
    rng.bit_generator.state = json.loads(generator)
    mm = px_per_m * 1e-3
    brushed = _noise(rng, height_px, width_px, 4.0 * mm, 0.5)
    clouds = _noise(rng, height_px, width_px, 3.0 * mm, 2.0 * mm)
    grain = _noise(rng, height_px, width_px, 0.7, 0.7)
    out = 1.0 + strength * (0.45 * brushed + 0.35 * clouds + 0.2 * grain)
    for _ in range(int(rng.poisson(height_px * width_px / mm**2 / 60.0))):
        start = rng.uniform((0, 0), (width_px, height_px))
        turn = rng.uniform(0.0, 2.0 * math.pi)
        end = start + rng.uniform(1.0, 6.0) * mm * np.array([math.cos(turn), math.sin(turn)])
        low, high = np.minimum(start, end).astype(int) - _SCRATCH_PX, np.maximum(start, end).astype(int) + _SCRATCH_PX
        low = np.maximum(low, 0)
        around = out[low[1] : high[1], low[0] : high[0]]
        line = np.zeros_like(around)
        cv2.line(line, _fixed(start - low), _fixed(end - low), 1.0, 1, cv2.LINE_8, 4)
        around += strength * float(rng.choice([-1.2, 1.0, 1.8])) * cv2.GaussianBlur(line, (0, 0), 0.6)
    fall_off = np.linspace(0.5, -0.5, width_px, dtype=np.float32)
    out = np.maximum(out + 0.8 * strength * fall_off, 0.2).astype(np.float32)
    out.flags.writeable = False
    return out, json.dumps(rng.bit_generator.state)


def printed(rng: Rng, height_px: int, width_px: int, px_per_m: float) -> Factor:
    """Cardboard with print: frames, bars, lines of text-like blobs, speckles."""
    grey = np.full((height_px, width_px), 205, np.uint8)
    mm = max(px_per_m * 1e-3, 0.5)
    for _ in range(3 + int(height_px * width_px / (mm * 14.0) ** 2)):
        x, y = rng.integers(0, width_px), rng.integers(0, height_px)
        _print_block(rng, grey, int(x), int(y), mm)
    speckle = _noise(rng, height_px, width_px, 0.8, 0.8)
    out = cv2.GaussianBlur(grey.astype(np.float32) / 180.0, (0, 0), 0.6) + 0.05 * speckle
    return out.astype(np.float32)


def streak(rng: Rng, columns: int, strength: float) -> Factor:
    """A lamp's reflection (1, columns) in a brushed face: a soft bright band across it, at a random place along it."""
    centre, width = rng.uniform(0.1, 0.9), rng.uniform(0.05, 0.15)
    along = (np.arange(columns, dtype=np.float32) + 0.5) / columns
    band = 1.0 + strength * np.exp(-0.5 * ((along - centre) / width) ** 2)
    return np.asarray(band[None, :], dtype=np.float32)


def skin(rng: Rng, height_px: int, width_px: int, px_per_m: float) -> Factor:
    """Soft blotches, creases across the fingers, shading towards the borders."""
    mm = px_per_m * 1e-3
    blotches = _noise(rng, height_px, width_px, 4.0 * mm, 4.0 * mm)
    out = 1.0 + 0.06 * blotches + 0.03 * _noise(rng, height_px, width_px, 0.3 * mm, 1.0)
    across = np.abs(np.linspace(-1.0, 1.0, height_px, dtype=np.float32))[:, None]
    for _ in range(14):
        x = int(rng.integers(0, width_px))
        y = int(rng.integers(0, height_px))
        crease = np.zeros_like(out)
        axes = (max(int(0.3 * mm), 1), max(int(4 * mm), 2))
        cv2.ellipse(crease, (x, y), axes, float(rng.uniform(-25, 25)), 0, 360, 1.0, -1)
        out -= 0.25 * cv2.GaussianBlur(crease, (0, 0), 0.5 * mm)
    return np.maximum(out - 0.12 * across, 0.2).astype(np.float32)


def table(rng: Rng, settings: Background, size_px: int, px_per_m: float) -> Grey:
    """A tile (size_px, size_px) of the table's pattern with its cables; repeats without a seam."""
    painters: dict[str, Callable[[Rng, int, float], NDArray[np.float32]]] = {
        "plain": lambda r, n, s: 0.15 * _tile_noise(r, n, 20e-3 * s),
        "chequer": _chequer,
        "printed": _papers,
        "stripes": _stripes,
        "speckle": lambda r, n, s: _threshold(r, n, 0.9e-3 * s),
        "blobs": _blobs,
        "discs": _discs,
    }
    pattern = painters[settings.kind](rng, size_px, px_per_m)
    pattern = pattern + 0.06 * _tile_noise(rng, size_px, 0.8) + 0.08 * _tile_noise(rng, size_px, 12e-3 * px_per_m)
    grey = settings.level_dn * (1.0 + settings.contrast * pattern)
    out = np.clip(grey, 0.0, 255.0).astype(np.uint8)
    for _ in range(settings.cables):
        _cable(rng, out, px_per_m)
    return out


def _noise(rng: Rng, height_px: int, width_px: int, sigma_x_px: float, sigma_y_px: float) -> Factor:
    """Smoothed Gaussian noise of variance 1."""
    white = rng.standard_normal((height_px, width_px), np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), max(sigma_x_px, 0.3), sigmaY=max(sigma_y_px, 0.3))
    return (smooth - smooth.mean()) / max(float(smooth.std()), 1e-6)


def _tile_noise(rng: Rng, size_px: int, sigma_px: float) -> Factor:
    """Like ``_noise`` but without a seam; coarse noise is computed small and enlarged."""
    shrink = max(int(sigma_px / 3.0), 1)
    small = size_px // shrink
    white = rng.standard_normal((small, small), np.float32)
    pad = min(4 * math.ceil(sigma_px / shrink) + 2, small)
    smooth = cv2.GaussianBlur(np.pad(white, pad, mode="wrap"), (0, 0), max(sigma_px / shrink, 0.3))
    smooth = (smooth - smooth.mean()) / smooth.std()
    if shrink == 1:
        return smooth[pad:-pad, pad:-pad]
    crop = smooth[pad - 2 : small + pad + 2, pad - 2 : small + pad + 2]
    large = cv2.resize(crop, None, fx=size_px / small, fy=size_px / small, interpolation=cv2.INTER_CUBIC)
    edge = (large.shape[0] - size_px) // 2
    return large[edge : edge + size_px, edge : edge + size_px]


def _chequer(rng: Rng, size_px: int, px_per_m: float) -> Factor:
    squares = max(2 * round(size_px / px_per_m / (2.0 * 0.035)), 2)
    odd = (np.arange(size_px) * squares) // size_px % 2
    rows = (np.array([odd, 1 - odd]) * 1.3 - 0.65).astype(np.float32)
    wear = _tile_noise(rng, size_px, 8e-3 * px_per_m)
    return cv2.GaussianBlur(rows[odd], (0, 0), 0.6) + 0.1 * wear


def _discs(rng: Rng, size_px: int, px_per_m: float) -> Factor:
    """A calibration plate: dark discs of 4 mm, 8 mm apart, on white."""
    count = max(round(size_px / px_per_m / 8e-3), 1)
    pitch_px = size_px / count
    ticks = (np.arange(size_px) + rng.uniform(0.0, pitch_px)) % pitch_px - 0.5 * pitch_px
    distance_px = np.hypot(ticks[:, None], ticks[None, :])
    disc = np.clip(0.5 + 2e-3 * px_per_m - distance_px, 0.0, 1.0)
    return (0.2 - 1.1 * disc).astype(np.float32)


def _stripes(rng: Rng, size_px: int, px_per_m: float) -> Factor:
    row = np.zeros(size_px, np.float32)
    x = 0
    while x < size_px:
        width = int(rng.uniform(2e-3, 18e-3) * px_per_m) + 1
        row[x : x + width] = rng.uniform(-0.9, 0.9)
        x += width
    shift = ((np.arange(size_px) * int(rng.integers(1, 3))) % size_px)[:, None]
    return cv2.GaussianBlur(row[(np.arange(size_px)[None, :] + shift) % size_px], (0, 0), 0.6)


def _threshold(rng: Rng, size_px: int, sigma_px: float) -> Factor:
    fine = _tile_noise(rng, size_px, sigma_px)
    coarse = _tile_noise(rng, size_px, 14.0 * sigma_px)
    value = fine + 0.9 * coarse
    return (0.55 * np.tanh(4.0 * (value - 0.6)) + 0.3 * np.tanh(4.0 * (value + 0.9))).astype(np.float32)


def _blobs(rng: Rng, size_px: int, px_per_m: float) -> Factor:
    """Scattered offcuts and washers: discs, rings and rectangles in all greys."""
    canvas = np.full((size_px, size_px), 128, np.uint8)
    mm = px_per_m * 1e-3
    for _ in range(int(0.9 * (size_px / (11.0 * mm)) ** 2)):
        centre = rng.uniform(0, size_px, 2)
        grey = int(rng.integers(10, 246))
        radius = float(rng.uniform(2.0, 8.0)) * mm
        if rng.random() < 0.45:
            thickness = -1 if rng.random() < 0.7 else max(int(0.35 * radius), 1)
            _everywhere(canvas, centre, radius, lambda img, c, r=radius, g=grey, w=thickness: _disc(img, c, r, g, w))
        else:
            corners = _rectangle(rng, radius)
            reach = float(np.abs(corners).max())
            _everywhere(canvas, centre, reach, lambda img, c, k=corners, g=grey: _fill(img, c + k, g))
    return (canvas.astype(np.float32) - 128.0) / 128.0


def _papers(rng: Rng, size_px: int, px_per_m: float) -> Factor:
    """Printed sheets and labels that overlap."""
    canvas = np.full((size_px, size_px), 95, np.uint8)
    mm = px_per_m * 1e-3
    for _ in range(int(1.4 * (size_px / (55.0 * mm)) ** 2)):
        w, h = (rng.uniform(30.0, 80.0, 2) * mm).astype(int)
        sheet = (printed(rng, int(h), int(w), px_per_m) * 160.0 * rng.uniform(0.75, 1.1)).clip(0, 255).astype(np.uint8)
        turn = rng.uniform(0.0, 360.0)
        centre = rng.uniform(0, size_px, 2)
        reach = 0.5 * math.hypot(w, h)
        _everywhere(canvas, centre, reach, lambda img, c, s=sheet, a=turn: _paste(img, s, c, a))
    return (canvas.astype(np.float32) - 128.0) / 128.0


def _everywhere(canvas: Grey, centre: NDArray[np.float64], reach: float, draw: Callable[..., None]) -> None:
    """Draw at a centre and at its periodic images across the seams."""
    size = canvas.shape[0]
    ways = [[way for way in (-size, 0, size) if -reach - 2 < c + way < size + reach + 2] for c in centre.tolist()]
    for way in itertools.product(*ways):
        draw(canvas, centre + way)


def _disc(image: Grey, centre: NDArray[np.float64], radius: float, grey: int, thickness: int) -> None:
    cv2.circle(image, _fixed(centre), round(radius * 16), grey, thickness, cv2.LINE_AA, 4)


def _fill(image: Grey, corners: NDArray[np.float64], grey: int) -> None:
    cv2.fillPoly(image, [np.round(corners * 16).astype(np.int32)], grey, cv2.LINE_AA, 4)


def _rectangle(rng: Rng, size: float) -> NDArray[np.float64]:
    half = np.array([size, size * rng.uniform(0.3, 1.6)])
    turn = rng.uniform(0.0, math.pi)
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half @ np.array([[c, s], [-s, c]])


def _paste(image: Grey, sheet: Grey, centre: NDArray[np.float64], turn_deg: float) -> None:
    height, width = sheet.shape
    reach = math.ceil(0.5 * math.hypot(width, height)) + 1
    left, top = (max(int(c) - reach, 0) for c in centre.tolist())
    right, bottom = (min(int(c) + reach + 1, size) for c, size in zip(centre.tolist(), image.shape[::-1], strict=True))
    if left >= right or top >= bottom:
        return
    matrix = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), turn_deg, 1.0)
    matrix[:, 2] += centre - np.array([0.5 * width + left, 0.5 * height + top])
    size = (right - left, bottom - top)
    mask = cv2.warpAffine(np.full_like(sheet, 255), matrix, size, flags=cv2.INTER_LINEAR)
    warped = cv2.warpAffine(sheet, matrix, size, flags=cv2.INTER_LINEAR)
    np.copyto(image[top:bottom, left:right], warped, where=mask > 127)


def _cable(rng: Rng, image: Grey, px_per_m: float) -> None:
    """A cable or bar: a bright and a dark line on a smooth path that is closed across the seam along one axis."""
    size = image.shape[0]
    width = rng.uniform(2.0, 7.0) * 1e-3 * px_per_m
    along = np.linspace(0.0, size, 65)
    wave = rng.uniform(0.0, 0.05) * size * np.sin(2.0 * np.pi * (int(rng.integers(1, 4)) * along / size + rng.random()))
    path = np.stack([along, rng.uniform(0.1, 0.9) * size + wave], axis=1)
    if rng.random() < 0.5:
        path = path[:, ::-1]
    level = float(rng.uniform(20.0, 200.0))
    layers = ((1.0, 0.35 * level, 0.0), (0.82, level, 0.0), (0.35, min(1.5 * level + 20.0, 255.0), -0.18))
    for share, grey, shift in layers:
        points = np.round((path + shift * width) * 16).astype(np.int32)
        cv2.polylines(image, [points], False, round(grey), max(round(share * width), 1), cv2.LINE_AA, 4)


def _print_block(rng: Rng, grey: Grey, x: int, y: int, mm: float) -> None:
    """One piece of print at (x, y): text-like rows, a bar code, or a frame."""
    ink = int(rng.integers(10, 90))
    kind = int(rng.integers(0, 4))
    if kind == 0:
        for k in range(12):
            width = max(int(rng.uniform(0.3, 1.2) * mm), 1)
            left = x + int(k * 1.4 * mm)
            cv2.rectangle(grey, (left, y), (left + width, y + int(9 * mm)), ink, -1)
    elif kind == 1:
        end = x + int(rng.uniform(6, 22) * mm), y + int(rng.uniform(4, 14) * mm)
        cv2.rectangle(grey, (x, y), end, ink, max(int(0.6 * mm), 1))
    else:
        text = "".join(rng.choice(list("ABEHKLMNRSTUXZ0123456789"), int(rng.integers(3, 9))).tolist())
        size, width = float(rng.uniform(0.12, 0.3)) * mm, max(int(0.7 * mm), 1)
        cv2.putText(grey, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, ink, width, cv2.LINE_AA)


def _fixed(point: NDArray[np.float64]) -> tuple[int, int]:
    """A point in 1/16 px, for drawing functions with ``shift=4``."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


_LENS_BLUR_PX = 0.6
_ALONG = np.array([0.0, 0.0, 1.0])
_FLAT_M = 1e-6
_LONG_FACE = 0.5  # a face is long if its normal's component along the finger is smaller


def grid_m(rows: int, columns: int, px_per_m: float, body_T_plane: Array) -> Array:
    """Points (rows, columns, 3) of a texture's texels in the body's frame."""
    x, y = np.arange(columns) / px_per_m, np.arange(rows)[:, None] / px_per_m
    out = np.empty((3, rows, columns))
    for axis, (by_x, by_y, _, start) in zip(out, body_T_plane[:3].tolist(), strict=True):
        np.add(by_x * x, by_y * y, out=axis)
        axis += start
    return np.moveaxis(out, 0, -1)


def marks(wanted: list[FingerMark], solid: Solid, face: int, grid: Array, px_per_m: float) -> Factor:
    """Factor of marks on one face of a finger whose tip is where z is largest; 1 on faces that aren't long."""
    out = np.ones(grid.shape[:2])
    normal = solid.normals[face]
    if abs(normal @ _ALONG) > _LONG_FACE:
        return out.astype(np.float32)
    across = np.cross(normal, _ALONG)
    across /= np.linalg.norm(across)
    corners = solid.vertices_m[solid.loops[face]] @ across
    middle, half = 0.5 * (corners.min() + corners.max()), 0.5 * float(np.ptp(corners))
    back_m = solid.vertices_m[:, 2].max() - grid[..., 2]
    side_m = grid @ across - middle
    for mark in wanted:
        (near_m, far_m), (left, right) = mark.from_tip_m, mark.across
        if mark.shape == "disc":
            centre_m = 0.5 * (near_m + far_m), 0.5 * (left + right) * half
            inside = 0.5 * (far_m - near_m) - np.hypot(back_m - centre_m[0], side_m - centre_m[1])
        else:
            inside = np.minimum(
                np.minimum(back_m - near_m, far_m - back_m), np.minimum(side_m - left * half, right * half - side_m)
            )
        out *= 1.0 + (mark.gain - 1.0) * _filled(inside, px_per_m)
    return _blurred(out)


def lines(rng: Rng, look: ObjectLook, solid: Solid, grid: Array, px_per_m: float) -> Factor:
    """Factor of a line pattern on one face of an object; equal on all faces for the same random state."""
    if look.pattern == "plain":
        return np.ones(grid.shape[:2], np.float32)
    # On a face without extent along the fingers, a line parallel to the tips has a position along y.
    beyond = 2 if np.ptp(grid[..., 2]) > _FLAT_M else 1
    if look.pattern == "fold":
        inside = solid.vertices_m[:, beyond].max() - look.pitch_m - grid[..., beyond]
        return _blurred(1.0 - look.contrast * _filled(inside, px_per_m))
    # Lines along the fingers have positions across them: on each face the axis that varies.
    axis = beyond if look.pattern == "lines_along_tips" else int(np.ptp(grid[..., :2], axis=(0, 1)).argmax())
    place_m = grid[..., axis]
    start_m, end_m = float(place_m.min()), float(place_m.max())
    if (place_m == place_m[:1]).all():  # of a box all rows are alike, or all columns
        place_m = place_m[:1]
    elif (place_m == place_m[:, :1]).all():
        place_m = place_m[:, :1]
    out = np.ones(place_m.shape)
    while start_m < end_m:
        width_m = look.pitch_m * float(rng.uniform(0.2, 0.8))
        inside = np.minimum(place_m - start_m, start_m + width_m - place_m)
        out -= look.contrast * float(rng.uniform(0.4, 1.0)) * _filled(inside, px_per_m)
        start_m += width_m + look.pitch_m * float(rng.uniform(0.2, 0.8))
    return _blurred(np.broadcast_to(out, grid.shape[:2]))


def _filled(inside_m: Array, px_per_m: float) -> NDArray[np.float64]:
    """Share of each texel that an area fills, from the distance to its border, positive inside."""
    return np.clip(inside_m * px_per_m + 0.5, 0.0, 1.0)


def _blurred(factor: Array) -> Factor:
    return np.asarray(cv2.GaussianBlur(factor.astype(np.float32), (0, 0), _LENS_BLUR_PX), dtype=np.float32)
