"""Cameras calibrated from the same images by others and by us, for ``tools/bench offline``.

Everybody fits the model with two radial and two tangential coefficients; OpenCV with its own corners and with ours
(``cv2.findChessboardCorners`` and ``cv2.cornerSubPix``, which on these images are eight times as accurate as
``cv2.findChessboardCornersSB``), COLMAP's bundle adjustment (``pycolmap``, installed with the extra ``bench``) with
ours, as it doesn't look for plates.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.offline_images import views
from gripmon.calibrate.detection import detect
from gripmon.calibrate.intrinsics import calibrate
from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import BrownConradyLens, LensSettings, make_camera
from gripmon.model.geometry import exp_rotation
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
OURS, OPENCV, OPENCV_OURS, COLMAP = "gripmon", "OpenCV", "OpenCV, our corners", "COLMAP, our corners"
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
    """Corners that were looked for: images in which the plate was found, and errors of what was (px, each axis)."""

    who: str
    images: int = 0
    found: int = 0
    seconds: float = 0.0


def compare(
    sets: int, images: int, seed: int, progress: Callable[[], object] = lambda: None
) -> tuple[list[Fits], list[Found]]:
    """Everybody on ``sets`` sets of images, and who finds the plate where something covers a part of it."""
    fits = {who: Fits(who) for who in (OURS, OPENCV, OPENCV_OURS, *([COLMAP] if colmap_installed() else []))}
    found = {(who, covered): Found(f"{who}{covered}") for covered in ("", ", part covered") for who in (OURS, OPENCV)}
    for number in range(sets):
        rng = np.random.default_rng([seed, number])
        whole = views(LENS, BOARD, images, rng)
        for covered, shown in (("", whole), (", part covered", [_covered(i, rng) for i in whole])):
            sightings = _ours(shown, found[OURS, covered])
            theirs = _opencv(shown, found[OPENCV, covered])
            if not covered:
                _fit_all(fits, sightings, theirs)
        progress()
    return list(fits.values()), list(found.values())


def _ours(images: Sequence[NDArray[np.uint8]], count: Found) -> list[Sighting]:
    start = time.perf_counter()
    sights = [detect(image, BOARD, "") for image in images]
    out = [sight for sight in sights if isinstance(sight, Sighting)]
    count.images, count.found = count.images + len(images), count.found + len(out)
    count.seconds += time.perf_counter() - start
    return out


def _opencv(images: Sequence[NDArray[np.uint8]], count: Found) -> Points:
    start, out = time.perf_counter(), []
    size = (BOARD.columns, BOARD.rows)
    r, c = np.mgrid[: BOARD.rows, : BOARD.columns]
    plate = np.stack([c.ravel(), r.ravel(), np.zeros(c.size)], axis=1) * BOARD.square_m
    for image in images:
        seen, uv = cv2.findChessboardCorners(image, size)
        if seen:
            uv = cv2.cornerSubPix(image, uv, _WINDOW_PX, (-1, -1), _STOP)
            out.append((plate, np.asarray(uv, np.float64).reshape(-1, 2)))
    count.images, count.found = count.images + len(images), count.found + len(out)
    count.seconds += time.perf_counter() - start
    return out


def _covered(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A finger from the left or the right border to beyond the middle."""
    height, width = image.shape
    top, thick = rng.uniform(0.25, 0.6) * height, 0.18 * height
    box = np.array([[-5, top], [0.6 * width, top + 12], [0.6 * width, top + thick], [-5, top + thick + 12]])
    if rng.random() < 0.5:
        box[:, 0] = width - 1 - box[:, 0]
    out = image.copy()
    cv2.fillPoly(out, [np.rint(box).astype(np.int32)], 95)
    return out


def _fit_all(fits: dict[str, Fits], sightings: list[Sighting], theirs: Points) -> None:
    ours: Points = [(s.plate_m, s.uv_px) for s in sightings]
    ways: dict[str, Callable[[], tuple[Array, float | None]]] = {
        OURS: lambda: _gripmon(sightings),
        OPENCV: lambda: (_calibrate_camera(theirs), None),
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
    plate = [p.astype(np.float32).reshape(-1, 1, 3) for p, _ in points]
    uv = [q.astype(np.float32).reshape(-1, 1, 2) for _, q in points]
    size = (LENS.width_px, LENS.height_px)
    _, matrix, lens, *_ = cv2.calibrateCamera(plate, uv, size, None, None, flags=cv2.CALIB_FIX_K3)
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
