"""What a calibration may expect before there is any image: how exact a frame will be, what stays in view when the
camera or the jaws move, and what other camera mounts would see.
"""

from gripmon.teach.forecast.expected import (
    EDGE_POINT_SIGMA_PX,
    ForeseeingMeter,
    Foreseen,
    JawOutlook,
    Outlook,
    expect,
    foresee_frame,
    weakest_direction,
)
from gripmon.teach.forecast.jaw_travel import Certainty, Gap, JawTravel, certainty, over_jaw
from gripmon.teach.forecast.margins import Border, Freedom, border, freedom, moved_camera, sideways_m
from gripmon.teach.forecast.mounts import Mount, field_of_view_rad, towards, with_focal
from gripmon.teach.forecast.promise import Promise, promise
from gripmon.teach.forecast.sweep import Grid, Trial, tried, try_mount
from gripmon.teach.forecast.visibility import FEWEST_CORNERS, FEWEST_EDGES, Rig, Sight, behind_another_finger, see

__all__ = [
    "EDGE_POINT_SIGMA_PX",
    "FEWEST_CORNERS",
    "FEWEST_EDGES",
    "Border",
    "Certainty",
    "ForeseeingMeter",
    "Foreseen",
    "Freedom",
    "Gap",
    "Grid",
    "JawOutlook",
    "JawTravel",
    "Mount",
    "Outlook",
    "Promise",
    "Rig",
    "Sight",
    "Trial",
    "behind_another_finger",
    "border",
    "certainty",
    "expect",
    "field_of_view_rad",
    "foresee_frame",
    "freedom",
    "moved_camera",
    "over_jaw",
    "promise",
    "see",
    "sideways_m",
    "towards",
    "tried",
    "try_mount",
    "weakest_direction",
    "with_focal",
]
