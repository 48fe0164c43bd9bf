"""What is true about a frame, to rounding: poses, openings, corner pixels, and what hides which corner."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array


class Hidden(enum.StrEnum):
    """Why a corner can't be seen."""

    OUTSIDE = "outside"
    SELF = "self"
    OTHER_FINGER = "other_finger"
    CARRIER = "carrier"
    OBJECT = "object"
    COVER = "cover"


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """Truth of one frame, at the middle of its exposure.

    ``reference_cam_T_grip`` is what a perfect calibration gave before; ``tcp_shift_m`` (3,) the TCP's displacement
    since, camera axes.  ``corner_uv_px`` (c, 2), in the gripper's order, lie in the distorted image, NaN behind the
    camera; ``hidden`` (c,) is None where visible.  ``finger_bend`` (f, 4, 4) maps a finger's points at nominal opening
    to where its bending takes them, gripper frame.
    """

    index: int
    time_s: float
    stamp_ns: int
    cam_T_grip: Array
    reference_cam_T_grip: Array
    tcp_shift_m: Array
    jaw_opening_m: float
    jaw_reported_m: float | None
    corner_ids: tuple[str, ...]
    corner_uv_px: Array
    hidden: tuple[Hidden | None, ...]
    finger_bend: Array
    events: tuple[str, ...]
    exposure: float
    defocus_px: float

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(c,) which corners can be seen."""
        return np.array([h is None for h in self.hidden])

    def to_json(self, file: str) -> bytes:
        """One line of JSON without a line feed, naming the image file."""
        corners = [
            {"id": name, "uv_px": uv.tolist() if np.isfinite(uv).all() else None, "hidden": hidden}
            for name, uv, hidden in zip(self.corner_ids, self.corner_uv_px, self.hidden, strict=True)
        ]
        return msgspec.json.encode(
            {
                "index": self.index,
                "file": file,
                "time_s": self.time_s,
                "stamp_ns": self.stamp_ns,
                "cam_T_grip": self.cam_T_grip.tolist(),
                "reference_cam_T_grip": self.reference_cam_T_grip.tolist(),
                "tcp_shift_m": self.tcp_shift_m.tolist(),
                "jaw_opening_m": self.jaw_opening_m,
                "jaw_reported_m": self.jaw_reported_m,
                "corners": corners,
                "finger_bend": self.finger_bend.tolist(),
                "events": self.events,
                "exposure": self.exposure,
                "defocus_px": self.defocus_px,
            }
        )
