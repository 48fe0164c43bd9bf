"""Whether a place looks like the gripper beside its edges, too: a finger's own side is of one shade, or nearly."""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.records import Image
from gripmon.track.edges.kernel import FEWEST_AGREEING
from gripmon.track.edges.prediction import STEP_PX, Prediction
from gripmon.track.edges.profiles import BESIDE_PX, read_profiles


def unevenness(image: Image, prediction: Prediction) -> float:
    """Standard deviation of the grey level along the more even side of each edge, over that beside all edges together;
    1 where nothing can be told.

    Along the gripper's outlines one side is the finger and the other whatever lies behind; where a background imitates
    them, both sides vary alike.
    """
    profiles = read_profiles(image, prediction.map_x, prediction.map_y)
    middle = profiles.shape[1] // 2
    near, far = (min(round(way_px / STEP_PX), middle) for way_px in BESIDE_PX)
    right = profiles[:, middle + near : middle + far + 1].mean(axis=1)
    left = profiles[:, middle - far : middle - near + 1].mean(axis=1)
    square, count, all_of_them = 0.0, 0, []
    for edge in prediction.layout.edges:
        own = (prediction.layout.edge == edge) & prediction.ok
        number = int(np.count_nonzero(own))
        if number < FEWEST_AGREEING:
            continue
        square += number * min(float(right[own].var()), float(left[own].var()))
        count += number
        all_of_them += [right[own], left[own]]
    together = float(np.concatenate(all_of_them).var()) if all_of_them else 0.0
    return math.sqrt(square / (count * together)) if together > 0.0 else 1.0
