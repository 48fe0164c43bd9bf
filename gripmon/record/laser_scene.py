"""A laser calibration as a 3D scene of rerun."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from gripmon.laser.setup import LaserSetup, beams, spots_on_plane
from gripmon.model.atomic import write_atomically
from gripmon.model.camera import LensSettings
from gripmon.model.records import Array
from gripmon.record.columns import Colour, Sender, pinhole

if TYPE_CHECKING:
    from gripmon.laser.refinement import Refined

IMAGE = "base/camera/image"
_USED, _LEFT_OUT, _BEAM, _PLANE = (40, 120, 230, 255), (230, 60, 60, 255), (235, 90, 90, 255), (90, 180, 120, 90)
_AXIS_M = 0.1
_PLANE_MARGIN, _PLANE_LEAST_M = 1.3, 0.01  # half a side: this much more than the spots need, and at least


def write_calibration(path: Path, refined: Refined, base_T_ee: Array, uv_px: Array) -> None:
    """Write a calibration: everything in the base frame, residuals in the camera's image.  Raises OSError."""
    recording = rr.RecordingStream("gripmon_laser")
    memory = recording.memory_recording()  # rerun's file sink doesn't report a full disk
    setup, log = refined.setup, Sender(recording).static
    _log_camera(Sender(recording), setup, refined.camera)
    spots, origins = spots_on_plane(setup, base_T_ee), beams(setup, base_T_ee)[0]
    seen = np.isfinite(spots).all(axis=1)
    colours = [_USED if used else _LEFT_OUT for used in refined.used]
    log("base", rr.Transform3D(translation=[0.0, 0.0, 0.0]))
    log("base/axes", rr.Arrows3D(vectors=_AXIS_M * np.eye(3), colors=[(220, 40, 40), (60, 160, 60), (40, 90, 220)]))
    shown = [colours[k] for k in np.flatnonzero(seen)]
    log("base/spots", rr.Points3D(spots[seen], colors=shown, radii=0.002))
    log("base/beams", rr.LineStrips3D(np.stack([origins[seen], spots[seen]], axis=1), colors=_BEAM, radii=0.0005))
    middle = np.median(spots[seen], axis=0)
    side = max(_PLANE_MARGIN * float(np.linalg.norm(spots[seen] - middle, axis=1).max()), _PLANE_LEAST_M)
    log("base/plane", _plane(_plane_corners(setup.normal_base, middle, side), _PLANE))
    log("base/camera/image/spots", rr.Points2D(uv_px, colors=colours, radii=2.0))
    lines = np.stack([uv_px, uv_px - refined.residuals_px], axis=1)[seen]
    log("base/camera/image/residuals", rr.LineStrips2D(lines, colors=_LEFT_OUT))
    write_atomically(path, memory.drain_as_bytes())
    recording.disconnect()


def _log_camera(send: Sender, setup: LaserSetup, lens: LensSettings) -> None:
    base_T_cam = setup.base_T_cam
    send.static("base/camera", rr.Transform3D(translation=base_T_cam[:3, 3], mat3x3=base_T_cam[:3, :3]))
    send.static(IMAGE, pinhole(lens, 0.3 * setup.distance_cam_m))


def _plane_corners(normal: Array, middle: Array, side: float) -> Array:
    """Corners (4, 3) of a square on a plane; ``side``: half of its side, m."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    out: Array = middle + side * np.array([first + second, first - second, -first - second, -first + second])
    return out


def _plane(corners: Array, colour: Colour) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=[[0, 1, 2], [0, 2, 3]], albedo_factor=colour)
