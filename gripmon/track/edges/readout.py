"""Further results of a measurement: sums for a new reference, pixels for display."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, EdgeSums, MeasurementTrace
from gripmon.track.edges.settling import Measurement


def edge_sums(measurement: Measurement, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float) -> EdgeSums:
    """Sums over the stretches of inlier edgels, with residuals about a pose and opening near the measured ones."""
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


def trace_of(measurement: Measurement, camera: Camera, gripper: Gripper) -> MeasurementTrace:
    """Measured edge points and the model drawn at the measured pose, in pixels of the distorted image."""
    prediction, candidates, consensus = measurement.prediction, measurement.candidates, measurement.consensus
    sample = candidates.sample
    points_grip_m = gripper.points_grip_m(measurement.jaw_opening_m if gripper.has_jaw else None)
    points_cam_m = points_grip_m @ measurement.cam_T_grip[:3, :3].T + measurement.cam_T_grip[:3, 3]
    visible = np.flatnonzero(prediction.layout.visible)
    lines_m = gripper.outlines_m(points_cam_m, visible, 33, measurement.cam_T_grip[:3, :3])
    # All at once: this is called while the next frame may be waiting.
    lines = camera.project(lines_m.reshape(-1, 3)).reshape(len(visible), -1, 2)
    finite = np.asarray(np.isfinite(lines).all(axis=2))
    corners_uv_px = camera.project(points_cam_m[gripper.corner_points])
    corners_uv_px[~prediction.corners.visible] = np.nan
    return MeasurementTrace(
        edge_uv_px=prediction.uv_px[sample] + candidates.offset_px[:, None] * prediction.normal[sample],
        edge_used=consensus.weight > 0.0,
        edge_index=prediction.layout.edge[sample],
        edge_residual_px=consensus.residual_px,
        predicted_edges_uv_px=tuple(line[there] for line, there in zip(lines, finite, strict=True)),
        predicted_corners_uv_px=corners_uv_px,
    )
