"""A calibration target found in an image, all of it or a part: fingers may stand on it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibration.lattice import as_arrays, find_lattice
from gripmon.calibration.sighting import NotFound, Sighting
from gripmon.calibration.targets import Charuco, Chequerboard, CircleGrid, Target
from gripmon.records import Array, Image

CORNER_SIGMA_PX = 0.1
"""Assumed of a refined chequerboard corner; the residuals then say what it really is."""
FEWEST = 9
"""Points without which a sight of the target is worth nothing."""
SMALLEST_DISC_PX = 4.0
"""Diameter."""
ROUND = 0.9
"""Area of a blob over that of the ellipse with its moments, at least (and at most its inverse)."""
SLIMMEST = 0.25
_SCALES = (1, 2, 3)
_RING = 32
_Grey = NDArray[np.float32]


def detect(image: Image, target: Target, name: str = "") -> Sighting | NotFound:
    """Points of the target in an image (any that a camera delivers), or why there are none.

    On a chequerboard or a lattice of discs any point may be the origin: nothing marks one.
    """
    grey = _to_grey(image)
    if isinstance(target, Charuco):
        return _charuco(grey, target, name)
    return _discs(grey, target, name) if isinstance(target, CircleGrid) else _chequerboard(grey, target, name)


def _charuco(grey: _Grey, target: Charuco, name: str) -> Sighting | NotFound:
    if not hasattr(cv2.aruco, target.dictionary):
        return NotFound(f"there is no dictionary {target.dictionary}; one of OpenCV's, e.g. DICT_4X4_250")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square_m, target.marker_m, dictionary)
    detector = cv2.aruco.CharucoDetector(board)
    shown = grey.astype(np.uint8)
    corners, ids, _, marks = detector.detectBoard(shown)
    if ids is None or len(ids) < FEWEST:
        mirrored = detector.detectBoard(np.ascontiguousarray(shown[:, ::-1]))[1]
        if mirrored is not None and len(mirrored) >= FEWEST:
            return NotFound("the board is mirrored; an image that isn't flipped")
        seen = 0 if marks is None else len(marks)
        return NotFound(f"{seen} marks of the board and {0 if ids is None else len(ids)} corners; at least {FEWEST}")
    found = corners.reshape(-1, 2).astype(np.float64)
    index = ids.ravel().astype(np.intp)
    plate = np.asarray(board.getChessboardCorners(), np.float64)[index]
    uv_px, sharp = _refined(shown, found, _smallest_step(found))
    return _sighting(grey, uv_px[sharp], plate[sharp], index[sharp], 0.0, name, total=len(board.getChessboardCorners()))


def _chequerboard(grey: _Grey, target: Chequerboard, name: str) -> Sighting | NotFound:
    shown = grey.astype(np.uint8)
    best: tuple[NDArray[np.intp], Array] | None = None
    for scale in _SCALES:
        candidates = _saddles(grey, scale)
        candidates = candidates[_crossing(grey, candidates, 2.0 * scale + 2.0)]
        cells, indices = as_arrays(find_lattice(candidates))
        if len(cells):
            # Once more with rings as wide as the squares allow: corners of the board's rim are none of its own.
            wide = _crossing(grey, candidates[indices], 0.35 * _smallest_step(candidates[indices]))
            candidates = candidates[indices[wide]]
            cells, indices = as_arrays(find_lattice(candidates))
        if len(cells) and not _alternates(grey, cells, candidates[indices]):
            continue
        if len(cells) > (0 if best is None else len(best[0])):
            best = cells, candidates[indices]
    if best is None:
        return NotFound("no chequerboard in the image; one that is sharp, evenly lit and not too small")
    cells, rough = best
    fault = _wrong_count(cells, target.columns, target.rows, "inner corners")
    if fault is not None:
        return fault
    uv_px, sharp = _refined(shown, rough, _smallest_step(rough))
    cells, uv_px = cells[sharp], uv_px[sharp]
    plate = np.concatenate([cells * target.square_m, np.zeros((len(cells), 1))], axis=1)
    ids = cells[:, 1] * (cells[:, 0].max(initial=0) + 1) + cells[:, 0]
    return _sighting(grey, uv_px, plate, ids, 0.0, name, total=target.columns * target.rows)


def _discs(grey: _Grey, target: CircleGrid, name: str) -> Sighting | NotFound:
    best: tuple[NDArray[np.intp], Array, Array] | None = None
    for dark in (True, False):
        for part in (32, 12, 5):
            blobs = _blobs(grey, grey.shape[1] // part | 1, dark)
            lattice = find_lattice(blobs[:, :2])
            cells, indices = as_arrays(lattice)
            if len(cells) > (0 if best is None else len(best[0])):
                best = cells, blobs[indices, :2], blobs[indices, 2:].reshape(-1, 2, 2)
    if best is None:
        return NotFound("no lattice of discs in the image; one that is sharp, evenly lit and not too small")
    cells, uv_px, covariance = best
    fault = _wrong_count(cells, target.columns, target.rows, "discs")
    if fault is not None:
        return fault
    plate = np.concatenate([cells * target.spacing_m, np.zeros((len(cells), 1))], axis=1)
    ids = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    total, radius_m = target.columns * target.rows, 0.5 * target.diameter_m
    return _sighting(grey, uv_px, plate, ids, radius_m, name, total=total, covariance=covariance)


def _sighting(
    grey: _Grey,
    uv_px: Array,
    plate_m: Array,
    ids: NDArray[np.intp],
    radius_m: float,
    name: str,
    *,
    total: int,
    covariance: Array | None = None,
) -> Sighting | NotFound:
    if len(uv_px) < FEWEST:
        return NotFound(f"{len(uv_px)} points of the target are sharp; at least {FEWEST}")
    if covariance is None:
        covariance = np.tile(CORNER_SIGMA_PX**2 * np.eye(2), (len(uv_px), 1, 1))
    note = "" if len(uv_px) == total else f"{len(uv_px)} of {total} points"
    size = (grey.shape[1], grey.shape[0])
    return Sighting(uv_px, plate_m, covariance, ids, size, radius_m, name, note)


def _wrong_count(cells: NDArray[np.intp], columns: int, rows: int, what: str) -> NotFound | None:
    seen = cells.max(axis=0) + 1
    if max(seen) > max(columns, rows) or min(seen) > min(columns, rows):
        return NotFound(f"the target shows {seen[0]} x {seen[1]} {what}, it should have {columns} x {rows}")
    return None


def _saddles(grey: _Grey, sigma_px: float) -> Array:
    """Candidates (n, 2) for the corners of squares: where the image bends up one way and down the other the most."""
    smooth = cv2.GaussianBlur(grey, (0, 0), float(sigma_px))
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3)
    strength = xy * xy - xx * yy  # all three kernels have a gain of 4
    radius = round(2.5 * sigma_px) + 1
    peak = cv2.dilate(strength, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    floor = 0.08 * float(np.partition(strength.ravel(), -64)[-64])
    rows, columns = np.nonzero((strength >= peak) & (strength > max(floor, 1e-3)))
    if len(rows) > 4000:
        strongest = np.argsort(strength[rows, columns])[-4000:]
        rows, columns = rows[strongest], columns[strongest]
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _crossing(grey: _Grey, points: Array, radius_px: float) -> NDArray[np.bool_]:
    """(n,) where a ring about a point is dark, light, dark, light: two edges cross there, rather than meet."""
    if not len(points):
        return np.zeros(0, bool)
    angles = 2.0 * np.pi / _RING * np.arange(_RING)
    ring = points[:, None] + radius_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    at = ring.astype(np.float32)
    levels = cv2.remap(grey, at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    power = np.square(np.abs(np.fft.rfft(levels, axis=1)))[:, 1:]
    # Two crossing edges have even harmonics alone: what is opposite is alike.
    even, odd = power[:, 1::2].sum(axis=1), power[:, 0::2].sum(axis=1)
    out: NDArray[np.bool_] = (odd < 0.2 * even) & (power[:, 1] > 0.5 * even)
    return out


def _alternates(grey: _Grey, cells: NDArray[np.intp], points: Array) -> bool:
    """Whether the squares between the corners are dark and light by turns."""
    where = {(int(c), int(r)): k for k, (c, r) in enumerate(cells)}
    signs, levels = [], []
    for (column, row), index in where.items():
        others = [where.get((column + dx, row + dy)) for dx, dy in ((1, 0), (0, 1), (1, 1))]
        if None in others:
            continue
        u, v = np.mean([points[index], *(points[k] for k in others if k is not None)], axis=0)
        signs.append(1.0 if (column + row) % 2 else -1.0)
        levels.append(float(grey[round(float(v)), round(float(u))]))
    if len(levels) < 4:
        return False
    light = np.array(levels) - np.median(levels)
    agreeing = float(np.mean(np.sign(light * np.array(signs)) == np.sign(light @ np.array(signs))))
    return agreeing > 0.85


def _smallest_step(points: Array) -> float:
    from scipy.spatial import cKDTree

    return float(np.percentile(cKDTree(points).query(points, 2)[0][:, 1], 10))


def _refined(shown: NDArray[np.uint8], rough: Array, step_px: float) -> tuple[Array, NDArray[np.bool_]]:
    """Sub-pixel positions, and which of them the image confirms."""
    half = int(np.clip(0.35 * step_px, 2, 15))
    start = rough.astype(np.float32).reshape(-1, 1, 2).copy()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-3)
    found = cv2.cornerSubPix(shown, start, (half, half), (-1, -1), criteria).reshape(-1, 2).astype(np.float64)
    moved = np.linalg.norm(found - rough, axis=1)
    size = np.array(shown.shape[::-1])
    inside = ((found > half + 1) & (found < size - half - 2)).all(axis=1)
    return found, inside & (moved < max(0.2 * step_px, 1.5))


def _blobs(grey: _Grey, block_px: int, dark: bool) -> Array:
    """Ellipses: centre (2) and its covariance (4, row by row) each, (n, 6)."""
    shown = grey.astype(np.uint8)
    block_px = max(block_px, 11) | 1
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    mask = cv2.adaptiveThreshold(shown, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, block_px, 8 if dark else -8)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=4)
    noise = _noise(grey)
    out = []
    height, width = grey.shape
    for k in range(1, count):
        x, y, w, h, area = stats[k].tolist()
        if (
            min(w, h) < SMALLEST_DISC_PX
            or max(w, h) > block_px
            or x == 0
            or y == 0
            or x + w == width
            or y + h == height
        ):
            continue
        rows, columns = np.nonzero(labels[y : y + h, x : x + w] == k)
        spread = np.cov(np.stack([columns, rows]).astype(np.float64), bias=True) + np.eye(2) / 12.0
        roundness = area / (4.0 * np.pi * float(np.sqrt(np.linalg.det(spread))))
        slim = np.linalg.eigvalsh(spread)
        if not ROUND < roundness < 1.0 / ROUND or slim[0] < SLIMMEST**2 * slim[1]:
            continue
        refined = _weighed_centre(grey, centres[k], spread, noise, dark)
        if refined is not None:
            out.append(refined)
    return np.array(out).reshape(-1, 6)


def _weighed_centre(grey: _Grey, centre: Array, spread: Array, noise: float, dark: bool) -> list[float] | None:
    """Centre of a disc's missing (or extra) light, with its covariance: no threshold biases it, and every pixel of the
    rim counts by how much of it is covered.
    """
    half = np.ceil(2.0 * np.sqrt(spread.diagonal()) * 1.35 + 2.0).astype(int)
    low, high = np.rint(centre).astype(int) - half, np.rint(centre).astype(int) + half + 1
    if (low < 0).any() or (high > np.array(grey.shape[::-1])).any():
        return None
    patch = grey[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    offset = np.stack([u - centre[0], v - centre[1]], axis=-1)
    # In units of the ellipse's radius: inside is below 1.
    radius = np.sqrt(np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(4.0 * spread), offset))
    pixels = 1.0 / float(np.sqrt(4.0 * np.linalg.eigvalsh(spread)[0]))  # one pixel in these units, at most
    rim, ring = radius < 1.0 + 2.0 * pixels, (radius > 1.0 + 2.0 * pixels) & (radius < 1.35 + 2.0 * pixels)
    core = radius < max(1.0 - 2.0 * pixels, 0.4)
    if ring.sum() < 8 or not core.any():
        return None
    # The light around it may slope.
    design = np.column_stack([np.ones(int(ring.sum())), offset[ring]])
    plane, *_ = np.linalg.lstsq(design, patch[ring], rcond=None)
    around = plane[0] + offset @ plane[1:]
    depth = (around - patch) if dark else (patch - around)
    contrast = float(np.median(depth[core]))
    if contrast < 6.0 * noise or contrast < 5.0:
        return None
    weight = np.where(rim, depth, 0.0)
    total = float(weight.sum())
    shift = np.einsum("hw,hwi->i", weight, offset) / total
    if np.hypot(*shift) > 1.0:
        return None
    lever = offset[rim] - shift
    variance = noise**2 * (lever.T @ lever) / total**2 + np.eye(2) * 4e-4  # and 0.02 px that no noise explains
    return [*(centre + shift).tolist(), *variance.ravel().tolist()]


def _noise(grey: _Grey) -> float:
    """Standard deviation of the image's noise, robust against what it shows (Immerkaer, 1996, with a median)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return max(float(np.median(np.abs(cv2.filter2D(grey, cv2.CV_32F, kernel)))) / (6.0 * 0.6745), 0.3)


def _to_grey(image: Image) -> _Grey:
    """Grey values 0 to 255 of any image that a camera delivers: 8 bit, 16 bit by its full range, float from 0 to 1."""
    scale = {"uint8": 1.0, "uint16": 255.0 / 65535.0}.get(str(image.dtype), 255.0)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(grey, np.float32) * np.float32(scale)
