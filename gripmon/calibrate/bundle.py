"""Bundle adjustment: a camera with derivatives by its parameters, fitted together with plate poses to all points.

The camera models' maps are those of :mod:`gripmon.model.camera`, so that the calibrated model is the one used later.
The fit is weighted, robust least squares on the manifold: the unknowns are the parameters of the lens and, for each
view, a perturbation of its pose; the Jacobian is analytic.  Outliers are found by their residuals against the rest
(Tukey's biweight on a robust scale) and then left out.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings, PaperLens
from gripmon.model.geometry import perturb, skew
from gripmon.model.least_squares import (
    TUKEY,
    Equations,
    covariance_of,
    minimise,
    normal_equations,
    robust_scale,
    tukey_weights,
    whitening,
)
from gripmon.model.lenses import BrownMap, FisheyeMap, LensMap, PaperMap
from gripmon.model.records import Array

MOST_EVALUATIONS = 1000
"""Costs that one calibration may compute, over all its starts and rounds: some sixteen times what views tilted to
different sides take with any model.
"""
OUTLIER = 5.0
"""Normalised residual, in robust standard deviations, above which a point is left out at the end."""
LEAST_VIEW_INLIERS = 0.5
"""Inlier ratio of a view below which it doesn't show the same target with the same camera."""
PARALLEL_COSINE = float(np.cos(np.radians(3.0)))
"""Cosine between the normals of the plate's poses above which views count as equally tilted."""
ROUNDS = 12
"""Maximum number of rounds of reweighting and of correcting the offsets of discs' centres."""


_State = tuple[Array, list[Array]]
"""Parameters of the lens, and the views' poses."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """Result of a fit.

    ``parameters`` (k,) of the lens; ``covariance`` (p, p) of the p free ones followed by 6 for each view (position then
    rotation of ``cam_T_plate``, camera axes), scaled by the residuals; ``residuals_px``: one (n, 2) per view, measured
    less predicted; ``used``: one (n,) per view; ``scale``: the residuals' standard deviation over the one by their
    covariances.
    """

    parameters: Array
    cam_T_plate: tuple[Array, ...]
    covariance: Array
    residuals_px: tuple[Array, ...]
    used: tuple[NDArray[np.bool_], ...]
    scale: float
    degrees_of_freedom: int

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals, u and v each."""
        used = np.concatenate([r[u] for r, u in zip(self.residuals_px, self.used, strict=True)])
        return float(np.sqrt(np.mean(np.square(used))))


class ContradictionError(CalibrationError):
    """A view of another camera, focus or target than the others."""

    def __init__(self, sighting: Sighting, points: int) -> None:
        self.sighting = sighting
        self.said = f"{points} of {len(sighting)} points contradict the other images"
        super().__init__(f"{sighting.name}: {self.said}; images of one camera and focus, or without this one")


class Effort:
    """What a calibration may still compute."""

    def __init__(self) -> None:
        self.left = MOST_EVALUATIONS


class _SpentError(Exception):
    """The effort is spent."""


class BundleProblem:
    """Sightings and a lens model; ``free`` (k, p) maps p free parameters to changes of all k: a column with two ones
    ties two parameters together.  Problems of one calibration share their ``effort``.
    """

    def __init__(self, model: LensModel, sightings: Sequence[Sighting], free: Array, effort: Effort | None = None):
        self._model, self._sightings, self._free, self._effort = model, sightings, free, effort or Effort()
        self._whiten: list[Array] = [whitening(s.covariance_px) for s in sightings]
        self._offsets: list[Array] = [np.zeros(s.uv_px.shape) for s in sightings]

    def solve(self, parameters: Array, cam_T_plate: Sequence[Array]) -> Bundle:
        """Solve from a good start.  Raises :class:`CalibrationError` if that fails."""
        poses = list(cam_T_plate)
        weights: list[Array] = [np.ones(len(s)) for s in self._sightings]
        for turn in range(ROUNDS):
            self._correct_discs(parameters, poses)
            before = parameters
            parameters, poses = self._minimise(parameters, poses, weights)
            sizes = self._sizes(parameters, poses)
            scale = max(robust_scale(np.concatenate(sizes), 2), 1e-9)
            weights = [tukey_weights(size, TUKEY * scale) for size in sizes]
            if turn > 0 and np.allclose(parameters, before, rtol=1e-9, atol=1e-12):
                break
        used = [size <= OUTLIER * scale for size in sizes]
        self._check_views(used)
        for _ in range(2):
            self._correct_discs(parameters, poses)
            parameters, poses = self._minimise(parameters, poses, [u.astype(float) for u in used])
        return self._conclude(parameters, poses, used)

    def _correct_discs(self, parameters: Array, poses: Sequence[Array]) -> None:
        camera = self._model.camera(parameters)
        for k, (sighting, pose) in enumerate(zip(self._sightings, poses, strict=True)):
            if sighting.disc_radius_m > 0.0:
                self._offsets[k] = centre_offsets_px(camera, pose, sighting.plate_m, sighting.disc_radius_m)

    def _residuals(self, parameters: Array, poses: Sequence[Array]) -> list[Array]:
        camera = self._model.camera(parameters)
        return [
            s.uv_px - offset - camera.project(s.plate_m @ T[:3, :3].T + T[:3, 3])
            for s, offset, T in zip(self._sightings, self._offsets, poses, strict=True)
        ]

    def _sizes(self, parameters: Array, poses: Sequence[Array]) -> list[Array]:
        """Norm of each point's whitened residual; infinite where it doesn't project."""
        out = []
        for residual, whiten in zip(self._residuals(parameters, poses), self._whiten, strict=True):
            size = np.linalg.norm(np.einsum("nij,nj->ni", whiten, residual), axis=1)
            out.append(np.where(np.isfinite(size), size, np.inf))
        return out

    def _cost(self, parameters: Array, poses: Sequence[Array], weights: Sequence[Array]) -> float:
        sizes = self._sizes(parameters, poses)
        return float(sum((w * np.square(np.where(w > 0.0, s, 0.0))).sum() for s, w in zip(sizes, weights, strict=True)))

    def _equations(self, parameters: Array, poses: Sequence[Array], weights: Sequence[Array]) -> Equations:
        """Normal equations, assembled view by view: p free parameters, then 6 for each view."""
        p = self._free.shape[1]
        n = p + 6 * len(poses)
        normal, side = np.zeros((n, n)), np.zeros(n)
        for k, (sighting, T, whiten, weight) in enumerate(
            zip(self._sightings, poses, self._whiten, weights, strict=True)
        ):
            turned = sighting.plate_m @ T[:3, :3].T
            uv_px, by_parameters, by_point = self._model.project(parameters, turned + T[:3, 3])
            residual = sighting.uv_px - self._offsets[k] - uv_px
            # x' = x + rho + omega x (R x_plate): position, then rotation, camera axes.
            by_pose = np.concatenate([by_point, -by_point @ skew(turned)], axis=2)
            rows = whiten @ np.concatenate([by_parameters @ self._free, by_pose], axis=2)
            values = np.einsum("nij,nj->ni", whiten, residual)
            good = (weight > 0.0) & np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
            own = np.concatenate([np.arange(p), p + 6 * k + np.arange(6)])
            view = normal_equations(rows[good], values[good], weight[good])
            normal[np.ix_(own, own)] += view[0]
            side[own] += view[1]
        return normal, side

    def normal_matrix(self, parameters: Array, cam_T_plate: Array) -> Array:
        """(p + 6, p + 6) of a single view with all its points: free parameters, then the pose."""
        return self._equations(parameters, [cam_T_plate], [np.ones(len(self._sightings[0]))])[0]

    def _minimise(self, parameters: Array, poses: list[Array], weights: Sequence[Array]) -> tuple[Array, list[Array]]:
        if not np.isfinite(self._cost(parameters, poses, weights)):
            raise CalibrationError("the start is outside of what the lens model maps; more views, or another model")
        p = self._free.shape[1]

        def cost(at: _State) -> float:
            if self._effort.left <= 0:
                raise _SpentError
            self._effort.left -= 1
            return self._cost(*at, weights) if (at[0][:2] > 0.0).all() else np.inf

        def moved(at: _State, step: Array) -> _State:
            steps = step[p:].reshape(-1, 6)
            return at[0] + self._free @ step[:p], [perturb(T, xi) for T, xi in zip(at[1], steps, strict=True)]

        with contextlib.suppress(_SpentError):
            return minimise(
                (parameters, poses), cost, lambda at: self._equations(*at, weights), moved, iterations=MOST_EVALUATIONS
            ).state
        normals = np.stack([T[:3, 2] for T in poses])
        if len(poses) > 1 and (normals @ normals.T).min() > PARALLEL_COSINE:
            raise CalibrationError(DEGENERATE)
        raise CalibrationError(
            f"did not converge in {MOST_EVALUATIONS} evaluations; more views, more tilted against each other, or a "
            "model with fewer parameters"
        )

    def _check_views(self, used: Sequence[NDArray[np.bool_]]) -> None:
        if len(used) > 1:
            sighting, good = min(zip(self._sightings, used, strict=True), key=lambda one: float(one[1].mean()))
            if good.mean() < LEAST_VIEW_INLIERS:
                raise ContradictionError(sighting, int((~good).sum()))

    def _conclude(self, parameters: Array, poses: list[Array], used: list[NDArray[np.bool_]]) -> Bundle:
        weights = [u.astype(float) for u in used]
        normal, _ = self._equations(parameters, poses, weights)
        freedom = 2 * int(sum(u.sum() for u in used)) - len(normal)
        if freedom <= 0:
            raise CalibrationError(
                f"{len(normal)} unknowns and {freedom + len(normal)} measured coordinates; more points or views"
            )
        variance = self._cost(parameters, poses, weights) / freedom
        try:
            covariance = covariance_of(normal, variance)
        except np.linalg.LinAlgError:
            raise CalibrationError(DEGENERATE) from None
        residuals = self._residuals(parameters, poses)
        return Bundle(
            parameters, tuple(poses), covariance, tuple(residuals), tuple(used), float(np.sqrt(variance)), freedom
        )


DEGENERATE = (
    "the views don't determine the camera (all of them show the plate at the same tilt, or parallel to the image); "
    "views tilted by 20 to 45 degrees to different sides"
)


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


def plate_pose(camera: LensSettings, sighting: Sighting) -> tuple[Array, Array, Bundle]:
    """``cam_T_plate`` (4, 4) with the covariance (6, 6) of its error (position then rotation, camera axes) for an exact
    camera, and the fit that it comes from.  Raises :class:`CalibrationError`.
    """
    if len(sighting) < 4:
        raise CalibrationError(f"{len(sighting)} points of the plate; at least 4")
    lens_model, parameters = LensModel(model_of(camera), camera.width_px, camera.height_px), lens_vector(camera)
    problem = BundleProblem(lens_model, [sighting], np.zeros((len(parameters), 0)))
    found: list[Bundle] = []
    failure: CalibrationError | None = None
    # From afar a plane has two poses that look nearly the same; each is a local minimum.
    for start in _plate_pose_starts(lens_model, parameters, sighting):
        try:
            found.append(problem.solve(parameters, [start]))
        except CalibrationError as error:
            failure = failure or error
    if not found:
        raise failure or CalibrationError("the plate's pose can't be found")
    bundle = min(found, key=_typical_px)
    return bundle.cam_T_plate[0], bundle.covariance, bundle


def model_of(camera: LensSettings) -> ModelName:
    """The name of a camera's lens model.  :class:`CalibrationError` for models that aren't calibrated here."""
    tag = camera.__struct_config__.tag
    if tag == "brown_conrady":
        count = len(camera.coefficients)  # type: ignore[union-attr]
        if count > 5:
            raise CalibrationError(f"a lens with {count} coefficients; with 4 or 5")
        return "brown_conrady" if count == 4 else "brown_conrady_5"
    return "paper" if tag == "paper" else "fisheye"


def plate_pose_start(lens_model: LensModel, parameters: Array, sighting: Sighting) -> Array:
    """``cam_T_plate`` (4, 4) in closed form, from ideal coordinates (Collins and Bartoli, "Infinitesimal plane-based
    pose estimation", 2014).  :class:`CalibrationError` if the lens doesn't map the points or they are collinear.
    """
    return _plate_pose_starts(lens_model, parameters, sighting)[0]


def _plate_pose_starts(lens_model: LensModel, parameters: Array, sighting: Sighting) -> list[Array]:
    """Both poses (4, 4), the better one first."""
    xy = lens_model.camera(parameters).undistort(sighting.uv_px)
    good = np.isfinite(xy).all(axis=1)
    if good.sum() < 4:
        raise CalibrationError("the start is outside of what the lens model maps")
    # The solver expects centred points.
    middle = sighting.plate_m[good].mean(axis=0)
    points = sighting.plate_m[good] - middle
    spread = np.linalg.svd(points[:, :2], compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        raise CalibrationError("all points of the plate lie on a line; points that span an area")
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        points, np.ascontiguousarray(xy[good]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        raise CalibrationError("the plate's pose can't be found")
    out: list[Array] = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(turn)[0]
        pose[:3, 3] = shift.ravel() - pose[:3, :3] @ middle
        if np.isfinite(pose).all() and ((points @ pose[2, :3] + shift.ravel()[2]) > 0.0).all():
            out.append(pose)
    if not out:
        raise CalibrationError("the plate's pose can't be found")
    return out


def _typical_px(bundle: Bundle) -> float:
    """Median residual of all points: a wrong pose has no outliers, because all points are equally far off."""
    sizes = np.linalg.norm(np.concatenate(bundle.residuals_px), axis=1)
    return float(np.median(np.where(np.isfinite(sizes), sizes, np.inf)))


def merit(bundle: Bundle) -> tuple[float, float]:
    """Sort key, smaller is better: number of points left out, then the residuals of the rest."""
    used = np.concatenate(bundle.used)
    return float(np.count_nonzero(~used)), bundle.rms_px


def lens_vector(camera: LensSettings) -> Array:
    """A camera's parameters in the order of :class:`LensModel`."""
    pinhole = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
    lens = getattr(camera, "coefficients", None)
    return np.array([*pinhole, *(lens if lens is not None else (camera.kappa_per_px2,))])  # type: ignore[union-attr]


@dataclass(frozen=True, slots=True)
class GivenCamera:
    """A camera with the covariance of those of its ``parameters`` that aren't exact, named as in its file; ``target``:
    what it was calibrated with, if that is known.
    """

    lens: LensSettings
    parameters: tuple[str, ...] = ()
    covariance: Array | None = None
    target: str | None = None

    @classmethod
    def calibrated(cls, found: CameraCalibration) -> GivenCamera:
        """The camera of a calibration."""
        count = len(found.parameters)
        covariance = np.reshape(np.array(found.covariance), (count, count))
        return cls(found.camera, found.parameters, covariance, found.target)

    @property
    def model(self) -> LensModel:
        """Its lens model with derivatives.  :class:`CalibrationError` for models that aren't calibrated here."""
        return LensModel(model_of(self.lens), self.lens.width_px, self.lens.height_px)

    @property
    def free(self) -> Array:
        """(k, p): effect of the p ``parameters`` on all k; fy follows fx if the aspect was held."""
        names = parameter_names(model_of(self.lens))
        unknown = [name for name in self.parameters if name not in names]
        if unknown:
            raise CalibrationError(f"{unknown[0]} is not a parameter of this camera; one of {', '.join(names)}")
        out = np.zeros((len(names), len(self.parameters)))
        out[[names.index(name) for name in self.parameters], np.arange(len(self.parameters))] = 1.0
        if "fx_px" in self.parameters and "fy_px" not in self.parameters:
            out[1, self.parameters.index("fx_px")] = self.lens.fy_px / self.lens.fx_px
        return out


def pose_slopes(camera: GivenCamera, sighting: Sighting, cam_T_plate: Array) -> Array:
    """(6, p): effect of each of the camera's independent errors, per standard deviation, on the plate's pose from the
    image (position then rotation, camera axes), to first order; p = 0 for an exact camera.
    """
    if camera.covariance is None or not camera.parameters:
        return np.zeros((6, 0))
    problem = BundleProblem(camera.model, [sighting], camera.free)
    normal = problem.normal_matrix(lens_vector(camera.lens), cam_T_plate)
    p = len(camera.parameters)
    out: Array = -np.linalg.solve(normal[p:, p:], normal[p:, :p]) @ independent_errors(camera.covariance).T
    return out


def independent_errors(covariance: Array) -> Array:
    """(n, n) rows of independent errors, one standard deviation each.  By eigenvectors, because a covariance is nearly
    singular if corners share an edge or parameters were hardly free.
    """
    scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    variances, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    if not np.isfinite(variances).all() or variances.min() < -1e-6:
        raise CalibrationError("a covariance has negative variances; one of errors")
    roots: Array = scale[:, None] * axes * np.sqrt(np.maximum(variances, 0.0))
    return roots.T
