"""Camera and plate poses together, from all points of all views: weighted, robust least squares on the manifold.

The unknowns are the parameters of the lens and, for each view, a perturbation of its pose; the Jacobian is analytic.
Wrong points are found by their size against the rest (Tukey's biweight on a robust scale) and then left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.lens_models import LensModel
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import Camera
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
from gripmon.model.records import Array

LARGEST_ITERATIONS = 200
OUTLIER = 5.0
"""Normalised residual, in robust standard deviations, beyond which a point is left out at the end."""
STRANGE = 0.5
"""Part of a view's points that fit, below which it is no view of the same target by the same camera."""
PARALLEL = float(np.cos(np.radians(3.0)))
ROUNDS = 12
"""Rounds of weights, and of the offsets of discs' centres, at most."""


_State = tuple[Array, list[Array]]
"""Parameters of the lens, and the views' poses."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """What was estimated.

    ``parameters`` (k,) of the lens; ``covariance`` (p, p) of the p free ones and, behind them, 6 for each view
    (position then rotation of ``cam_T_plate``, camera axes), scaled by the residuals; ``residuals_px`` one (n, 2) a
    view, measured less predicted; ``used`` one (n,) a view; ``scale`` the residuals' standard deviation over what their
    covariances say.
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


class BundleProblem:
    """Sightings and a lens model; ``free`` (k, p) maps p free parameters to changes of all k: a column with two ones
    ties two together.
    """

    def __init__(self, model: LensModel, sightings: Sequence[Sighting], free: Array):
        self._model, self._sightings, self._free = model, sightings, free
        self._whiten: list[Array] = [whitening(s.covariance_px) for s in sightings]
        self._offsets: list[Array] = [np.zeros(s.uv_px.shape) for s in sightings]

    def solve(self, parameters: Array, cam_T_plate: Sequence[Array]) -> Bundle:
        """From a start near enough.  Raises :class:`CalibrationError` when it leads nowhere."""
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
        """Length of each point's whitened residual; infinite where it doesn't project."""
        out = []
        for residual, whiten in zip(self._residuals(parameters, poses), self._whiten, strict=True):
            size = np.linalg.norm(np.einsum("nij,nj->ni", whiten, residual), axis=1)
            out.append(np.where(np.isfinite(size), size, np.inf))
        return out

    def _cost(self, parameters: Array, poses: Sequence[Array], weights: Sequence[Array]) -> float:
        sizes = self._sizes(parameters, poses)
        return float(sum((w * np.square(np.where(w > 0.0, s, 0.0))).sum() for s, w in zip(sizes, weights, strict=True)))

    def _equations(self, parameters: Array, poses: Sequence[Array], weights: Sequence[Array]) -> Equations:
        """Assembled view by view: p free parameters, then 6 for each view."""
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

    def _minimise(self, parameters: Array, poses: list[Array], weights: Sequence[Array]) -> tuple[Array, list[Array]]:
        if not np.isfinite(self._cost(parameters, poses, weights)):
            raise CalibrationError("the start is outside of what the lens model maps; more views, or another model")
        p = self._free.shape[1]

        def cost(at: _State) -> float:
            return self._cost(*at, weights) if (at[0][:2] > 0.0).all() else np.inf

        def moved(at: _State, step: Array) -> _State:
            steps = step[p:].reshape(-1, 6)
            return at[0] + self._free @ step[:p], [perturb(T, xi) for T, xi in zip(at[1], steps, strict=True)]

        found = minimise(
            (parameters, poses), cost, lambda at: self._equations(*at, weights), moved, iterations=LARGEST_ITERATIONS
        )
        if found.converged:
            return found.state
        normals = np.stack([T[:3, 2] for T in found.state[1]])
        if len(poses) > 1 and (normals @ normals.T).min() > PARALLEL:
            raise CalibrationError(DEGENERATE)
        raise CalibrationError(
            f"did not converge in {LARGEST_ITERATIONS} steps; more views, more tilted against each other, or a model "
            "with fewer parameters"
        )

    def _check_views(self, used: Sequence[NDArray[np.bool_]]) -> None:
        for sighting, good in zip(self._sightings, used, strict=True):
            if len(used) > 1 and good.mean() < STRANGE:
                raise CalibrationError(
                    f"{sighting.name}: {int((~good).sum())} of {len(good)} points contradict the other images; images "
                    "of one camera and focus, or without this one"
                )

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
    """(n, 2): centre of area of each disc's image less the image of its centre; 0 where a rim leaves the lens."""
    angles = 2.0 * np.pi / RIM_POINTS * np.arange(RIM_POINTS)
    # The polygon through the rim is a little smaller than the disc; its centre is the same to a thousandth of that.
    rim = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)], axis=1)
    points = (plate_m[:, None] + rim).reshape(-1, 3) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    rims = camera.project(points).reshape(len(plate_m), RIM_POINTS, 2)
    centres = camera.project(plate_m @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])
    offsets = _centroids(rims) - centres
    return np.where(np.isfinite(offsets), offsets, 0.0)


def _centroids(polygons: Array) -> Array:
    """(n, k, 2) -> (n, 2), centres of area (shoelace formula), reckoned about the first corner for exactness."""
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
