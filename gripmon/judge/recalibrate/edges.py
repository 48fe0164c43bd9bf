"""How well the edges of many frames together support the tracked pose: edge by edge, and finger by finger."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from gripmon.judge.recalibrate.stills import StillFrame
from gripmon.model.geometry import perturbation_between
from gripmon.model.records import Array, EdgeSums
from gripmon.track.edges.kernel import FEWEST_FREE

STRETCH_PX, EDGE_PX = 0.015, 0.03
"""Standard deviations of lasting errors without a known cause, px: of a stretch's mean, and of a whole edge."""

WORST_CONDITION = 1e10
"""Condition number of an information matrix, its unknowns scaled alike, from which it determines no pose."""

_SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # m per rad: about equal motions in the image


@dataclass(frozen=True, slots=True)
class PooledEdges:
    """Stretches of edges summed over all frames, with residuals about one pose; fields as in
    :class:`~gripmon.model.records.EdgeSums`.  ``sigma_px`` (s,) is the standard deviation of a stretch's own error,
    ``shared_px`` (s,) that of the error it shares with the other stretches of its edge.
    """

    edge: NDArray[np.intp]
    finger: NDArray[np.intp]
    residual_px: Array
    jacobian: Array
    sigma_px: Array
    shared_px: Array
    moment: Array
    information: Array


def pool(frames: list[StillFrame], cam_T_grip: Array) -> PooledEdges:
    """Sum the stretches seen in at least half of the frames, with residuals about ``cam_T_grip`` (4, 4)."""
    number, index = np.zeros(0), np.zeros(0, dtype=np.intp)
    vector = np.zeros((0, 6))
    nothing = EdgeSums(index, index, index, number, number, vector, vector, np.zeros((0, 6, 6)), number)
    shown = [nothing, *(_about(f, f.edges, cam_T_grip) for f in frames if f.edges is not None)]

    def all_of(field: str) -> Array:
        return np.concatenate([getattr(e, field) for e in shown])

    names = np.stack([all_of("edge"), all_of("finger"), all_of("stretch")], axis=1)
    keys, place, count = np.unique(names, axis=0, return_inverse=True, return_counts=True)
    often = count >= 0.5 * len(frames)

    def total(values: Array) -> Array:
        sums = np.zeros((len(keys), *values.shape[1:]))
        np.add.at(sums, place, values)
        return sums[often]

    weights = all_of("weight")
    weight, spread_px = total(weights), total(all_of("spread_px")) / count[often]
    return PooledEdges(
        keys[often, 0].astype(np.intp),
        keys[often, 1].astype(np.intp),
        total(weights * all_of("residual_px")) / weight,
        total(weights[:, None] * all_of("jacobian")) / weight[:, None],
        # The lasting part of a stretch's error is that of one frame, however many frames there are.
        np.sqrt(STRETCH_PX**2 + count[often] / weight),
        np.hypot(EDGE_PX, spread_px),
        total(all_of("moment")),
        total(all_of("information")),
    )


def _about(frame: StillFrame, evidence: EdgeSums, cam_T_grip: Array) -> EdgeSums:
    """A frame's edge sums with residuals about another pose close to its own."""
    xi = perturbation_between(frame.cam_T_grip, cam_T_grip)
    return replace(
        evidence,
        residual_px=evidence.residual_px - evidence.jacobian @ xi,
        moment=evidence.moment - evidence.information @ xi,
    )


def leave_one_out(pooled: PooledEdges) -> Array:
    """Covariance (6, 6) of the pose by the jackknife (Tukey 1958): how much it moves when each edge is left out.
    1 m² and 1 rad² on the diagonal, as good as unknown, where the other edges don't determine a pose.
    """
    edges = np.unique(pooled.edge)
    information = pooled.information * np.outer(_SCALE, _SCALE)
    moment = pooled.moment * _SCALE
    total, pull = information.sum(axis=0), moment.sum(axis=0)
    if len(edges) < 2 or not np.linalg.cond(total) < WORST_CONDITION:
        return np.eye(6)
    whole = np.linalg.solve(total, pull)
    covariance = np.zeros((6, 6))
    for edge in edges.tolist():
        own = pooled.edge == edge
        rest = total - information[own].sum(axis=0)
        if not np.linalg.cond(rest) < WORST_CONDITION:
            return np.eye(6)
        moved = _SCALE * (np.linalg.solve(rest, pull - moment[own].sum(axis=0)) - whole)
        covariance += np.outer(moved, moved)
    return covariance * (len(edges) - 1) / len(edges)


def fingers_disagree(pooled: PooledEdges) -> float | None:
    """p-value of the hypothesis that the fingers belong together: by an F-test, does one finger free of the others (six
    more unknowns) explain the residuals so much better?  The smallest of all fingers; None where fewer than two fingers
    or too few stretches are seen.

    The errors of an edge's stretches are correlated.  If they are larger than :data:`STRETCH_PX` and :data:`EDGE_PX`,
    the ratio of residuals alone decides.
    """
    fingers = np.unique(pooled.finger)
    if len(fingers) < 2:
        return None
    whitening = _whitening(pooled)
    jacobian, residual = whitening @ (pooled.jacobian * _SCALE), whitening @ pooled.residual_px
    left, rank = _left(jacobian, residual)
    chances = []
    for finger in fingers[1:].tolist():
        own = (pooled.finger == finger)[:, None]
        less, more = _left(np.hstack([jacobian, whitening @ (pooled.jacobian * _SCALE * own)]), residual)
        free = len(residual) - more
        if free >= FEWEST_FREE and more > rank:
            ratio = ((left - less) / (more - rank)) / max(less / free, 1.0)
            chances.append(float(fdtrc(more - rank, free, ratio)))
    return min(chances, default=None)


def _whitening(pooled: PooledEdges) -> Array:
    """Matrix (s, s) that makes the stretches' errors independent, with variance one."""
    together = (pooled.edge[:, None] == pooled.edge) * np.outer(pooled.shared_px, pooled.shared_px)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(together + np.diag(pooled.sigma_px**2))))


def _left(unknowns: Array, values: Array) -> tuple[float, int]:
    """Sum of squared residuals of a least-squares fit, and the number of unknowns that it determines."""
    fit, _, rank, _ = np.linalg.lstsq(unknowns, values, rcond=1e-6)
    rest = values - unknowns @ fit
    return float(rest @ rest), int(rank)
