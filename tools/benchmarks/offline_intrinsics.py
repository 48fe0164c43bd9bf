"""Cameras calibrated from the same images by others and by us, for ``tools/bench offline``.

Everybody fits the model with two radial and two tangential coefficients; OpenCV with its own corners
(``cv2.findChessboardCorners`` and ``cv2.cornerSubPix``, and those of ``cv2.findChessboardCornersSB``) and with ours,
COLMAP's bundle adjustment (``pycolmap``, installed with the extra ``bench``) with ours, as it doesn't look for plates.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.offline_images import View, corners_of, views
from gripmon.calibrate.detection import detect
from gripmon.calibrate.intrinsics import calibrate
from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import BrownConradyLens, LensSettings, make_camera
from gripmon.model.geometry import exp_rotation
from gripmon.model.images import image_paths
from gripmon.model.records import Array
from gripmon.model.targets import Chequerboard

LENS = BrownConradyLens(
    width_px=768,
    height_px=576,
    fx_px=905.0,
    fy_px=902.0,
    cx_px=379.0,
    cy_px=291.0,
    coefficients=(-0.21, 0.09, 0.0008, -0.0005),
)
BOARD = Chequerboard(9, 6, 0.025)
OURS, OPENCV, OPENCV_SB = "gripmon", "OpenCV", "OpenCV SB"
OPENCV_OURS, COLMAP = "OpenCV, our corners", "COLMAP, our corners"
FEWEST_PHOTOGRAPHS = 4
"""In which everybody found the plate, from which a lens is fitted."""
_GRID = 12
_WINDOW_PX = (5, 5)
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)

Points = list[tuple[Array, Array]]
"""A view each: (n, 3) on the plate, (n, 2) in the image."""


@dataclass
class Fits:
    """What someone found in all sets of images: ``error`` (n, 4) of fx, fy, cx, cy (px); ``mapping_px`` (n,) root mean
    square over the image between where the true camera and the found one show a point, the best turn of the camera
    allowed; ``nees`` of the reported covariance over the reported parameters, each (n,) over their number.
    """

    who: str
    error: list[Array] = field(default_factory=list)
    mapping_px: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    failed: int = 0


@dataclass
class Found:
    """Corners that were looked for: images in which the plate was found, and for each the mean square ``error_px2`` of
    what was, each axis.
    """

    who: str
    images: int = 0
    found: int = 0
    seconds: float = 0.0
    error_px2: list[float] = field(default_factory=list)


@dataclass
class Photographs:
    """A lens fitted to the corners that one found in photographs of which all found some, of ``found`` images; and the
    root mean square of what is left, each axis.
    """

    who: str
    images: int
    found: int
    common: int
    residual_px: float


def compare(
    sets: int, images: int, seed: int, progress: Callable[[], object] = lambda: None
) -> tuple[list[Fits], list[Found]]:
    """Everybody on ``sets`` sets of images, and who finds the plate where something covers a part of it."""
    fits = {who: Fits(who) for who in (OURS, *_THEIRS, OPENCV_OURS, *([COLMAP] if colmap_installed() else []))}
    found = {(who, covered): Found(f"{who}{covered}") for covered in ("", ", part covered") for who in (OURS, *_THEIRS)}
    for number in range(sets):
        rng = np.random.default_rng([seed, number])
        whole = views(LENS, BOARD, images, rng)
        for covered, shown in (("", whole), (", part covered", [_covered(view, rng) for view in whole])):
            sightings = [_searched(lambda i: _ours(i, BOARD), view, found[OURS, covered]) for view in shown]
            theirs = {
                who: [_searched(lambda i, f=find: f(i, BOARD), view, found[who, covered]) for view in shown]
                for who, find in _THEIRS.items()
            }
            if not covered:
                _fit_all(fits, [s for s in sightings if s], {who: _points(of, BOARD) for who, of in theirs.items()})
        progress()
    return list(fits.values()), list(found.values())


def on_photographs(folder: Path, board: Chequerboard) -> list[Photographs]:
    """Everybody's corners in the photographs of a folder; nobody knows the truth there, but one lens has to explain
    them.
    """
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in image_paths([folder])]
    ours = [_ours(image, board) for image in images]
    points: dict[str, list[tuple[Array, Array] | None]] = {
        OURS: [(s.plate_m, s.uv_px) if s else None for s in ours],
        **{who: [_of(find(image, board), board) for image in images] for who, find in _THEIRS.items()},
    }
    common = [k for k in range(len(images)) if all(of[k] for of in points.values())]
    out = []
    for who, of in points.items():
        shared = [found for k in common if (found := of[k])]
        left = _fitted(shared, images[0].shape[::-1])[0] if len(shared) >= FEWEST_PHOTOGRAPHS else float("nan")
        found_in = sum(found is not None for found in of)
        out.append(Photographs(who, len(images), found_in, len(common), left / np.sqrt(2.0)))
    return out


def _fitted(points: Points, size: tuple[int, int]) -> tuple[float, Array, Array]:
    """By OpenCV, of images (width, height): what is left (root mean square, px), the camera's matrix, the lens."""
    plates = [plate.astype(np.float32).reshape(-1, 1, 3) for plate, _ in points]
    uv = [px.astype(np.float32).reshape(-1, 1, 2) for _, px in points]
    rms, matrix, lens, *_ = cv2.calibrateCamera(plates, uv, size, None, None, flags=cv2.CALIB_FIX_K3)
    return float(rms), matrix, lens


def _searched(find: Callable[[NDArray[np.uint8]], Any], view: View, count: Found) -> Any:
    """What one finds in a view, or None; counted."""
    start = time.perf_counter()
    out = find(view.image)
    count.seconds += time.perf_counter() - start
    count.images += 1
    if out is not None:
        uv = out.uv_px if isinstance(out, Sighting) else out
        away = np.linalg.norm(uv[:, None] - view.corners_px, axis=2)  # squares are many pixels wide
        count.found += 1
        count.error_px2.append(0.5 * float(np.mean(away.min(axis=1) ** 2)))
    return out


def _ours(image: NDArray[np.uint8], board: Chequerboard) -> Sighting | None:
    sight = detect(image, board, "")
    return sight if isinstance(sight, Sighting) else None


def _classic(image: NDArray[np.uint8], board: Chequerboard) -> Array | None:
    seen, uv = cv2.findChessboardCorners(image, (board.columns, board.rows))
    if not seen:
        return None
    return np.asarray(cv2.cornerSubPix(image, uv, _WINDOW_PX, (-1, -1), _STOP), np.float64).reshape(-1, 2)


def _sector_based(image: NDArray[np.uint8], board: Chequerboard) -> Array | None:
    """Without the flag for accuracy, with which it is less accurate."""
    seen, uv = cv2.findChessboardCornersSB(image, (board.columns, board.rows))
    return np.asarray(uv, np.float64).reshape(-1, 2) if seen else None


_THEIRS: dict[str, Callable[[NDArray[np.uint8], Chequerboard], Array | None]] = {
    OPENCV: _classic,
    OPENCV_SB: _sector_based,
}


def _of(uv: Array | None, board: Chequerboard) -> tuple[Array, Array] | None:
    return None if uv is None else (corners_of(board), uv)


def _points(found: Sequence[Array | None], board: Chequerboard) -> Points:
    return [of for uv in found if (of := _of(uv, board))]


def _covered(view: View, rng: np.random.Generator) -> View:
    """A finger from the left or the right border to beyond the middle."""
    height, width = view.image.shape
    top, thick = rng.uniform(0.25, 0.6) * height, 0.18 * height
    box = np.array([[-5, top], [0.6 * width, top + 12], [0.6 * width, top + thick], [-5, top + thick + 12]])
    if rng.random() < 0.5:
        box[:, 0] = width - 1 - box[:, 0]
    out = view.image.copy()
    cv2.fillPoly(out, [np.rint(box).astype(np.int32)], 95)
    return View(out, view.corners_px)


def _fit_all(fits: dict[str, Fits], sightings: list[Sighting], theirs: dict[str, Points]) -> None:
    ours: Points = [(s.plate_m, s.uv_px) for s in sightings]
    ways: dict[str, Callable[[], tuple[Array, float | None]]] = {
        OURS: lambda: _gripmon(sightings),
        OPENCV: lambda: (_calibrate_camera(theirs[OPENCV]), None),
        OPENCV_SB: lambda: (_calibrate_camera(theirs[OPENCV_SB]), None),
        OPENCV_OURS: lambda: (_calibrate_camera(ours), None),
        COLMAP: lambda: (_colmap(ours), None),
    }
    for who, fit in fits.items():
        start = time.perf_counter()
        try:
            values, nees = ways[who]()
        except (ValueError, RuntimeError, cv2.error):
            fit.failed += 1
            continue
        fit.seconds.append(time.perf_counter() - start)
        fit.error.append(values[:4] - _true()[:4])
        fit.mapping_px.append(mapping_px(_lens(values)))
        if nees is not None:
            fit.nees.append(nees)


def _true() -> Array:
    return np.array([LENS.fx_px, LENS.fy_px, LENS.cx_px, LENS.cy_px, *LENS.coefficients])


def _lens(values: Array) -> BrownConradyLens:
    fx, fy, cx, cy, *coefficients = values.tolist()
    return BrownConradyLens(
        width_px=LENS.width_px, height_px=LENS.height_px, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy,
        coefficients=tuple(coefficients),
    )  # fmt: skip


def _gripmon(sightings: list[Sighting]) -> tuple[Array, float]:
    result = calibrate(sightings, "brown_conrady")
    names = list(result.values)
    values = np.array(list(result.values.values()))
    free = [names.index(name) for name in result.parameters]
    off = (values - _true())[free]
    return values, float(off @ np.linalg.solve(result.covariance, off)) / len(free)


def _calibrate_camera(points: Points) -> Array:
    _, matrix, lens = _fitted(points, (LENS.width_px, LENS.height_px))
    coefficients = np.ravel(lens)[:4]
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients])


def colmap_installed() -> bool:
    try:
        import pycolmap  # noqa: F401
    except ImportError:
        return False
    return True


def _colmap(points: Points) -> Array:
    """Poses and camera by COLMAP's bundle adjustment, the plate's points fixed; from a start that knows nothing of the
    camera but the image's size.
    """
    import pycolmap

    half, focal = 0.5, 1.2 * LENS.width_px  # its first pixel's centre is at (0.5, 0.5)
    middle = [0.5 * LENS.width_px, 0.5 * LENS.height_px]
    camera = pycolmap.Camera(
        model="OPENCV", width=LENS.width_px, height=LENS.height_px, camera_id=1,
        params=[focal, focal, *middle, 0.0, 0.0, 0.0, 0.0],
    )  # fmt: skip
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    config = pycolmap.BundleAdjustmentConfig()
    matrix = np.array([[focal, 0.0, middle[0] - half], [0.0, focal, middle[1] - half], [0.0, 0.0, 1.0]])
    places: dict[tuple[float, float], int] = {}
    for number, (plate, uv) in enumerate(points, start=1):
        _, turn, shift = cv2.solvePnP(plate, uv, matrix, None)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(cv2.Rodrigues(turn)[0]), shift.ravel())
        image = pycolmap.Image(name=str(number), keypoints=uv + half, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
        config.add_image(number)
        for k, place in enumerate(plate):
            key = (round(float(place[0]), 9), round(float(place[1]), 9))
            if key not in places:
                places[key] = model.add_point3D(place, pycolmap.Track())
                config.add_constant_point(places[key])
            model.add_observation(places[key], pycolmap.TrackElement(number, k))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    params = np.array(model.cameras[1].params)
    params[2:4] -= half
    return params


def mapping_px(lens: LensSettings) -> float:
    """See :class:`Fits`."""
    true, found = make_camera(LENS), make_camera(lens)
    u, v = np.meshgrid(np.linspace(0, LENS.width_px - 1, _GRID), np.linspace(0, LENS.height_px - 1, _GRID))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = np.column_stack([true.undistort(uv), np.ones(len(uv))])

    def off(turn: Array) -> Array:
        return np.ravel(found.project(rays @ exp_rotation(turn).T) - uv)

    turn, step = np.zeros(3), 1e-6
    for _ in range(3):
        slopes = np.stack([(off(turn + step * e) - off(turn - step * e)) / (2.0 * step) for e in np.eye(3)], axis=1)
        turn = turn - np.linalg.lstsq(slopes, off(turn), rcond=None)[0]
    return float(np.sqrt(np.mean(off(turn) ** 2) * 2.0))
