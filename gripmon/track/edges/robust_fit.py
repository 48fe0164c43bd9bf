"""Step 4 of the corner measurement: one robust fit of all edge candidates in the six parameters of the motion.

Lines that are fitted one by one lock onto straight edges of the background; a rigid gripper leaves only six ways to
be wrong. Candidates vote with Tukey's biweight about a hypothesis; hypotheses come from the prediction or, after a
jump, from a grid of starts. The residual of a candidate is its offset along the profile minus ``jacobian @ xi``, in
px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.track.edges import kernel
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.settings import RobustFitSettings

GATE_PX = 0.5
"""A profile supports a fit if a candidate lies this close to it (px of the zoomed image)."""

RESTART_WIDTH_PX = 0.4
"""Width of the robust weight at a start that is nearly right, px."""

NOT_SOLVED = "the normal matrix of the joint fit is not positive definite"

ROUNDS = 6
_ROUNDS_AGAIN = ROUNDS // 2  # from a start that is nearly right


@dataclass(frozen=True, slots=True)
class Prior:
    """What holds the unknowns (m,) before the image is seen: ``mean`` relative to the prediction, ``information`` in
    1/m², 1/rad².
    """

    mean: Array
    information: Array


@dataclass(frozen=True, slots=True)
class RobustFit:
    """The common motion of the edge candidates.

    ``xi`` (m,) relative to the prediction's pose, m = 6, or 7 with the jaw opening; ``weight`` (k,) per candidate in
    1/px², zero for those that don't belong, each edge's together limited by what its points share; ``information``
    (m, m) of the edge points alone; ``spread_px`` robust size of the residuals, ``stiffness`` see :func:`_stiffness`;
    ``supported`` (n,) whether a profile agrees; for all edges of the gripper ``edge_share``
    (e,) share of its profiles that agree and ``edge_seen`` (e,).  ``share``: part of all pairs of neighbouring
    profiles in which both agree, on edges that are seen; zero with fewer than three such edges.
    """

    xi: Array
    weight: Array
    residual_px: Array
    information: Array
    spread_px: float
    stiffness: float
    supported: NDArray[np.bool_]
    edge_share: Array
    edge_seen: NDArray[np.bool_]
    share: float


def fit_irls(
    edgels: Edgels, prior: Prior, start: Array, settings: RobustFitSettings, width_px: float | None = None
) -> RobustFit:
    """Robust fit from one start (m,): iteratively re-weighted, the width shrinking from ``width_px`` (if None, from the
    settings' ``start_width_px``) to what each candidate's own standard deviation and the measured scatter allow.

    With fewer candidates than unknowns the fit stays at the start and supports nothing.
    """
    candidates, prediction = edgels.candidates, edgels.prediction
    solved, fitted = kernel.fit(
        candidates.sample,
        candidates.offset_px,
        edgels.weight,
        prediction.jacobian,
        prediction.layout.edge,
        prediction.ok,
        prediction.independence,
        edgels.edge_spread_px,
        prior.mean,
        prior.information,
        start,
        settings.start_width_px if width_px is None else width_px,
        ROUNDS if width_px is None else _ROUNDS_AGAIN,
        settings.start_width_px,
        GATE_PX * candidates.zoom,
        settings.support_sigmas,
        settings.support_share,
    )
    if not solved:
        raise FloatingPointError(NOT_SOLVED)
    return RobustFit(*fitted)


def refit_visible(
    edgels: Edgels, prior: Prior, consensus: RobustFit, settings: RobustFitSettings
) -> tuple[Edgels, RobustFit]:
    """The fit again without the edges that chance supports as well: what lies near them is background."""
    edges = edgels.prediction.layout.edges
    seen = consensus.edge_seen
    if seen[edges].all() or np.count_nonzero(seen) < FEWEST_EDGES:
        return edgels, consensus
    edge = edgels.prediction.layout.edge[edgels.candidates.sample]
    rest = replace(edgels, weight=np.where(seen[edge], edgels.weight, 0.0))
    return rest, fit_irls(rest, prior, consensus.xi, settings, RESTART_WIDTH_PX)


def fit_irls_from_grid(
    edgels: Edgels, prior: Prior, starts: Array, settings: RobustFitSettings, refine: int = 6
) -> RobustFit:
    """Best fit from many starts (g, m): all are scored by the candidates near them, the best few refined."""
    candidates = edgels.candidates
    jacobian = edgels.prediction.jacobian[candidates.sample].T
    active = edgels.weight > 0.0
    distance = (candidates.offset_px - starts @ jacobian) * (1.0 / settings.start_width_px)
    np.square(distance, out=distance)
    np.subtract(1.0, distance, out=distance)
    np.maximum(distance, 0.0, out=distance)
    best = np.argsort(-(distance @ active.astype(float)), kind="stable")[:refine]
    return max((fit_irls(edgels, prior, starts[i], settings) for i in best), key=lambda fit: fit.share)


def grid_of_starts(prediction: Prediction, reach_px: float, step_px: float) -> Array:
    """Starts (g, m) that shift the image by a grid of ``step_px``, turn it and scale it: the motions that a camera
    shows at first order.

    Expressed as translations of the gripper across the axis, rotation about the optical axis, and translation along it.
    """
    corners_m = prediction.corners.cam_m
    depth_m = float(corners_m[:, 2].mean()) if len(corners_m) else float(prediction.cam_T_grip[2, 3])
    span_px = float(np.abs(prediction.uv_px - prediction.uv_px.mean(axis=0)).max())
    ticks = np.arange(-round(reach_px / step_px), round(reach_px / step_px) + 1) * step_px
    turns = np.array([-1.0, 0.0, 1.0]) * 0.6 * reach_px / span_px
    dx, dy, scale, turn = (a.ravel() for a in np.meshgrid(ticks, ticks, turns, turns, indexing="ij"))
    starts = np.zeros((len(dx), prediction.jacobian.shape[1]))
    starts[:, 0], starts[:, 1] = dx / prediction.pixels_per_m, dy / prediction.pixels_per_m
    starts[:, 2] = scale * depth_m
    starts[:, 5] = turn
    return starts


VAGUE_M, VAGUE_RAD = 0.1, 1.0
"""Standard deviations of a pose of which nothing is known."""


def prior_information(jaw_sigma_m: float | None) -> Array:
    """Prior information (m,): far below what any usable view gives, it only keeps a view without information solvable.

    With a ``jaw_sigma_m`` the jaw opening is the seventh unknown, and the reported one is worth that standard
    deviation (at least a micrometre, which stands for "exact").
    """
    pose = [VAGUE_M**-2] * 3 + [VAGUE_RAD**-2] * 3
    return np.array(pose if jaw_sigma_m is None else [*pose, max(jaw_sigma_m, 1e-6) ** -2])
