"""Camera and plate poses together, from all points of all views: weighted, robust least squares on the manifold.

Levenberg-Marquardt (Marquardt, 1963) in the parameters of the lens and, for each view, a perturbation of its pose; the
Jacobian is analytic.  Wrong points are found by their size against the rest (Tukey's biweight on a robust scale) and
then left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.discs import centre_offsets_px
from gripmon.calibrate.lens_models import LensModel
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.geometry import perturb
from gripmon.model.records import Array

LARGEST_ITERATIONS = 200
CONVERGED = 1e-10
"""Relative decrease of the cost at which iterations end."""
BIWEIGHT = 4.685
"""Tukey's constant: 95 % efficiency for normal errors."""
OUTLIER = 5.0
"""Normalised residual, in robust standard deviations, beyond which a point is left out at the end."""
STRANGE = 0.5
"""Part of a view's points that fit, below which it is no view of the same target by the same camera."""
PARALLEL = float(np.cos(np.radians(3.0)))
ROUNDS = 12
"""Rounds of weights, and of the offsets of discs' centres, at most."""


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
        self._whiten: list[Array] = [_whitening(s.covariance_px) for s in sightings]
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
            scale = _robust_scale(np.concatenate(sizes))
            weights = [_biweight(size, scale) for size in sizes]
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

    def _normal(self, parameters: Array, poses: Sequence[Array], weights: Sequence[Array]) -> tuple[Array, Array]:
        """Normal matrix and right-hand side: p free parameters, then 6 for each view."""
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
            by_pose = np.concatenate([by_point, -by_point @ _skews(turned)], axis=2)
            rows = whiten @ np.concatenate([by_parameters @ self._free, by_pose], axis=2)
            values = np.einsum("nij,nj->ni", whiten, residual)
            good = (weight > 0.0) & np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
            root = np.sqrt(weight[good])
            a = (rows[good] * root[:, None, None]).reshape(-1, p + 6)
            b = (values[good] * root[:, None]).ravel()
            own = np.concatenate([np.arange(p), p + 6 * k + np.arange(6)])
            normal[np.ix_(own, own)] += a.T @ a
            side[own] += a.T @ b
        return normal, side

    def _minimise(self, parameters: Array, poses: list[Array], weights: Sequence[Array]) -> tuple[Array, list[Array]]:
        damping, cost = 1e-4, self._cost(parameters, poses, weights)
        if not np.isfinite(cost):
            raise CalibrationError("the start is outside of what the lens model maps; more views, or another model")
        p = self._free.shape[1]
        for _ in range(LARGEST_ITERATIONS):
            normal, side = self._normal(parameters, poses, weights)
            scale = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
            scaled = normal / np.outer(scale, scale)
            improved = False
            while damping < 1e12:
                step = np.linalg.solve(scaled + damping * np.eye(len(scale)), side / scale) / scale
                trial = parameters + self._free @ step[:p]
                moved = [perturb(T, step[p + 6 * k : p + 6 * k + 6]) for k, T in enumerate(poses)]
                new = self._cost(trial, moved, weights) if (trial[:2] > 0.0).all() else np.inf
                if new < cost:
                    improved = True
                    break
                damping *= 10.0
            if not improved:
                return parameters, poses
            gain = cost - new
            parameters, poses, cost, damping = trial, moved, new, max(0.1 * damping, 1e-12)
            if gain <= CONVERGED * cost:
                return parameters, poses
        normals = np.stack([T[:3, 2] for T in poses])
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
        normal, _ = self._normal(parameters, poses, weights)
        freedom = 2 * int(sum(u.sum() for u in used)) - len(normal)
        if freedom <= 0:
            raise CalibrationError(
                f"{len(normal)} unknowns and {freedom + len(normal)} measured coordinates; more points or views"
            )
        variance = self._cost(parameters, poses, weights) / freedom
        scale = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        scaled = normal / np.outer(scale, scale)
        if np.linalg.cond(scaled) > 1e13:
            raise CalibrationError(DEGENERATE)
        covariance = variance * np.linalg.inv(scaled) / np.outer(scale, scale)
        residuals = self._residuals(parameters, poses)
        return Bundle(
            parameters, tuple(poses), covariance, tuple(residuals), tuple(used), float(np.sqrt(variance)), freedom
        )


DEGENERATE = (
    "the views don't determine the camera (all of them show the plate at the same tilt, or parallel to the image); "
    "views tilted by 20 to 45 degrees to different sides"
)


def _skews(points: Array) -> Array:
    """(n, 3) -> (n, 3, 3), the matrices of the cross products."""
    out = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out


def _whitening(covariance: Array) -> Array:
    out: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return out


def _robust_scale(sizes: Array) -> float:
    """Standard deviation of one coordinate from lengths of pairs: their median is 1.1774 of it."""
    return max(float(np.median(sizes)) / 1.1774, 1e-9)


def _biweight(sizes: Array, scale: float) -> Array:
    share = np.minimum(sizes / (BIWEIGHT * scale), 1.0)
    out: Array = np.square(1.0 - np.square(share))
    return out
