"""The camera in a recording: CameraInfo of ROS, CameraCalibration of Foxglove."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from gripmon.calibrate.camera_files import camera_of_message
from gripmon.calibrate.foreign import InterchangeError
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
    content = {name: int(getattr(message, name, 0)) for name in ("width", "height", "binning_x", "binning_y")}
    roi = getattr(message, "roi", None)
    fields = () if roi is None else ("x_offset", "y_offset", "width", "height")
    region = {name: int(getattr(roi, name)) for name in fields}
    model = "" if rectified or not d.size else message.distortion_model
    try:
        return camera_of_message(
            {**content, "roi": region, "k": k.tolist(), "d": d.tolist(), "distortion_model": model}, "camera_info"
        )
    except InterchangeError as error:
        raise ValueError(str(error)) from None
