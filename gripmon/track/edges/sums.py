"""What the edge points of one measurement say beside the pose that they agreed on."""

from __future__ import annotations

import numpy as np

from gripmon.model.geometry import perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, EdgeSums
from gripmon.track.edges.settling import Measurement


def edge_sums(measurement: Measurement, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float) -> EdgeSums:
    """Sums over the stretches of agreed points, with residuals about a pose and opening near the measured ones."""
    prediction, candidates, consensus = measurement.prediction, measurement.candidates, measurement.consensus
    inlier = np.flatnonzero(consensus.weight)
    sample, weight = candidates.sample[inlier], consensus.weight[inlier]
    jacobian = prediction.jacobian[sample]
    unknowns = perturbation_between(prediction.cam_T_grip, cam_T_grip)
    if jacobian.shape[1] == 7:
        unknowns = np.append(unknowns, jaw_opening_m - prediction.jaw_opening_m)
    residual_px = candidates.offset_px[inlier] - jacobian @ unknowns
    jacobian = jacobian[:, :6]
    layout = prediction.layout
    stretch = layout.stretch[sample]
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    edge = layout.edge[sample][first]
    from_end = layout.stretch[layout.first[np.searchsorted(layout.edges, edge)]]
    total = np.add.reduceat(weight, first) if len(first) else np.zeros(0)
    weighted = jacobian * weight[:, None]
    products = weighted[:, :, None] * jacobian[:, None, :]

    def sums(values: Array) -> Array:
        return np.add.reduceat(values, first, axis=0) if len(first) else values

    return EdgeSums(
        edge,
        gripper.edge_finger[edge],
        stretch[first] - from_end,
        total,
        sums(weight * residual_px) / total,
        sums(weighted) / total[:, None],
        sums(weighted * residual_px[:, None]),
        sums(products),
        prediction.bevel_px[edge],
    )
