"""The lens models that are calibrated here, with derivatives by their parameters; and the centres of discs' images.

The maps are those of :mod:`gripmon.model.lenses`, so that the calibrated model is the one used later.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings, PaperLens
from gripmon.model.lenses import BrownMap, FisheyeMap, LensMap, PaperMap
from gripmon.model.records import Array

ModelName = Literal["paper", "brown_conrady", "brown_conrady_5", "fisheye"]
MODELS: tuple[ModelName, ...] = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")
PINHOLE = ("fx_px", "fy_px", "cx_px", "cy_px")
_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "paper": ("kappa_per_px2",),
    "brown_conrady": tuple(f"coefficients.{i}" for i in range(4)),
    "brown_conrady_5": tuple(f"coefficients.{i}" for i in range(5)),
    "fisheye": tuple(f"coefficients.{i}" for i in range(4)),
}


def parameter_names(model: ModelName) -> tuple[str, ...]:
    """Names of all of a model's parameters in the order of its vector: keys of its settings."""
    return (*PINHOLE, *_COEFFICIENTS[model])


@dataclass(frozen=True, slots=True)
class LensModel:
    """A lens model at an image size.  Parameter vectors are (k,): focal lengths, principal point (px), lens (see
    :func:`parameter_names`; kappa in 1/px², the rest without unit).
    """

    name: ModelName
    width_px: int
    height_px: int

    def settings(self, parameters: Array) -> LensSettings:
        """The camera with these parameters, as in files; nothing is checked."""
        fx, fy, cx, cy, *lens = parameters.tolist()
        size = {"width_px": self.width_px, "height_px": self.height_px}
        if self.name == "paper":
            return PaperLens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, kappa_per_px2=lens[0], **size)
        if self.name == "fisheye":
            return FisheyeLens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=tuple(lens), **size)
        return BrownConradyLens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=tuple(lens), **size)

    def camera(self, parameters: Array) -> Camera:
        """The same, ready to project.  Unlike :func:`~gripmon.model.camera.make_camera` it accepts anything: an
        estimate may pass through implausible values.  Points outside the lens's domain project to NaN.
        """
        return _camera(self, tuple(parameters.tolist()))

    def without_distortion(self, focal_px: float) -> Array:
        """Parameters (k,) of a lens with this focal length, the principal point at the image's centre and no distortion
        (for the fisheye: equidistant).
        """
        parameters = np.zeros(len(parameter_names(self.name)))
        parameters[:4] = focal_px, focal_px, 0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)
        return parameters

    def project(self, parameters: Array, points_cam_m: Array) -> tuple[Array, Array, Array]:
        """Points (n, 3) in the camera frame -> pixels (n, 2), and their derivatives by the parameters (n, 2, k) and by
        the points (n, 2, 3); NaN outside the lens's domain.
        """
        camera = self.camera(parameters)
        uv_px, by_point = camera.project_with_jacobian(points_cam_m)
        fx, fy = parameters[:2]
        q = (uv_px - parameters[2:4]) / parameters[:2]
        xy = points_cam_m[:, :2] / points_cam_m[:, 2:]
        by_lens = self._by_lens(parameters, xy, q)
        by_parameters = np.zeros((len(q), 2, len(parameters)))
        by_parameters[:, 0, 0], by_parameters[:, 1, 1] = q[:, 0], q[:, 1]
        by_parameters[:, 0, 2] = by_parameters[:, 1, 3] = 1.0
        by_parameters[:, 0, 4:] = fx * by_lens[:, 0]
        by_parameters[:, 1, 4:] = fy * by_lens[:, 1]
        if self.name == "paper":
            # kappa is per pixel: in normalised coordinates it is kappa fx², so that fx also acts through it.
            by_parameters[:, :, 0] += by_parameters[:, :, 4] * (2.0 * parameters[4] / fx)
        return uv_px, by_parameters, by_point

    def map_of(self, parameters: Array) -> LensMap:
        """The lens's map alone."""
        lens = tuple(parameters[4:].tolist())
        if self.name == "paper":
            return PaperMap(lens[0] * float(parameters[0]) ** 2)
        return FisheyeMap(lens) if self.name == "fisheye" else BrownMap(lens)

    def _by_lens(self, parameters: Array, xy: Array, q: Array) -> Array:
        """Derivatives (n, 2, k - 4) of distorted normalised coordinates ``q`` (n, 2) by the lens's parameters."""
        if self.name == "paper":
            # xy = q (1 + k |q|²) is constant: J dq + q |q|² dk = 0, J the Jacobian of that map.
            qx, qy = q.T
            s2 = qx * qx + qy * qy
            k = parameters[4] * parameters[0] ** 2
            j00, j01, j11 = 1.0 + k * (s2 + 2.0 * qx * qx), 2.0 * k * qx * qy, 1.0 + k * (s2 + 2.0 * qy * qy)
            per_det = -s2 * parameters[0] ** 2 / (j00 * j11 - j01 * j01)
            by_kappa: Array = np.stack([j11 * qx - j01 * qy, j00 * qy - j01 * qx], axis=1) * per_det[:, None]
            return by_kappa[:, :, None]
        x, y = xy.T
        r2 = x * x + y * y
        if self.name == "fisheye":
            r = np.sqrt(r2 + 1e-300)
            theta = np.arctan(r)
            powers = theta[:, None] ** np.array([3, 5, 7, 9])
            out: Array = (xy / r[:, None])[:, :, None] * powers[:, None, :]
            return out
        columns: Sequence[Array] = [
            xy * r2[:, None],
            xy * (r2 * r2)[:, None],
            np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1),
            np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1),
            xy * (r2**3)[:, None],
        ]
        return np.stack(columns[: len(parameters) - 4], axis=2)


@functools.lru_cache(maxsize=16)
def _camera(model: LensModel, parameters: tuple[float, ...]) -> Camera:
    """One camera for all views: a lens's tables take longer to make than to use."""
    values = np.array(parameters)
    return Camera(model.settings(values), model.map_of(values))


def model_of(camera: LensSettings) -> ModelName:
    """The name of a camera's lens model.  :class:`CalibrationError` for models that aren't calibrated here."""
    tag = camera.__struct_config__.tag
    if tag == "brown_conrady":
        count = len(camera.coefficients)  # type: ignore[union-attr]
        if count > 5:
            raise CalibrationError(f"a lens with {count} coefficients; with 4 or 5")
        return "brown_conrady" if count == 4 else "brown_conrady_5"
    return "paper" if tag == "paper" else "fisheye"


def lens_vector(camera: LensSettings) -> Array:
    """A camera's parameters in the order of :class:`LensModel`."""
    pinhole = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
    lens = getattr(camera, "coefficients", None)
    return np.array([*pinhole, *(lens if lens is not None else (camera.kappa_per_px2,))])  # type: ignore[union-attr]


RIM_POINTS = 24


def centre_offsets_px(camera: Camera, cam_T_plate: Array, plate_m: Array, radius_m: float) -> Array:
    """(n, 2): centroid of each disc's image less the image of its centre; 0 where a rim leaves the lens's domain."""
    angles = 2.0 * np.pi / RIM_POINTS * np.arange(RIM_POINTS)
    # The polygon through the rim is a little smaller than the disc, which changes the offset by a thousandth.
    rim = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)], axis=1)
    points = (plate_m[:, None] + rim).reshape(-1, 3) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    rims = camera.project(points).reshape(len(plate_m), RIM_POINTS, 2)
    centres = camera.project(plate_m @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])
    offsets = _centroids(rims) - centres
    return np.where(np.isfinite(offsets), offsets, 0.0)


def _centroids(polygons: Array) -> Array:
    """(n, k, 2) -> (n, 2), centroids of area (shoelace formula), relative to the first corner for precision."""
    origin = polygons[:, :1]
    x, y = np.moveaxis(polygons - origin, 2, 0)
    x1, y1 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * y1 - x1 * y
    area = cross.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        out: Array = np.stack([((x + x1) * cross).sum(axis=1), ((y + y1) * cross).sum(axis=1)], axis=1) / (
            3.0 * area[:, None]
        )
    return out + origin[:, 0]
