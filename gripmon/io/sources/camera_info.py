"""The camera in a recording: CameraInfo of ROS, CameraCalibration of Foxglove.

Source: ``sensor_msgs/CameraInfo``: width, height, K and P are of the whole sensor; the image is the region of interest
in it, then binned.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from gripmon.calibrate.formats import InterchangeError, read_ros
from gripmon.model.camera import LensSettings


def is_rectified(topic: str) -> bool:
    """Whether a topic's images are rectified, by the names of ``image_proc`` and the cameras' drivers: ``image_rect``,
    ``image_rect_color``, ``color/image_rect_raw``, ``left/rectified``.
    """
    return re.search(r"(?<![^/_])rect(ified)?(?![^/_])", topic) is not None


def lens_fault(lens: LensSettings, configured: LensSettings) -> str | None:
    """How the images' own camera calibration differs from the configuration's, in words; None: it doesn't."""
    from gripmon.calibrate.bundle import GivenCamera
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.calibrate.verify import NEGLIGIBLE_PX, compare_cameras

    try:
        off = compare_cameras(GivenCamera(configured, (), None), GivenCamera(lens, (), None))
    except CalibrationError as error:
        return f"the frames have a camera calibration of another kind ({error}); the configuration's is used"
    if off.largest_px <= NEGLIGIBLE_PX:
        return None
    far = f"up to {off.largest_px:.3g} px from the configuration's"
    return f"the frames have a camera calibration that is {far}, which is used"


def lens_of(message: Any, *, rectified: bool = False) -> LensSettings | None:
    """The camera of the images that belong to the message; None for one that was never calibrated (its K is 0).

    ``rectified``: for images that ROS has rectified, P's pinhole without distortion.  ValueError for an unsupported
    lens, for rectified images whose P is empty, and for a region of interest that isn't part of the sensor.
    """
    k, d, p = (np.array(getattr(message, a, getattr(message, a.upper(), ()))).astype(float) for a in "kdp")
    if k.size != 9 or not k.any():
        return None
    if rectified and p.size == 12 and p.any():
        k, d = p.reshape(3, 4)[:, :3].ravel(), np.empty(0)
    elif rectified and d.any():
        raise ValueError("P is empty, and D isn't; for rectified images P, the camera without distortion")
    size_px, k = _of_the_image(message, k.reshape(3, 3))
    content = {
        "image_width": size_px[0],
        "image_height": size_px[1],
        "distortion_model": message.distortion_model or "plumb_bob",
        "camera_matrix": {"rows": 3, "cols": 3, "data": k.ravel().tolist()},
        "distortion_coefficients": {"rows": 1, "cols": d.size, "data": d.tolist()},
    }
    if rectified or not d.size:
        content["distortion_model"] = "plumb_bob"
    try:
        return read_ros(json.dumps(content).encode(), "camera_info")
    except InterchangeError as error:
        raise ValueError(str(error)) from None


def _of_the_image(message: Any, k: np.ndarray) -> tuple[tuple[int, int], np.ndarray]:
    """Width and height (px) and camera matrix of the images, from those of the whole sensor."""
    whole = np.array([int(message.width), int(message.height)])
    roi = getattr(message, "roi", None)
    fields = ("x_offset", "y_offset", "width", "height")
    x_px, y_px, *size_px = (0, 0, 0, 0) if roi is None else (int(getattr(roi, name)) for name in fields)
    offset, size = np.array([x_px, y_px]), np.array(size_px)
    if not (offset.any() or size.any()):  # by its definition the same as the whole
        size = whole
    if (size <= 0).any() or (offset + size > whole).any():
        region, of = f"{size[0]} x {size[1]} px at {x_px}, {y_px}", f"{whole[0]} x {whole[1]} px"
        raise ValueError(f"roi: {region} isn't part of the {of} that K is of; width and height of the whole sensor")
    binning = np.array([max(int(getattr(message, f"binning_{axis}", 0)), 1) for axis in "xy"])
    k = k.copy()
    # A binned pixel's centre is the middle of its block.
    k[:2, 2] = (k[:2, 2] - offset - 0.5 * (binning - 1)) / binning
    k[:2, :2] /= binning[:, None]
    width, height = (int(each) for each in size // binning)
    return (width, height), k
