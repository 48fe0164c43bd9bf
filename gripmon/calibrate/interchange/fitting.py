"""A lens by another one, where a format has no such lens: the nearest Brown-Conrady, and how far off it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from gripmon.model.camera import BrownConradyLens, Camera, LensSettings, make_camera
from gripmon.model.lenses import BrownMap
from gripmon.model.records import Array

GOOD_ENOUGH_PX = 0.001
"""A fit with fewer coefficients does if it is as near as this."""
_STEPS = 20
"""Of a refinement that begins near its end."""
_FITTED, _CHECKED = 41, 101
"""Points along the image's longer and shorter side: where the lens is fitted, and where it is compared."""


@dataclass(frozen=True, slots=True)
class FittedLens:
    """``camera`` projects what the other one does, up to ``largest_px`` anywhere in the image."""

    camera: BrownConradyLens
    largest_px: float


def fit_brown_conrady(camera: LensSettings, counts: tuple[int, ...]) -> FittedLens:
    """The Brown-Conrady camera with the fewest of ``counts`` coefficients that is near enough, or else the nearest;
    focal lengths and principal point are kept.  ValueError if the image shows what no such lens maps.
    """
    original = make_camera(camera)
    best: FittedLens | None = None
    fault = ""
    for count in sorted(counts):
        try:
            fitted = _fit(original, count)
        except ValueError as error:
            fault = str(error)
            continue
        if best is None or fitted.largest_px < best.largest_px:
            best = fitted
        if best.largest_px <= GOOD_ENOUGH_PX:
            break
    if best is None:
        raise ValueError(fault)
    return best


def _fit(original: Camera, count: int) -> FittedLens:
    xy, uv_px = _seen(original, _FITTED)
    settings = original.settings
    q = (uv_px - [settings.cx_px, settings.cy_px]) / [settings.fx_px, settings.fy_px]
    start = _linear(xy, q, count)
    coefficients = start
    if count == 8:

        def errors(values: Array) -> Array:
            found = BrownMap(_ordered(values)).distort(np.ascontiguousarray(xy.T)).T
            return np.asarray(np.where(np.isfinite(found), found - q, 1.0)).ravel() * settings.fx_px

        coefficients = least_squares(errors, start, x_scale="jac", max_nfev=_STEPS).x
    lens = BrownConradyLens(
        **{key: getattr(settings, key) for key in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")},
        coefficients=_ordered(coefficients),
    )
    fitted = make_camera(lens)
    xy, uv_px = _seen(original, _CHECKED)
    apart_px = np.linalg.norm(fitted.distort(xy) - uv_px, axis=1)
    if not np.isfinite(apart_px).all():
        raise ValueError("the fitted lens doesn't map all of the image")
    return FittedLens(lens, float(apart_px.max()))


def _seen(camera: Camera, points: int) -> tuple[Array, Array]:
    """Ideal coordinates (n, 2) and pixels (n, 2) of a grid over the whole image."""
    u, v = np.linspace(0, camera.width_px - 1, points), np.linspace(0, camera.height_px - 1, points)
    uv_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = camera.undistort(uv_px)
    if not np.isfinite(xy).all():
        raise ValueError("the image's corners see too far to the side for a lens without fisheye")
    return xy, uv_px


def _linear(xy: Array, q: Array, count: int) -> Array:
    """Radial and tangential terms by least squares: k1 k2 p1 p2 [k3 [k4 k5 k6]], the rational ones after
    multiplication with the denominator.
    """
    x, y = xy.T
    r2 = x * x + y * y
    columns = [
        xy * r2[:, None],
        xy * (r2 * r2)[:, None],
        np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1),
        np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1),
        xy * (r2**3)[:, None],
        *(-q * (r2**power)[:, None] for power in (1, 2, 3)),
    ]
    matrix = np.stack([column.ravel() for column in columns[:count]], axis=1)
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    found: Array = np.linalg.lstsq(matrix / scale, (q - xy).ravel(), rcond=1e-12)[0] / scale
    return found


def _ordered(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
