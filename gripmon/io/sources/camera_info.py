"""The camera in a recording: CameraInfo of ROS, CameraCalibration of Foxglove."""

from __future__ import annotations

from typing import Any

import numpy as np

from gripmon.calibrate.camera_files import camera_of_message
from gripmon.calibrate.foreign import InterchangeError
from gripmon.model.camera import LensSettings


def lens_of(message: Any, *, rectified: bool = False) -> LensSettings | None:
    """The camera of the images that belong to the message; None for one that was never calibrated (its K is 0).

    ``rectified``: for images that ROS has rectified, P's pinhole without distortion.  ValueError for an unsupported
    lens, and for a region of interest that isn't part of the sensor.
    """
    k, d, p = (np.array(getattr(message, a, getattr(message, a.upper(), ()))).astype(float) for a in "kdp")
    if k.size != 9 or not k.any():
        return None
    if rectified and p.size == 12 and p.any():
        k, d = p.reshape(3, 4)[:, :3].ravel(), np.empty(0)
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
