"""How well models explain the same stretches of edges: marginal likelihoods in Laplace's approximation.

Every model has the same unknowns; what it doesn't free is held by what is known (the calibration's error, the error of
the reported opening), and what it frees has a normal prior of a size that is itself unknown: an average over sizes
from the smallest worth telling to the largest believed.  A model with more freedom spreads its prior over more that
could have been seen, and so pays for what it doesn't need (MacKay 1992, "Bayesian interpolation").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.causes.state import EdgeView, State
from gripmon.gripper import Gripper
from gripmon.records import Array

_ROUNDS = 6
_CONVERGED_PX = 1e-3


@dataclass(frozen=True, slots=True)
class Model:
    """``held`` (m,): standard deviations of the unknowns by what is known; ``freed`` (m,): of those that the model
    frees, for a motion of size 1, zero for the others; ``sizes`` (n,): sizes that are equally probable.
    """

    held: Array
    freed: Array
    sizes: Array

    def precision(self, size: float) -> Array:
        """(m,) of the prior; infinite where an unknown doesn't move."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (self.held**2 + (size * self.freed) ** 2))


@dataclass(frozen=True, slots=True)
class Weighed:
    """``log_evidence`` up to a constant that all models of a frame share; the state that fits best, how far it is
    from the model's start (m,), and the residual (s,) in px that it leaves.
    """

    log_evidence: float
    state: State
    motion: Array
    residual_px: Array


def weigh(
    view: EdgeView, gripper: Gripper, model: Model, start: State, first: State, bias_px: Array, weight: Array
) -> Weighed:
    """Evidence of a model whose prior is centred on the state ``start``; the fit begins at ``first``.

    ``bias_px`` (s,) is what residuals were when all was well; ``weight`` (s, s) the inverse of their covariance.
    """
    largest = model.precision(float(model.sizes.max(initial=0.0)))
    free = np.flatnonzero(np.isfinite(largest))
    state = first
    for _ in range(_ROUNDS):
        residual, jacobian = view.residual(state)
        residual = residual - bias_px
        jacobian = jacobian[:, free]
        motion = state.since(start)
        step = _step(jacobian, weight, residual, motion[free], largest[free])
        full = np.zeros(len(largest))
        full[free] = step
        state = state.moved(full, gripper)
        if float(np.abs(jacobian @ step).max(initial=0.0)) < _CONVERGED_PX:
            break
    residual, jacobian = view.residual(state)
    residual, jacobian, motion = residual - bias_px, jacobian[:, free], state.since(start)
    terms = [
        _log_evidence(jacobian, weight, residual, motion[free], model.precision(size)[free])
        for size in (model.sizes if len(model.sizes) else np.zeros(1)).tolist()
    ]
    return Weighed(float(np.logaddexp.reduce(terms)) - float(np.log(len(terms))), state, motion, residual)


def _step(jacobian: Array, weight: Array, residual: Array, motion: Array, precision: Array) -> Array:
    normal = jacobian.T @ weight @ jacobian + np.diag(precision)
    return np.linalg.solve(normal, jacobian.T @ (weight @ residual) - precision * motion)


def _log_evidence(jacobian: Array, weight: Array, residual: Array, motion: Array, precision: Array) -> float:
    """Of the linearised model: the prior's best point, its height, and how much of the prior's volume agrees."""
    weighted = weight @ jacobian
    normal = jacobian.T @ weighted + np.diag(precision)
    step = np.linalg.solve(normal, weighted.T @ residual - precision * motion)
    rest, there = residual - jacobian @ step, motion + step
    height = float(rest @ weight @ rest) + float(precision @ there**2)
    # det(N + P) / det(P), from the scaled matrix: P spans twenty orders of magnitude.
    scale = 1.0 / np.sqrt(precision)
    occam = float(np.linalg.slogdet(normal * np.outer(scale, scale))[1])
    return -0.5 * (height + occam)


def covariance_px2(edge: NDArray[np.intp], sigma_px: Array, spread_px: Array) -> Array:
    """(s, s) of the pieces' places: their own scatter, and what a whole edge is off by."""
    out = (edge[:, None] == edge[None, :]) * np.outer(spread_px, spread_px)
    out[np.diag_indices(len(edge))] += sigma_px**2
    return np.asarray(out)
