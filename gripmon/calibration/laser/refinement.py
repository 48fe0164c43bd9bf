"""All parameters of a laser set-up at once: the least distance between measured and predicted spots in the image.

Equation (35) of the laser-pointer method, by Levenberg-Marquardt with an analytic Jacobian.  Wrong spots (speckle,
reflections) get no weight where they contradict the rest: Tukey's biweight on a robust scale, from a start that a
bounded loss has found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from gripmon.calibration.laser.setup import PARAMETERS, LaserSetup, spots_on_plane
from gripmon.calibration.sighting import CalibrationError
from gripmon.camera import Camera
from gripmon.records import Array

BIWEIGHT = 4.685
"""Tukey's constant: 95 % efficiency for normal errors."""
FALSE_OUTLIERS = 0.1
"""How many good spots of a whole data set may be left out, on average."""
_ITERATIONS = 100
_ROUNDS = 30


@dataclass(frozen=True, slots=True)
class Refined:
    """``covariance`` (13, 13) of :data:`~gripmon.calibration.laser.setup.PARAMETERS` at ``setup``; ``residuals_px``
    (n, 2) measured less predicted; ``used`` (n,); ``sigma_px`` the spots' noise as the residuals show it, each axis.
    """

    setup: LaserSetup
    covariance: Array
    residuals_px: Array
    used: NDArray[np.bool_]
    sigma_px: float
    cost: float

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals, u and v each."""
        return float(np.sqrt(np.mean(np.square(self.residuals_px[self.used]))))


class SpotProblem:
    """Spots ``uv_px`` (n, 2) with ``covariance_px`` (n, 2, 2) up to a common scale, at ``base_T_ee`` (n, 4, 4)."""

    def __init__(self, camera: Camera, base_T_ee: Array, uv_px: Array, covariance_px: Array | None = None):
        self.camera, self.base_T_ee, self.uv_px = camera, base_T_ee, uv_px
        covariance = np.tile(np.eye(2), (len(uv_px), 1, 1)) if covariance_px is None else covariance_px
        self._whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def residuals_px(self, setup: LaserSetup) -> Array:
        """(n, 2); NaN where the set-up puts no spot before the camera."""
        spots, _ = spots_on_plane(setup, self.base_T_ee)
        return self.uv_px - self.camera.project(spots)

    def sizes(self, setup: LaserSetup) -> Array:
        """(n,) lengths of the whitened residuals; infinite where there is none."""
        sizes = np.linalg.norm(np.einsum("nij,nj->ni", self._whiten, self.residuals_px(setup)), axis=1)
        return np.where(np.isfinite(sizes), sizes, np.inf)

    def linearised(self, setup: LaserSetup) -> tuple[Array, Array]:
        """Whitened rows (n, 2, 13) and residuals (n, 2) at a set-up; zero where there is no spot."""
        spots, slopes = spots_on_plane(setup, self.base_T_ee)
        uv_px, by_point = self.camera.project_with_jacobian(spots)
        rows = self._whiten @ (by_point @ slopes)
        values = np.einsum("nij,nj->ni", self._whiten, self.uv_px - uv_px)
        good = np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
        rows[~good], values[~good] = 0.0, 0.0
        return rows, values


def refine(problem: SpotProblem, start: LaserSetup) -> Refined:
    """The best set-up near a start.  Raises :class:`CalibrationError` when it is not determined."""
    setup = start
    scale = _scale(problem.sizes(setup))
    for _ in range(_ROUNDS):
        setup = _minimise(problem, setup, scale)
        newest = _scale(problem.sizes(setup))
        if abs(newest - scale) < 1e-3 * scale:
            break
        scale = min(newest, scale)
    limit = np.sqrt(chi2.isf(FALSE_OUTLIERS / len(problem.uv_px), 2))
    used = problem.sizes(setup) <= limit * scale
    for _ in range(10):
        setup = _minimise(problem, setup, None, used)
        freedom = 2 * int(used.sum()) - len(PARAMETERS)
        if freedom <= 0:
            raise CalibrationError(f"{int(used.sum())} spots agree with each other; at least 7, better 50")
        scale = float(np.sqrt(np.square(problem.sizes(setup)[used]).sum() / freedom))
        again = problem.sizes(setup) <= limit * scale
        if (again == used).all():
            break
        used = again
    return _conclude(problem, setup, used)


def _minimise(
    problem: SpotProblem, setup: LaserSetup, scale: float | None, used: NDArray[np.bool_] | None = None
) -> LaserSetup:
    """Levenberg-Marquardt on the biweight of this scale, or on the squares of those ``used``."""

    def loss(sizes: Array) -> float:
        if scale is None:
            assert used is not None
            return float(np.square(sizes[used]).sum())
        share = np.minimum(sizes / (BIWEIGHT * scale), 1.0)
        return float((1.0 - (1.0 - share * share) ** 3).sum())

    def weights(sizes: Array) -> Array:
        if scale is None:
            assert used is not None
            return used.astype(float)
        out: Array = np.square(1.0 - np.square(np.minimum(sizes / (BIWEIGHT * scale), 1.0)))
        return out

    sizes = problem.sizes(setup)
    cost, damping = loss(sizes), 1e-4
    for _ in range(_ITERATIONS):
        rows, values = problem.linearised(setup)
        root = np.sqrt(weights(sizes))[:, None]
        a, b = (rows * root[:, :, None]).reshape(-1, len(PARAMETERS)), (values * root).ravel()
        size = np.maximum(np.linalg.norm(a, axis=0), 1e-12)
        normal, side = (a / size).T @ (a / size), (a / size).T @ b
        while damping < 1e10:
            trial = setup.moved(np.linalg.solve(normal + damping * np.eye(len(size)), side) / size)
            new_sizes = problem.sizes(trial)
            new = loss(new_sizes)
            if new < cost:
                break
            damping *= 10.0
        else:
            return setup
        gain = cost - new
        setup, sizes, cost, damping = trial, new_sizes, new, max(0.1 * damping, 1e-12)
        if gain <= 1e-10 * cost:
            break
    return setup


def _conclude(problem: SpotProblem, setup: LaserSetup, used: NDArray[np.bool_]) -> Refined:
    rows, _ = problem.linearised(setup)
    a = rows[used].reshape(-1, len(PARAMETERS))
    size = np.linalg.norm(a, axis=0)
    singular = np.linalg.svd(a / np.maximum(size, 1e-300), compute_uv=False)
    if not size.all() or singular[-1] < 1e-8 * singular[0]:
        raise CalibrationError(
            "the spots don't tell all of camera, plane and laser; more orientations, turned about two axes or more"
        )
    squares = float(np.square(problem.sizes(setup)[used]).sum())
    variance = squares / (2 * int(used.sum()) - len(PARAMETERS))
    covariance = variance * np.linalg.inv((a / size).T @ (a / size)) / np.outer(size, size)
    return Refined(setup, covariance, problem.residuals_px(setup), used, float(np.sqrt(variance)), squares)


def _scale(sizes: Array) -> float:
    """Standard deviation of one coordinate, from lengths of pairs: their median is 1.1774 of it."""
    return max(float(np.median(sizes)) / 1.1774, 1e-9)
