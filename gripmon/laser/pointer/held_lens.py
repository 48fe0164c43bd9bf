"""A lens that is held isn't exact: what its own calibration leaves open comes into a set-up's covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gripmon.laser.pointer.refinement import Refined
from gripmon.laser.pointer.setup import PARAMETERS
from gripmon.laser.pointer.spot_problem import LensPrior, SpotProblem
from gripmon.model.records import Array


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
