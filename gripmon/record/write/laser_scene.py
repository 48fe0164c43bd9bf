"""A laser calibration as a scene for the viewer: base, camera, plane, beams, spots and residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from gripmon.laser.refinement import Refined
from gripmon.laser.setup import laser_lines, spots_on_plane
from gripmon.model.geometry import invert
from gripmon.model.records import Array

_AXIS_M = 0.1
_USED, _LEFT_OUT, _BEAM, _PLANE = (40, 120, 230), (230, 60, 60), (235, 90, 90), (90, 180, 120, 90)


def write(path: Path, refined: Refined, base_T_ee: Array, uv_px: Array) -> None:
    """Everything in the base frame, the residuals in the camera's image.  OSError if the file can't be written."""
    path.open("wb").close()
    setup, camera = refined.setup, refined.camera
    base_T_cam = invert(setup.cam_T_base)
    turn, centre = base_T_cam[:3, :3], base_T_cam[:3, 3]
    spots = spots_on_plane(setup, base_T_ee)[0] @ turn.T + centre
    origins = laser_lines(setup, base_T_ee)[0] @ turn.T + centre
    seen = np.isfinite(spots).all(axis=1)
    colours = [_USED if used else _LEFT_OUT for used in refined.used]
    recording = rr.RecordingStream("gripmon_laser")
    recording.save(path)

    def log(entity: str, archetype: rr.AsComponents) -> None:
        recording.log(entity, archetype, static=True)

    log("base", rr.Transform3D(translation=[0.0, 0.0, 0.0]))
    log("base/axes", rr.Arrows3D(vectors=_AXIS_M * np.eye(3), colors=[(220, 40, 40), (60, 160, 60), (40, 90, 220)]))
    shown = [colours[k] for k in np.flatnonzero(seen)]
    log("base/spots", rr.Points3D(spots[seen], colors=shown, radii=0.002))
    log("base/beams", rr.LineStrips3D(np.stack([origins[seen], spots[seen]], axis=1), colors=_BEAM, radii=0.0005))
    normal = turn @ setup.normal_cam
    middle = np.median(spots[seen], axis=0)
    side = max(1.3 * float(np.linalg.norm(spots[seen] - middle, axis=1).max()), 0.01)
    corners = plane_corners(normal, middle, side)
    log("base/plane", rr.Mesh3D(vertex_positions=corners, triangle_indices=[[0, 1, 2], [0, 2, 3]],
                                albedo_factor=_PLANE))  # fmt: skip
    log("base/camera", rr.Transform3D(translation=centre, mat3x3=turn))
    log("base/camera/image", rr.Pinhole(
        focal_length=[camera.fx_px, camera.fy_px], principal_point=[camera.cx_px, camera.cy_px],
        width=camera.width_px, height=camera.height_px, camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.3 * setup.distance_m))  # fmt: skip
    log("base/camera/image/spots", rr.Points2D(uv_px, colors=colours, radii=2.0))
    lines = np.stack([uv_px, uv_px - refined.residuals_px], axis=1)[seen]
    log("base/camera/image/residuals", rr.LineStrips2D(lines, colors=_LEFT_OUT))
    recording.flush()
    recording.disconnect()


def plane_corners(normal: Array, middle: Array, side: float) -> Array:
    """Corners (4, 3) of a square on a plane, ``side`` is half of its own, m."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    out: Array = middle + side * np.array([first + second, first - second, -first - second, -first + second])
    return out
