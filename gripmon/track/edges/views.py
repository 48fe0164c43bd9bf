"""What a measurement shows besides its result: pixels for people who look."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import MeasurementTrace
from gripmon.track.edges.settling import Measurement


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
