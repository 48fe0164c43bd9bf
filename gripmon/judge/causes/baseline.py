"""How the edges show while all is well: the calibration's error, and what the gripper model doesn't say.

Like is compared with like: a bevel, a shade or a reference that is off by a tenth of a millimetre shifts the edges
before and after alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.causes.pooling import PIECES, Pooled
from gripmon.judge.causes.state import JAW, POSE, State
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class Baseline:
    """``motion`` (m,) of the unknowns from the reference; ``bias_px`` of each piece of an edge beyond that, and
    ``sigma_px`` of it, both (pieces,), NaN where none was seen; the openings that were reported and seen then;
    ``ends``, blur, noise, ``steepest``, ``cells`` and ``wander`` as in :class:`Pooled`.
    """

    motion: Array
    bias_px: Array
    sigma_px: Array
    jaw_reported_m: float | None
    jaw_opening_m: float
    ends: NDArray[np.bool_]
    blur_px2: float | None
    noise: float
    steepest: float
    cells: Array
    wander: Array

    @classmethod
    def of(cls, pooled: Pooled, motion: Array, residual_px: Array, edges: int) -> Baseline:
        bias_px, sigma_px = np.full(edges * PIECES, np.nan), np.full(edges * PIECES, np.nan)
        bias_px[pooled.piece], sigma_px[pooled.piece] = residual_px, pooled.evidence.sigma_px
        then = pooled.evidence
        image = pooled.ends, pooled.blur_px2, pooled.noise, pooled.steepest, pooled.cells, pooled.wander
        return cls(motion, bias_px, sigma_px, then.jaw_reported_m, then.jaw_opening_m, *image)

    def start(self, state: State, reported: bool, gripper: Gripper) -> State:
        """Where everything stands if nothing has moved; ``state``: if the reference and the report are right."""
        motion = np.zeros_like(self.motion)
        motion[POSE] = self.motion[POSE]
        if reported:
            motion[JAW] = self.motion[JAW]
        return state.moved(motion, gripper)

    def known(self, piece: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(s,) whether pieces were seen."""
        return np.isfinite(self.bias_px[piece])

    def bias_of(self, piece: NDArray[np.intp]) -> tuple[Array, Array]:
        """(s,) bias and its standard deviation in px; of a piece that wasn't seen that of its edge, else zero."""
        bias_px, sigma_px = self.bias_px[piece], self.sigma_px[piece]
        by_edge = self.bias_px.reshape(-1, PIECES)
        for k in np.flatnonzero(~np.isfinite(bias_px)):
            own = by_edge[piece[k] // PIECES]
            own = own[np.isfinite(own)]
            bias_px[k], sigma_px[k] = (float(np.median(own)), 0.0) if len(own) else (0.0, 0.0)
        return bias_px, sigma_px
