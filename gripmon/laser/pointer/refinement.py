"""All parameters of a laser set-up at once: the least distance between measured and predicted spots in the image.

Equation (35) of the laser-pointer method, with an analytic Jacobian.  Wrong spots (speckle,
reflections) get no weight where they contradict the rest: Tukey's biweight on a robust scale that shrinks with the
residuals; at the end those beyond what noise explains are left out, and the rest counts in full.  (The print keeps the
50 nearest of 90, however many are wrong.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as fisher_f

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.setup import PARAMETERS, LaserSetup
from gripmon.laser.pointer.spot_problem import LensPrior, SpotProblem, State
from gripmon.model.camera import LensSettings
from gripmon.model.least_squares import (
    TUKEY,
    Equations,
    covariance_of,
    minimise,
    normal_equations,
    robust_scale,
    tukey_cost,
    tukey_weights,
)
from gripmon.model.records import Array

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
class _Tukey:
    """What whitened residuals cost, and their weights; ``scale`` is one coordinate's standard deviation, by which prior
    knowledge is weighed against the spots.
    """

    scale: float

    def cost(self, sizes: Array) -> float:
        return tukey_cost(sizes, TUKEY * self.scale)

    def weights(self, sizes: Array) -> Array:
        return tukey_weights(sizes, TUKEY * self.scale)


@dataclass(frozen=True, slots=True)
class _Squares:
    """As :class:`_Tukey`: the ``used`` spots (n,) count in full, the others not at all."""

    scale: float
    used: NDArray[np.bool_]

    def cost(self, sizes: Array) -> float:
        return float(np.square(sizes[self.used]).sum())

    def weights(self, _sizes: Array) -> Array:
        return self.used.astype(float)


def refine(problem: SpotProblem, start: LaserSetup) -> Refined:
    """The best set-up near a start.  Raises :class:`CalibrationError` when it is not determined."""
    state = problem.start(start)
    scale = _scale(problem, state)
    for _ in range(_ROUNDS):
        state = _minimise(problem, state, _Tukey(scale), _ITERATIONS_A_ROUND)
        newest = _scale(problem, state)
        if newest > 0.999 * scale:
            break
        scale = newest
    problem = problem.with_pose_noise(state)
    scale = _scale(problem, state)
    state = _minimise(problem, state, _Tukey(scale), _ITERATIONS)
    scale = _scale(problem, state)
    used = problem.sizes(state) <= float(np.sqrt(chi2.isf(FALSE_OUTLIERS / len(problem), 2))) * scale
    for _ in range(_SELECTIONS):
        _check_enough(problem, used)
        state = _minimise(problem, state, _Squares(scale, used), _ITERATIONS)
        scale = _scale_of(problem, state, used)
        again = _consistent(problem, state, used, scale)
        if (again == used).all():
            break
        used = again
    else:  # two sets that ask for each other: what the last fit rests on
        _check_enough(problem, used)
        state = _minimise(problem, state, _Squares(scale, used), _ITERATIONS)
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
    normal, _ = _equations(problem, state, _Squares(scale, used))
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    leverage = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
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


def _minimise(problem: SpotProblem, state: State, loss: _Tukey | _Squares, iterations: int) -> State:
    def cost(at: State) -> float:
        return loss.cost(problem.sizes(at)) + loss.scale**2 * float(np.square(problem.prior(at)[1]).sum())

    def equations(at: State) -> Equations:
        return _equations(problem, at, loss)

    return minimise(state, cost, equations, State.moved, iterations=iterations).state


def _equations(problem: SpotProblem, state: State, loss: _Tukey | _Squares) -> Equations:
    """Of spots and of what is known beforehand, in the spots' unit."""
    rows, values = problem.linearised(state)
    spots = normal_equations(rows, values, loss.weights(np.linalg.norm(values, axis=1)))
    prior = normal_equations(*problem.prior(state))
    return spots[0] + loss.scale**2 * prior[0], spots[1] + loss.scale**2 * prior[1]


def _conclude(problem: SpotProblem, state: State, used: NDArray[np.bool_]) -> Refined:
    freedom = 2 * int(used.sum()) - len(PARAMETERS)
    scale = _scale_of(problem, state, used)
    normal, _ = _equations(problem, state, _Squares(scale, used))
    try:
        covariance = covariance_of(normal, scale**2)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the spots don't tell all of camera, plane and laser; more orientations, turned about two axes or more"
        ) from None
    k = len(PARAMETERS)
    return Refined(
        state.setup, covariance[:k, :k], problem.residuals_px(state), used, scale, freedom,
        problem.camera(state).settings, state.lens, covariance[k:, k:],
    )  # fmt: skip


def _scale(problem: SpotProblem, state: State) -> float:
    """Standard deviation of one coordinate, less what the parameters take of the noise."""
    scale = robust_scale(problem.sizes(state), 2)
    if not np.isfinite(scale):
        raise CalibrationError("most spots don't lie before the camera; poses and spots of one set-up")
    left = max(1.0 - len(PARAMETERS) / (2.0 * len(problem)), 0.25)
    return max(scale / float(np.sqrt(left)), _LEAST)


def with_held_lens(refined: Refined, problem: SpotProblem, lens: LensPrior) -> Refined:
    """``refined``, which held the lens that is its ``problem``'s prior: its ``covariance`` grows by what an error of
    the lens does to the solution, to first order ("consider" parameters; Schmidt, 1966).  The set-up stays as it is.
    """
    by_lens = _by_lens(refined, problem)
    return replace(refined, covariance=refined.covariance + by_lens @ lens.covariance @ by_lens.T)


def _by_lens(refined: Refined, problem: SpotProblem) -> Array:
    """(13, p): least squares' answer to a change of the lens's free parameters."""
    state = problem.start(refined.setup)
    rows, _ = problem.with_pose_noise(state).linearised(state)
    rows = rows[refined.used].reshape(-1, problem.unknowns)
    own, lens = rows[:, : len(PARAMETERS)], rows[:, len(PARAMETERS) :]
    size = np.linalg.norm(own, axis=0)
    out: Array = -np.linalg.lstsq(own / size, lens, rcond=None)[0] / size[:, None]
    return out
