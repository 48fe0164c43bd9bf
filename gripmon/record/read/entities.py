"""Which entity of a recording holds what, as far as it is read here."""

from __future__ import annotations

RECORD = "record"
META = "meta"
CONFIGURATION = "configuration"
REFERENCE = "reference"
ALERT = "alert"
COMMAND = "command"
STATE = "state"
ABOUT = "about"
JAW_REPORTED = "jaw/reported_m"
IMAGE = "rig/camera/image"
IMAGE_MEAN = "image/mean_grey"
PREDICTED_EDGES = f"{IMAGE}/edges/predicted"
EDGES_USED = f"{IMAGE}/edges/used"
EDGES_REFUSED = f"{IMAGE}/edges/refused"
PREDICTED_CORNERS = f"{IMAGE}/corners/predicted"

READ = (META, CONFIGURATION, ABOUT, REFERENCE, COMMAND, STATE, ALERT, IMAGE_MEAN, RECORD)
"""Read when a recording is opened."""
ON_DEMAND = (IMAGE, PREDICTED_EDGES, EDGES_USED, EDGES_REFUSED, PREDICTED_CORNERS, JAW_REPORTED)
"""Only their places are kept."""
