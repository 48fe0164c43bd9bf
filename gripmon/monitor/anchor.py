"""Where the gripper has proved to be: the average of the poses that did, once under each thing that may have been wrong
all along.

An edge that has belonged to something else since the first frame bends the average, too, so that the average is kept
without it as well: each hypothesis has a Kalman filter of its own (a bank of filters, as for solution separation over
time).  Frames err together before a background that stands still: what their scatter doesn't show stays in the
average's covariance, as in :mod:`gripmon.judge.smoothing`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.smoothing import LEAST_KEPT, MOST_SCATTER
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array
from gripmon.monitor.refits import INFLATION, Refits, of_fingers
from gripmon.track.integrity import Doubts, Hypotheses

PRIOR_FRAMES, SCATTER_FRAMES = 10.0, 40.0
"""So many frames the belief is worth that errors don't scatter at all, and so many are remembered."""

UNUSUAL = 12.6
"""Squared normalised distance that six normal errors exceed once in twenty times (chi-square)."""

DISPLACED = 33.1
"""The same that they exceed once in 100,000 times."""

LEAST_YOUNG = 0.2
"""Least variance of the average over that of a frame: it has to follow a creep, and more than five frames would take
little more off than is believed of any average.
"""

CONFIRMED = 5
"""Further frames that have to prove a place after a knock in full."""

NOTHING, UNKNOWN = -1, 1e12
"""Stands for no fit, and the factor on another one's covariance that makes it tell nothing."""


class Lasting(NamedTuple):
    """What may have been wrong all along: g hypotheses about all of a gripper's edges with their ``name`` and ``prior``
    (g,), and ``doubted``, the edges that each doubts; an opening that is doubted counts as one more edge.
    """

    name: tuple[str, ...]
    prior: Array
    doubted: tuple[frozenset[int], ...]

    @classmethod
    def of(cls, every: Hypotheses) -> Lasting:
        """Those of hypotheses about all edges that don't begin at some moment."""
        rows = np.flatnonzero(~every.sudden)
        doubted = _doubted(every, np.arange(every.keep.shape[1]))
        return cls(tuple(every.name[k] for k in rows), every.prior[rows], tuple(doubted[k] for k in rows))

    def rows(self, hypotheses: Hypotheses, edges: NDArray[np.intp]) -> NDArray[np.intp]:
        """(g,) which of some hypotheses about the seen ``edges`` (v,) each of these is; -1 where nothing of what is
        seen is beyond its doubt.
        """
        number = {doubted: k for k, doubted in reversed([*enumerate(_doubted(hypotheses, edges))])}
        known = frozenset[int]().union(*number)
        return np.array([number.get(doubted & known, NOTHING) for doubted in self.doubted], dtype=np.intp)


def _doubted(hypotheses: Hypotheses, edges: NDArray[np.intp]) -> list[frozenset[int]]:
    own = [frozenset(edges[keep == 0.0].tolist()) for keep in hypotheses.keep]
    for number in np.flatnonzero(hypotheses.opening).tolist():
        own[number] = frozenset([-1])
    return own


class Anchor:
    """The average of poses that proved themselves, from the first one on."""

    def __init__(
        self, lasting: Lasting, base_T: Array, fits: Refits, rows: NDArray[np.intp], now_s: float, knocked: bool = False
    ):
        """``knocked``: the first pose stands elsewhere than before."""
        self._lasting, self._base_T, self.now_s = lasting, base_T, now_s
        self._to_confirm = CONFIRMED if knocked else 0
        self._shift, self._filter, self._of_model = _chosen(fits, rows, base_T)
        self._frames_variance = np.einsum("hii->hi", self._filter).copy()
        self._scatter = np.zeros((len(rows), 6))
        self._weight = PRIOR_FRAMES
        self._conclude()

    @property
    def confirmed(self) -> bool:
        """Whether so many frames have proved the place that a further one needs to prove less."""
        return self._to_confirm <= 0

    def add(self, fits: Refits, rows: NDArray[np.intp], creep: Array, now_s: float) -> None:
        """One more proven pose, by its frame's fits; ``rows`` (g,) of those; ``creep`` (6,) variances of the way since
        the last.
        """
        self.now_s = now_s
        self._to_confirm -= 1
        shift, covariance, of_model = _chosen(fits, rows, self._base_T)
        self._filter[:, range(6), range(6)] += creep
        innovation = shift - self._shift
        gain = np.linalg.solve(self._filter + covariance, self._filter).transpose(0, 2, 1)
        self._shift = self._shift + np.einsum("hij,hj->hi", gain, innovation)
        self._of_model = self._of_model + np.einsum("hij,hfj->hfi", gain, of_model - self._of_model)
        left = self._filter - gain @ self._filter
        self._filter = 0.5 * (left + left.transpose(0, 2, 1))
        variance = np.einsum("hii->hi", covariance)
        share = np.minimum(innovation**2 / (variance + np.einsum("hii->hi", self._filter)), MOST_SCATTER)
        self._weight = min(self._weight + 1.0, SCATTER_FRAMES)
        self._scatter += (share - self._scatter) / self._weight
        # A frame that leaves a direction open says little of what frames usually tell.
        worth = np.minimum((self._frames_variance / variance).min(axis=1), 1.0)
        usual = worth**2 * np.einsum("hii->h", gain) / 6.0
        self._frames_variance += usual[:, None] * (variance - self._frames_variance)
        self._conclude()

    def _conclude(self) -> None:
        young = np.einsum("hii->hi", self._filter) / self._frames_variance
        scale = np.sqrt(np.maximum(LEAST_YOUNG / young, 1.0))
        self._filter *= scale[:, :, None] * scale[:, None, :]
        young = np.clip(young, LEAST_YOUNG, 1.0)
        # Of errors that last, averaging takes away less than of independent ones.
        kept = np.maximum(1.0 - (1.0 - np.sqrt(young)) * self._scatter, LEAST_KEPT * self._scatter)
        scale = np.sqrt(kept / young)
        self._covariance = self._filter * (scale[:, :, None] * scale[:, None, :])
        self.cam_T_grip = perturb(self._base_T, self._shift[0])
        self.covariance = self._covariance[0]
        self.of_model = self._of_model[0]

    def doubts(self, cam_T_grip: Array, fits: Refits, rows: NDArray[np.intp], wander: Array) -> Doubts:
        """What may have been wrong all along with a pose (4, 4) that a frame's ``fits`` gave, ``rows`` (g,) of those,
        ``wander`` (6,) being the variance of the way that the gripper may have gone since.

        Under each hypothesis either the average or the frame tells: which knows more, but the frame where they differ.
        """
        away = self._shift - perturbation_between(self._base_T, cam_T_grip)
        covariance = self._covariance + np.diag(wander / INFLATION**2)
        shift, own, of_model = _chosen(fits, rows, cam_T_grip)
        apart = shift - away
        both = np.linalg.solve(own + covariance, apart[:, :, None])[:, :, 0]
        frame = np.einsum("hi,hi->h", apart, both) > DISPLACED
        frame |= np.einsum("hii->h", own[:, :3, :3]) < np.einsum("hii->h", covariance[:, :3, :3])
        away = np.where(frame[:, None], shift, away)
        covariance = np.where(frame[:, None, None], own, covariance)
        of_model = np.where(frame[:, None, None], of_model, self._of_model)
        covariance += of_fingers(of_model) / INFLATION**2
        return Doubts.of(self._lasting.name, self._lasting.prior, away, covariance, INFLATION)


def _chosen(fits: Refits, rows: NDArray[np.intp], base_T: Array) -> tuple[Array, Array, Array]:
    """Shift (g, 6) from a pose (4, 4), covariance (g, 6, 6) and model's error (g, f, 6) of the fits ``rows`` (g,)."""
    covariance = fits.free_covariance()[rows]
    covariance[rows == NOTHING] *= UNKNOWN
    return fits.shifts(base_T)[rows], covariance, fits.of_model[rows]
