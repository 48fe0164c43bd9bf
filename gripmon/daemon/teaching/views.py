"""A camera and the gripper's pose, from files or roughly from numbers."""

from __future__ import annotations

import math
from pathlib import Path

from gripmon.daemon.calibrations import read_calibrated
from gripmon.daemon.teaching.inputs import read_lens
from gripmon.model.camera import Camera, make_camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record
from gripmon.model.records import Array
from gripmon.teach.mounts import Mount, towards


def read_view(
    camera_path: Path | None, reference_path: Path | None, rough: tuple[float, float] | None
) -> tuple[Camera | None, Array | None]:
    """Camera and ``cam_T_grip`` (4, 4), None if not given; a reference's file also contains its camera.

    ``rough``: distance (m) of the TCP, which is in the middle of the image, and tilt of the optical axis from the
    gripper's z axis (degrees).  :class:`~gripmon.model.errors.InputError` for files without a camera or a pose.
    """
    lens = None if camera_path is None else read_lens(camera_path)[0]
    cam_T_grip = None
    if reference_path is not None:
        found = read_calibrated(reference_path)
        if found.cam_T_grip is None:
            right = "a file of gripmon calibrate plane, or a configuration"
            raise InputError(f"{reference_path}: holds no cam_T_grip; {right}", "reference")
        cam_T_grip = from_record(found.cam_T_grip)
        lens = lens or found.lens
    if rough is not None and lens is None:
        raise InputError("is missing: a rough view needs one; a file of gripmon calibrate intrinsics", "camera")
    camera = None if lens is None else make_camera(lens)
    if rough is not None and camera is not None:
        middle = 0.5 * (camera.width_px - 1.0), 0.5 * (camera.height_px - 1.0)
        cam_T_grip = Mount(rough[0], math.radians(rough[1]), 0.0, 0.0).cam_T_grip(towards(camera, middle))
    return camera, cam_T_grip
