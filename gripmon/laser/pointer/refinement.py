"""All parameters of a laser set-up at once: the least distance between measured and predicted spots in the image.

Equation (35) of the laser-pointer method, by Levenberg-Marquardt with an analytic Jacobian.  Wrong spots (speckle,
reflections) get no weight where they contradict the rest: Tukey's biweight on a robust scale that shrinks with the
residuals; at the end those beyond what noise explains are left out, and the rest counts in full.  (The print keeps the
50 nearest of 90, however many are wrong.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as fisher_f

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.setup import PARAMETERS, LaserSetup
from gripmon.laser.pointer.spot_problem import SpotProblem, State
from gripmon.model.camera import LensSettings
from gripmon.model.records import Array

BIWEIGHT = 4.685
"""Tukey's constant: 95 % efficiency for normal errors."""
FALSE_OUTLIERS = 0.02
"""How many good spots of a whole data set may be left out, on average.  At 0.1 the smaller scale of what is left takes
up to 3 % of the coverage of the 95 % region away; wrong spots are farther off than either limit.
"""
_ITERATIONS = 100
_ITERATIONS_A_ROUND = 6
_ROUNDS = 40
_SELECTIONS = 10
_LEAST_TOLD = 1e-6


@dataclass(frozen=True, slots=True)
class Refined:
    """``covariance`` (13, 13) of :data:`~gripmon.laser.pointer.setup.PARAMETERS` at ``setup``; ``residuals_px``
    (n, 2) measured less predicted; ``used`` (n,); ``scale`` the residuals' standard deviation over what the spots'
    covariances say (pixels where these are the unit); ``lens`` (p,) changes of the lens's free parameters and
    ``lens_covariance`` (p, p), empty where it was held.
    """

    setup: LaserSetup
    covariance: Array
    residuals_px: Array
    used: NDArray[np.bool_]
    scale: float
    degrees_of_freedom: int
    camera: LensSettings
    lens: Array
    lens_covariance: Array

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals, u and v each."""
        return float(np.sqrt(np.mean(np.square(self.residuals_px[self.used]))))

    @property
    def scale_px(self) -> float:
        """The spots' noise, each axis, as the residuals show it."""
        freedom = max(self.degrees_of_freedom, 1)
        return self.rms_px * float(np.sqrt(2 * int(self.used.sum()) / freedom))


@dataclass(frozen=True, slots=True)
class _Loss:
    """What a spot's whitened residual costs, and what weight it has; ``scale`` one coordinate's standard deviation, by
    which what is known beforehand is weighed against the spots.
    """

    of: Callable[[Array], float]
    weights: Callable[[Array], Array]
    scale: float
    prior_factor: float


def refine(problem: SpotProblem, start: LaserSetup) -> Refined:
    """The best set-up near a start.  Raises :class:`CalibrationError` when it is not determined."""
    state = problem.start(start)
    scale = _scale(problem, state)
    for _ in range(_ROUNDS):
        state = _minimise(problem, state, _biweight(scale), _ITERATIONS_A_ROUND)
        newest = _scale(problem, state)
        if newest > 0.999 * scale:
            break
        scale = newest
    problem = problem.with_pose_noise(state)
    scale = _scale(problem, state)
    state = _minimise(problem, state, _biweight(scale), _ITERATIONS)
    scale = _scale(problem, state)
    used = problem.sizes(state) <= float(np.sqrt(chi2.isf(FALSE_OUTLIERS / len(problem), 2))) * scale
    for _ in range(_SELECTIONS):
        _check_enough(problem, used)
        state = _minimise(problem, state, _squares(scale, used), _ITERATIONS)
        scale = _scale_of(problem, state, used)
        again = _consistent(problem, state, used, scale)
        if (again == used).all():
            break
        used = again
    else:  # two sets that ask for each other: what the last fit rests on
        _check_enough(problem, used)
        state = _minimise(problem, state, _squares(scale, used), _ITERATIONS)
    return _conclude(problem, state, used)


_LEAST = 1e-9


def _consistent(problem: SpotProblem, state: State, used: NDArray[np.bool_], scale: float) -> NDArray[np.bool_]:
    """Spots (n,) that the fit to all others explains.

    A used spot pulls the fit towards itself, one that is left out doesn't: by its leverage G its residual r has the
    covariance s² (I - G) or s² (I + G).  With the scale of the others, rᵀ (I ∓ G)⁻¹ r / 2 s² follows F (Cook and
    Weisberg, 1982), and is the same whether the spot is in the fit or not.  One size and one scale for all would leave
    out twice as many good ones as it says, and make the rest look better than it is.
    """
    rows, values = problem.linearised(state)
    a, _ = _weighted(problem, state, used.astype(float), scale)
    size = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    leverage = np.linalg.pinv((a / size).T @ (a / size), hermitian=True)
    pulled = np.einsum("nip,pq,njq->nij", rows / size, leverage, rows / size)
    spread = np.eye(2) + np.where(used, -1.0, 1.0)[:, None, None] * pulled
    # A spot that determines a parameter alone fits, however wrong it is: nothing speaks against it.
    told = np.linalg.eigvalsh(spread)[:, 0] > _LEAST_TOLD
    spread[~told] = np.eye(2)
    sizes = np.where(told, np.einsum("ni,ni->n", values, np.linalg.solve(spread, values[:, :, None])[:, :, 0]), 0.0)
    whole = 2 * int(used.sum()) - len(PARAMETERS)
    freedom = np.maximum(whole - 2.0 * used, 1.0)
    variance = (whole * scale**2 - np.where(used, sizes, 0.0)) / freedom
    ratio = 0.5 * sizes / np.maximum(variance, _LEAST**2)
    limit = fisher_f.isf(FALSE_OUTLIERS / len(problem), 2, freedom)
    out: NDArray[np.bool_] = np.isfinite(problem.sizes(state)) & ((ratio <= limit) | (whole <= 2))
    return out


def _scale_of(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> float:
    """Standard deviation of one coordinate, from the used spots' residuals."""
    freedom = 2 * int(used.sum()) - len(PARAMETERS)
    return max(float(np.sqrt(np.square(problem.sizes(state)[used]).sum() / freedom)), _LEAST)


def _check_enough(problem: SpotProblem, used: NDArray[np.bool_]) -> None:
    if 2 * int(used.sum()) <= problem.unknowns:
        raise CalibrationError(
            f"{int(used.sum())} of {len(problem)} spots agree with each other; at least {problem.unknowns // 2 + 1}, "
            "better 50"
        )


def _biweight(scale: float) -> _Loss:
    reach = BIWEIGHT * scale

    def of(sizes: Array) -> float:
        share = np.minimum(sizes / reach, 1.0)
        return float((1.0 - (1.0 - share * share) ** 3).sum())

    def weights(sizes: Array) -> Array:
        out: Array = np.square(1.0 - np.square(np.minimum(sizes / reach, 1.0)))
        return out

    return _Loss(of, weights, scale, 3.0 / reach**2)


def _squares(scale: float, used: NDArray[np.bool_]) -> _Loss:
    return _Loss(lambda sizes: float(np.square(sizes[used]).sum()), lambda _: used.astype(float), scale, 1.0)


def _minimise(problem: SpotProblem, state: State, loss: _Loss, iterations: int) -> State:
    """Levenberg-Marquardt (Marquardt, 1963), columns scaled."""

    def cost_of(trial: State, sizes: Array) -> float:
        _, prior = problem.prior(trial)
        return loss.of(sizes) + loss.prior_factor * loss.scale**2 * float(prior @ prior)

    sizes = problem.sizes(state)
    cost, damping = cost_of(state, sizes), 1e-4
    for _ in range(iterations):
        a, b = _weighted(problem, state, loss.weights(sizes), loss.scale)
        size = np.maximum(np.linalg.norm(a, axis=0), 1e-12)
        a = a / size
        normal, side = a.T @ a, a.T @ b
        while damping < 1e10:
            trial = state.moved(np.linalg.solve(normal + damping * np.eye(len(size)), side) / size)
            new_sizes = problem.sizes(trial)
            new = cost_of(trial, new_sizes)
            if new < cost:
                break
            damping *= 10.0
        else:
            return state
        gain = cost - new
        state, sizes, cost, damping = trial, new_sizes, new, max(0.1 * damping, 1e-12)
        if gain <= 1e-10 * cost:
            break
    return state


def _weighted(problem: SpotProblem, state: State, weights: Array, scale: float) -> tuple[Array, Array]:
    """Rows and residuals of spots and of what is known beforehand, in the spots' unit."""
    rows, values = problem.linearised(state)
    root = np.sqrt(weights)[:, None]
    prior_rows, prior_values = problem.prior(state)
    a = np.concatenate([(rows * root[:, :, None]).reshape(-1, problem.unknowns), scale * prior_rows])
    return a, np.concatenate([(values * root).ravel(), scale * prior_values])


def _conclude(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> Refined:
    freedom = 2 * int(used.sum()) - len(PARAMETERS)
    scale = _scale_of(problem, state, used)
    a, _ = _weighted(problem, state, used.astype(float), scale)
    size = np.linalg.norm(a, axis=0)
    singular = np.linalg.svd(a / np.maximum(size, 1e-300), compute_uv=False)
    if not size.all() or singular[-1] < 1e-8 * singular[0]:
        raise CalibrationError(
            "the spots don't tell all of camera, plane and laser; more orientations, turned about two axes or more"
        )
    covariance = scale**2 * np.linalg.inv((a / size).T @ (a / size)) / np.outer(size, size)
    k = len(PARAMETERS)
    return Refined(
        state.setup, covariance[:k, :k], problem.residuals_px(state), used, scale, freedom,
        problem.camera(state).settings, state.lens, covariance[k:, k:],
    )  # fmt: skip


def _scale(problem: SpotProblem, state: State) -> float:
    """Standard deviation of one coordinate, from lengths of pairs: their median is 1.1774 of it, less what the
    parameters take of the noise.
    """
    middle = float(np.median(problem.sizes(state)))
    if not np.isfinite(middle):
        raise CalibrationError("most spots don't lie before the camera; poses and spots of one set-up")
    left = max(1.0 - len(PARAMETERS) / (2.0 * len(problem)), 0.25)
    return max(middle / (1.1774 * float(np.sqrt(left))), _LEAST)
