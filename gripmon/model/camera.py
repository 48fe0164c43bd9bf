"""Camera models: a pinhole with one of three lenses; every mapping is vectorised and has an analytic Jacobian.

Pixel centres lie at integer coordinates, as in OpenCV; the camera frame is x right, y down, z forward.  Three kinds of
image coordinates occur:

* ``uv_px``: pixels in the image as the camera delivers it (distorted);
* ``xy``: ideal normalised coordinates ``x/z, y/z`` of a point in the camera frame (no unit);
* ``q``, inside this module only: distorted normalised coordinates ``((u - cx)/fx, (v - cy)/fy)``.

Outside a lens's domain (behind the camera, or beyond the radius where the model folds back on itself) results are NaN.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from gripmon.model.lenses import BrownMap, FisheyeMap, LensMap, PaperMap
from gripmon.model.records import Array

_MIN_DEPTH_M = 1e-6
_MIN_FOCAL_PX = 10.0
_MAX_FOCAL_WIDTHS = 100.0  # a field of view of half a degree
_MAX_ASPECT = 4.0
_MAX_STRETCH = 3.0  # distorted over ideal radius, of the paper's lens also the reverse, at the image's farthest corner


class PinholeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The parameters that all camera models share."""

    width_px: Annotated[int, msgspec.Meta(ge=16, le=20000, description="image width (px)")]
    height_px: Annotated[int, msgspec.Meta(ge=16, le=20000, description="image height (px)")]
    fx_px: Annotated[float, msgspec.Meta(gt=0, description="focal length over the pixel's width (px)")]
    fy_px: Annotated[float, msgspec.Meta(gt=0, description="focal length over the pixel's height (px)")]
    cx_px: Annotated[float, msgspec.Meta(description="column of the principal point; first pixel's centre is 0 (px)")]
    cy_px: Annotated[float, msgspec.Meta(description="row of the principal point; first pixel's centre is 0 (px)")]


class PaperLens(PinholeSettings, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="paper"):
    """Equation (4) of the self-viewing method: ``ideal = distorted * (1 + kappa r²)``, r from the principal point.

    If pixels are not square, the row offset is scaled to column units: ``r² = du² + (dv fx/fy)²``.
    """

    kappa_per_px2: Annotated[
        float, msgspec.Meta(description="radial distortion, acting on the distorted coordinates (1/px²)")
    ] = 0.0


class BrownConradyLens(
    PinholeSettings, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="brown_conrady"
):
    """OpenCV's standard model: the polynomial acts on the *ideal* coordinates."""

    coefficients: Annotated[
        tuple[float, ...],
        msgspec.Meta(description="k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: 4, 5, 8 or 12 (no unit)"),
    ] = (0.0, 0.0, 0.0, 0.0)


class FisheyeLens(
    PinholeSettings, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="fisheye"
):
    """OpenCV's fisheye: the distorted radius is ``theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸)``."""

    coefficients: Annotated[tuple[float, ...], msgspec.Meta(description="k1 k2 k3 k4 (no unit)")] = (0.0, 0.0, 0.0, 0.0)


LensSettings = PaperLens | BrownConradyLens | FisheyeLens
_SAME = 1e-9


def same_lens(one: LensSettings, other: LensSettings) -> bool:
    """Whether both are one camera; another program's file may add coefficients of zero, or lose a last digit."""
    if type(one) is not type(other):
        return False
    a, b = (np.concatenate([np.ravel(v) for v in msgspec.structs.astuple(each)]) for each in (one, other))
    zeros = np.zeros(max(len(a), len(b)))
    return bool(np.allclose(np.append(a, zeros[len(a) :]), np.append(b, zeros[len(b) :]), rtol=_SAME, atol=0.0))


class Camera:
    """A pinhole camera with a lens.  Build it with :func:`make_camera`, which rejects implausible calibrations."""

    def __init__(self, settings: LensSettings, lens: LensMap) -> None:
        self.settings = settings
        self.width_px, self.height_px = settings.width_px, settings.height_px
        self.fx_px, self.fy_px = settings.fx_px, settings.fy_px
        self.cx_px, self.cy_px = settings.cx_px, settings.cy_px
        self._lens = lens
        self._focal_px = np.array([self.fx_px, self.fy_px])
        self._per_focal = 1.0 / self._focal_px[:, None]
        self._centre_px = np.array([self.cx_px, self.cy_px])

    def project(self, points_cam_m: Array) -> Array:
        """Project points in the camera frame (n, 3), m, to distorted pixels (n, 2); NaN outside the domain."""
        xy, _ = _normalise(points_cam_m)
        return self._to_pixels(self._lens.distort(xy))

    def project_with_jacobian(self, points_cam_m: Array) -> tuple[Array, Array]:
        """Like :meth:`project`, plus ``d_uv_d_point`` (n, 2, 3), px/m; both are NaN outside the domain."""
        xy, per_z = _normalise(points_cam_m)
        q, (j00, j01, j10, j11) = self._lens.distort_with_jacobian(xy)
        x, y = xy
        per_z_u, per_z_v = per_z * self.fx_px, per_z * self.fy_px
        d_uv_d_point = np.empty((len(points_cam_m), 2, 3))
        d_uv_d_point[:, 0, 0] = per_z_u * j00
        d_uv_d_point[:, 0, 1] = per_z_u * j01
        d_uv_d_point[:, 0, 2] = -per_z_u * (j00 * x + j01 * y)
        d_uv_d_point[:, 1, 0] = per_z_v * j10
        d_uv_d_point[:, 1, 1] = per_z_v * j11
        d_uv_d_point[:, 1, 2] = -per_z_v * (j10 * x + j11 * y)
        return self._to_pixels(q), d_uv_d_point

    def undistort(self, uv_px: Array) -> Array:
        """Distorted pixels (n, 2) -> ideal normalised coordinates x/z, y/z (n, 2); NaN outside the lens."""
        return np.ascontiguousarray(self._lens.undistort(self._from_pixels(uv_px)).T)

    def undistort_with_jacobian(self, uv_px: Array) -> tuple[Array, Array]:
        """Like :meth:`undistort`, plus ``d_xy_d_uv`` (n, 2, 2), 1/px."""
        xy, (j00, j01, j10, j11) = self._lens.undistort_with_jacobian(self._from_pixels(uv_px))
        d_xy_d_uv = np.empty((len(uv_px), 2, 2))
        d_xy_d_uv[:, 0, 0] = j00 / self.fx_px
        d_xy_d_uv[:, 0, 1] = j01 / self.fy_px
        d_xy_d_uv[:, 1, 0] = j10 / self.fx_px
        d_xy_d_uv[:, 1, 1] = j11 / self.fy_px
        return np.ascontiguousarray(xy.T), d_xy_d_uv

    def distort(self, xy: Array) -> Array:
        """Ideal normalised coordinates (n, 2) -> distorted pixels (n, 2); NaN outside the lens."""
        assert xy.ndim == 2 and xy.shape[1] == 2, f"expected (n, 2), got {xy.shape}"
        return self._to_pixels(self._lens.distort(np.ascontiguousarray(xy.T, dtype=np.float64)))

    def _to_pixels(self, q: Array) -> Array:
        uv_px: Array = np.multiply(q.T, self._focal_px, order="C")
        uv_px += self._centre_px
        return uv_px

    def _from_pixels(self, uv_px: Array) -> Array:
        assert uv_px.ndim == 2 and uv_px.shape[1] == 2, f"expected (n, 2), got {uv_px.shape}"
        q: Array = np.subtract(uv_px.T, self._centre_px[:, None], order="C", dtype=np.float64)
        q *= self._per_focal
        return q


def _normalise(points_cam_m: Array) -> tuple[Array, Array]:
    """(n, 3) -> x/z, y/z (2, n) and 1/z (n,); NaN where the point is not in front of the camera."""
    assert points_cam_m.ndim == 2 and points_cam_m.shape[1] == 3, f"expected (n, 3), got {points_cam_m.shape}"
    rows = np.ascontiguousarray(points_cam_m.T, dtype=np.float64)
    z = rows[2]
    per_z = 1.0 / np.where(z > _MIN_DEPTH_M, z, np.nan)
    return rows[:2] * per_z, per_z


def make_camera(settings: LensSettings) -> Camera:
    """Build the camera.  ValueError "key: what is wrong; what would be right" for an implausible calibration."""
    _check_pinhole(settings)
    lens: LensMap
    match settings:
        case PaperLens():
            _check_finite("kappa_per_px2", (settings.kappa_per_px2,))
            lens, key = PaperMap(settings.kappa_per_px2 * settings.fx_px**2), "kappa_per_px2"
        case BrownConradyLens():
            if len(settings.coefficients) not in (4, 5, 8, 12):
                raise ValueError(
                    f"coefficients: {len(settings.coefficients)} values; the brown_conrady model has 4, 5, 8 or 12: "
                    "k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]"
                )
            _check_finite("coefficients", settings.coefficients)
            lens, key = BrownMap(settings.coefficients), "coefficients"
        case FisheyeLens():
            if len(settings.coefficients) != 4:
                raise ValueError(
                    f"coefficients: {len(settings.coefficients)} values; the fisheye model has 4: k1 k2 k3 k4"
                )
            _check_finite("coefficients", settings.coefficients)
            lens, key = FisheyeMap(settings.coefficients), "coefficients"
    camera = Camera(settings, lens)
    _check_lens(camera, lens, key)
    return camera


def _check_finite(key: str, values: tuple[float, ...]) -> None:
    if not all(math.isfinite(v) for v in values):
        raise ValueError(f"{key}: {values} holds a value that is not finite; every value must be an ordinary number")


def _check_pinhole(settings: PinholeSettings) -> None:
    for key in ("width_px", "height_px"):
        if not 16 <= getattr(settings, key) <= 20000:
            raise ValueError(f"{key}: {getattr(settings, key)} is not an image size; right would be 16 to 20000 px")
    for key in ("fx_px", "fy_px"):
        value, most = getattr(settings, key), _MAX_FOCAL_WIDTHS * settings.width_px
        if not _MIN_FOCAL_PX <= value <= most:
            raise ValueError(
                f"{key}: {value:g} px is not a focal length for an image {settings.width_px} px wide (metres, mm or "
                f"a ratio?); right would be the focal length over the pixel pitch, {_MIN_FOCAL_PX:g} to {most:g} px"
            )
    if not 1.0 / _MAX_ASPECT <= settings.fy_px / settings.fx_px <= _MAX_ASPECT:
        raise ValueError(
            f"fx_px and fy_px: {settings.fx_px:g} px and {settings.fy_px:g} px differ too much; right would be nearly "
            "the same value"
        )
    if 0.0 < settings.cx_px < 1.0 and 0.0 < settings.cy_px < 1.0:
        raise ValueError(
            f"cx_px: {settings.cx_px:g} looks like a fraction of the image; right would be pixels, "
            f"about {settings.width_px / 2:g}"
        )
    for key, size in (("cx_px", settings.width_px), ("cy_px", settings.height_px)):
        value = getattr(settings, key)
        if not -0.5 * size <= value <= 1.5 * size:
            raise ValueError(
                f"{key}: {value:g} px lies far outside an image of {size} px; right would be about the middle, "
                f"{size / 2:g} px"
            )


def _check_lens(camera: Camera, lens: LensMap, key: str) -> None:
    """Reject a lens that folds, or distorts implausibly, inside the image."""
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    fractions = np.linspace(0.0, 1.0, 33)
    grid_px = np.stack(np.meshgrid(fractions, fractions), axis=-1).reshape(-1, 2) * last_px
    q = camera._from_pixels(grid_px)
    radius = np.hypot(q[0], q[1])
    if lens.folds and radius.max() >= lens.fold_q:
        raise ValueError(
            f"{key}: the lens model turns back on itself {lens.fold_q * camera.fx_px:.0f} px from the principal point, "
            f"inside the image, whose farthest corner is at {radius.max() * camera.fx_px:.0f} px; right would be a "
            "calibration that stays monotonic up to the image corners"
        )
    xy, (j00, j01, j10, j11) = lens.undistort_with_jacobian(q)
    # A fisheye's image corners may lie beyond 89 degrees; with the other lenses the whole image must be in the domain.
    inside = radius < lens.fold_q if isinstance(lens, FisheyeMap) else np.full(radius.shape, True)
    if not np.all(j00[inside] * j11[inside] - j01[inside] * j10[inside] > 0.0):
        raise ValueError(
            f"{key}: the lens model can't be inverted inside the image; right would be a calibration of this camera at "
            "this image size, with tangential coefficients well below 0.1"
        )
    if isinstance(lens, FisheyeMap):
        return
    stretch = np.hypot(xy[0], xy[1])[radius > 0.0] / radius[radius > 0.0]
    # A wide lens of Brown's that stays monotonic shows 85 degrees where a pinhole would show 60.
    widest = 1.0 if isinstance(lens, BrownMap) else stretch.max()
    worst = float(max(widest, 1.0 / stretch.min()))
    if worst > _MAX_STRETCH:
        raise ValueError(
            f"{key}: the distortion moves image points to {worst:.3g} times their distance from the principal point, "
            f"or the reverse (a coefficient in other units?); right would be below {_MAX_STRETCH:g} times"
        )
