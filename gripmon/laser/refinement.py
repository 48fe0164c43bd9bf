"""All parameters of a laser set-up together: minimise the distance between measured and predicted spots in the image.

Equation (35) of the laser-pointer method, with an analytic Jacobian.  Wrong spots (speckle, reflections) lose their
weight by Tukey's biweight, on a robust scale that shrinks with the residuals; at the end outliers are left out, and the
inliers get full weight.  (The paper keeps the 50 nearest of 90, however many are wrong.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.lens_models import lens_vector
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import COUNT, LaserSetup, in_camera, spots_in_camera, spots_on_plane
from gripmon.model.camera import Camera, LensSettings
from gripmon.model.least_squares import (
    TUKEY,
    Equations,
    covariance_of,
    minimise,
    normal_equations,
    robust_scale,
    tukey_cost,
    tukey_weights,
    whitening,
)
from gripmon.model.records import Array

FALSE_OUTLIERS = 0.02
"""Expected number of good spots in a whole data set that are left out.  At 0.1 the smaller scale of the rest reduces
the coverage of the 95 % region by up to 3 %; wrong spots are farther off than either limit.
"""
_ITERATIONS = 100
_ITERATIONS_A_ROUND = 6
_ROUNDS = 40
_SELECTIONS = 10
_LEAST_TESTED = 1e-6
_LEAST = 1e-9


@dataclass(frozen=True, slots=True)
class Refined:
    """Result of the refinement: ``covariance`` (13, 13) of :data:`~gripmon.laser.setup.PARAMETERS` at ``setup``;
    ``residuals_px`` (n, 2) measured less predicted; ``used`` (n,); ``scale``: the residuals' standard deviation over
    the one by the spots' covariances (in pixels if these are unit matrices); ``camera``: the refined one if the
    lens was not held.
    """

    setup: LaserSetup
    covariance: Array
    residuals_px: Array
    used: NDArray[np.bool_]
    scale: float
    degrees_of_freedom: int
    camera: LensSettings

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals, u and v each."""
        return float(np.sqrt(np.mean(np.square(self.residuals_px[self.used]))))

    @property
    def scale_px(self) -> float:
        """Noise of the spots per axis, from the residuals and their degrees of freedom."""
        freedom = max(self.degrees_of_freedom, 1)
        return self.rms_px * float(np.sqrt(2 * int(self.used.sum()) / freedom))


def refine(problem: SpotProblem, start: LaserSetup) -> Refined:
    """The best set-up near a start.  Raises :class:`CalibrationError` if it is not determined."""
    state = problem.start(start)
    scale = _robust_scale(problem, state)
    for _ in range(_ROUNDS):
        state = _minimise(problem, state, _Loss(scale), _ITERATIONS_A_ROUND)
        newest = _robust_scale(problem, state)
        if newest > 0.999 * scale:
            break
        scale = newest
    problem = problem.with_pose_noise(state)
    state = _minimise(problem, state, _Loss(_robust_scale(problem, state)), _ITERATIONS)
    limit = float(np.sqrt(chdtri(2, FALSE_OUTLIERS / len(problem))))
    used = problem.sizes(state) <= limit * _robust_scale(problem, state)
    for _ in range(_SELECTIONS):  # of two alternating sets the last fit's is kept
        fitted = used
        state = _least_squares(problem, state, fitted)
        used = _consistent(problem, state, fitted)
        if (used == fitted).all():
            break
    return _conclude(problem, state, fitted)


@dataclass(frozen=True, slots=True)
class _Loss:
    """Cost and weights of whitened residuals: Tukey's biweight, or, with ``used`` (n,), squares of these alone;
    ``scale`` is one coordinate's standard deviation, by which priors are weighted against the spots.
    """

    scale: float
    used: NDArray[np.bool_] | None = None

    def cost(self, sizes: Array) -> float:
        if self.used is None:
            return tukey_cost(sizes, TUKEY * self.scale)
        return float(np.square(sizes[self.used]).sum())

    def weights(self, sizes: Array) -> Array:
        return tukey_weights(sizes, TUKEY * self.scale) if self.used is None else self.used.astype(float)


def _minimise(problem: SpotProblem, state: State, loss: _Loss, iterations: int) -> State:
    def cost(at: State) -> float:
        return loss.cost(problem.sizes(at)) + loss.scale**2 * float(np.square(problem.prior(at)[1]).sum())

    def equations(at: State) -> Equations:
        return _equations(problem, at, loss)

    return minimise(state, cost, equations, State.moved, iterations=iterations).state


def _equations(problem: SpotProblem, state: State, loss: _Loss) -> Equations:
    """Normal equations of the spots and of the prior, in the spots' unit."""
    rows, values = problem.linearised(state)
    spots = normal_equations(rows, values, loss.weights(np.linalg.norm(values, axis=1)))
    prior = normal_equations(*problem.prior(state))
    return spots[0] + loss.scale**2 * prior[0], spots[1] + loss.scale**2 * prior[1]


def _least_squares(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> State:
    if 2 * int(used.sum()) <= problem.unknowns:
        raise CalibrationError(
            f"{int(used.sum())} of {len(problem)} spots agree with each other; at least {problem.unknowns // 2 + 1}, "
            "better 50"
        )
    return _minimise(problem, state, _Loss(_scale_of(problem, state, used), used), _ITERATIONS)


def _consistent(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Spots (n,) that are consistent with the fit to all others.

    A used spot pulls the fit towards itself, one that is left out doesn't: by its leverage G its residual r has the
    covariance s² (I - G) or s² (I + G).  With the scale of the others, rᵀ (I ∓ G)⁻¹ r / 2 s² has an F distribution
    (Cook and Weisberg, 1982), and is the same whether or not the spot is in the fit.  A single threshold and scale for
    all would leave out twice as many good spots as it states, and make the rest look better than it is.
    """
    scale = _scale_of(problem, state, used)
    rows, values = problem.linearised(state)
    normal, _ = _equations(problem, state, _Loss(scale, used))
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    leverage = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
    pulled = np.einsum("nip,pq,njq->nij", rows / size, leverage, rows / size)
    spread = np.eye(2) + np.where(used, -1.0, 1.0)[:, None, None] * pulled
    # A spot that alone determines a parameter fits however wrong it is, so it can't be tested.
    tested = np.linalg.eigvalsh(spread)[:, 0] > _LEAST_TESTED
    spread[~tested] = np.eye(2)
    sizes = np.where(tested, np.einsum("ni,ni->n", values, np.linalg.solve(spread, values[:, :, None])[:, :, 0]), 0.0)
    whole = 2 * int(used.sum()) - COUNT
    freedom = np.maximum(whole - 2.0 * used, 1.0)
    variance = (whole * scale**2 - np.where(used, sizes, 0.0)) / freedom
    ratio = 0.5 * sizes / np.maximum(variance, _LEAST**2)
    limit = fdtri(2, freedom, 1.0 - FALSE_OUTLIERS / len(problem))
    out: NDArray[np.bool_] = np.isfinite(problem.sizes(state)) & ((ratio <= limit) | (whole <= 2))
    return out


def _robust_scale(problem: SpotProblem, state: State) -> float:
    """Robust standard deviation of one coordinate, corrected for the number of parameters."""
    scale = robust_scale(problem.sizes(state), 2)
    if not np.isfinite(scale):
        raise CalibrationError("most spots don't lie before the camera; poses and spots of one set-up")
    left = max(1.0 - COUNT / (2.0 * len(problem)), 0.25)
    return max(scale / float(np.sqrt(left)), _LEAST)


def _scale_of(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> float:
    """Standard deviation of one coordinate, from the used spots' residuals."""
    freedom = 2 * int(used.sum()) - COUNT
    return max(float(np.sqrt(np.square(problem.sizes(state)[used]).sum() / freedom)), _LEAST)


def _conclude(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> Refined:
    scale = _scale_of(problem, state, used)
    normal, _ = _equations(problem, state, _Loss(scale, used))
    try:
        covariance = covariance_of(normal, scale**2)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the spots don't tell all of camera, plane and laser; more orientations, turned about two axes or more"
        ) from None
    return Refined(
        state.setup, covariance[:COUNT, :COUNT], problem.residuals_px(state), used, scale,
        2 * int(used.sum()) - COUNT, problem.camera(state).settings,
    )  # fmt: skip


def with_held_lens(refined: Refined, problem: SpotProblem, lens: GivenCamera) -> Refined:
    """``refined``, computed with the lens held that is its ``problem``'s prior: its ``covariance`` grows by the effect
    of the lens's error on the solution, to first order ("consider" parameters; Schmidt, 1966).  The set-up is
    unchanged.
    """
    state = problem.start(refined.setup)
    rows, _ = problem.with_pose_noise(state).linearised(state)
    rows = rows[refined.used].reshape(-1, problem.unknowns)
    own = rows[:, :COUNT]
    size = np.linalg.norm(own, axis=0)
    # Least-squares response (13, p) to a change of the lens's free parameters.
    by_lens = np.linalg.lstsq(own / size, rows[:, COUNT:], rcond=None)[0] / size[:, None]
    return replace(refined, covariance=refined.covariance + by_lens @ np.asarray(lens.covariance) @ by_lens.T)


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Standard deviations of each pose that the arm reports: position along each axis, rotation about each axis."""

    position_m: float
    rotation_rad: float

    def covariance(self) -> Array:
        """(6, 6), position then rotation."""
        return np.diag(np.square([self.position_m] * 3 + [self.rotation_rad] * 3))


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns: the set-up, and changes (p,) of the lens's free parameters (none if it is held)."""

    setup: LaserSetup
    lens: Array

    def moved(self, change: Array) -> State:
        return State(self.setup.moved(change[:COUNT]), self.lens + change[COUNT:])


class SpotProblem:
    """Spots ``uv_px`` (n, 2) with ``covariance_px`` (n, 2, 2), one pixel per axis if None, at ``base_T_ee`` (n, 4, 4).
    Covariances, including what the arm's noise adds, count up to a common scale.
    """

    def __init__(
        self,
        camera: Camera,
        base_T_ee: Array,
        uv_px: Array,
        covariance_px: Array | None = None,
        *,
        lens: GivenCamera | None = None,
        pose_noise: PoseNoise | None = None,
    ):
        self.base_T_ee, self.uv_px = base_T_ee, uv_px
        self._camera, self._lens, self._pose_noise = camera, lens, pose_noise
        self._spots_px2 = np.tile(np.eye(2), (len(uv_px), 1, 1)) if covariance_px is None else covariance_px
        self._whiten = whitening(self._spots_px2)
        self._root = np.empty((0, 0)) if lens is None else _root(lens)

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def unknowns(self) -> int:
        """Number of estimated parameters."""
        return COUNT + len(self._root)

    def start(self, setup: LaserSetup) -> State:
        """A state with the lens as calibrated."""
        return State(setup, np.zeros(len(self._root)))

    def camera(self, state: State) -> Camera:
        """The camera of a state."""
        return self._camera if self._lens is None else self._lens.model.camera(self._parameters(self._lens, state))

    def with_pose_noise(self, state: State) -> SpotProblem:
        """The problem with the arm's noise added to the spots' covariances at a state."""
        if self._pose_noise is None:
            return self
        by_arm = self._predicted(state)[2]
        added = by_arm @ self._pose_noise.covariance() @ by_arm.transpose(0, 2, 1)
        added[~np.isfinite(added).all(axis=(1, 2))] = 0.0
        return SpotProblem(self._camera, self.base_T_ee, self.uv_px, self._spots_px2 + added, lens=self._lens)

    def residuals_px(self, state: State) -> Array:
        """(n, 2), measured less predicted; NaN where the set-up puts no spot in front of the camera."""
        spots = in_camera(state.setup, spots_on_plane(state.setup, self.base_T_ee))
        return self.uv_px - self.camera(state).project(spots)

    def sizes(self, state: State) -> Array:
        """Norms (n,) of the whitened residuals; infinite where there is none."""
        sizes = np.linalg.norm(np.einsum("nij,nj->ni", self._whiten, self.residuals_px(state)), axis=1)
        return np.where(np.isfinite(sizes), sizes, np.inf)

    def linearised(self, state: State) -> tuple[Array, Array]:
        """Whitened rows (n, 2, p) and residuals (n, 2) at a state; zero where there is no spot."""
        uv_px, rows, _ = self._predicted(state)
        rows = self._whiten @ rows
        values = np.einsum("nij,nj->ni", self._whiten, self.uv_px - uv_px)
        good = np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
        rows[~good], values[~good] = 0.0, 0.0
        return rows, values

    def prior(self, state: State) -> tuple[Array, Array]:
        """Whitened rows (p, unknowns) and residuals (p,) of the lens's prior."""
        rows = np.zeros((len(self._root), self.unknowns))
        rows[:, COUNT:] = self._root
        return rows, -self._root @ state.lens

    def _predicted(self, state: State) -> tuple[Array, Array, Array]:
        """Pixels (n, 2), and their derivatives by the unknowns (n, 2, p) and by the arm's poses (n, 2, 6)."""
        spots, slopes = spots_in_camera(state.setup, self.base_T_ee)
        if self._lens is None:
            uv_px, by_point = self._camera.project_with_jacobian(spots)
            rows = by_point @ slopes
            return uv_px, rows[:, :, :COUNT], rows[:, :, COUNT:]
        uv_px, by_lens, by_point = self._lens.model.project(self._parameters(self._lens, state), spots)
        rows = by_point @ slopes
        return uv_px, np.concatenate([rows[:, :, :COUNT], by_lens @ self._lens.free], axis=2), rows[:, :, COUNT:]

    @staticmethod
    def _parameters(lens: GivenCamera, state: State) -> Array:
        out: Array = lens_vector(lens.lens) + lens.free @ state.lens
        return out


def _root(lens: GivenCamera) -> Array:
    """(p, p) matrix that whitens changes of the lens's free parameters.  Raises :class:`CalibrationError`."""
    try:
        return whitening(np.asarray(lens.covariance))
    except np.linalg.LinAlgError:
        raise CalibrationError("the camera's covariance is not a covariance (not positive definite)") from None
