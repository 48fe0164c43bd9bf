"""Edges whose bright side is cut off by the end of the image's range.

Overexposure cuts the upper part of a blurred step off; what is left is steepest nearer to the dark side, by up to most
of the edge's width.  By how much can't be told from the rest of the profile without knowing the lens's blur exactly,
so that such edges only get a larger standard deviation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.track.edges.profile_kernel import HARDLY, SATURATION_SHARE, SURELY


def doubt(
    profiles: Array,
    sample: NDArray[np.intp],
    place: Array,
    side: NDArray[np.intp],
    width: Array,
    end: float,
) -> Array:
    """(k,) from 0, for edges that are surely whole, to 1 for those that are surely cut off.

    ``profiles`` (n, s) in grey levels up to ``end``; for each edge: its profile ``sample``, ``place`` and ``width`` of
    its response in samples, and on which ``side`` (-1, 1) it is bright.
    """
    out = np.zeros(len(sample))
    level = SATURATION_SHARE * end
    if not (profiles >= level).any():
        return out
    last = profiles.shape[1] - 1
    start = np.round(place).astype(np.intp)
    steps = np.arange(int(np.ceil(HARDLY * float(np.max(width, initial=1.0)))) + 2)
    columns = np.clip(start[:, None] + side[:, None] * steps, 0, last)
    reached = profiles[sample[:, None], columns] >= level
    way = np.abs(start + side * reached.argmax(axis=1) - place) / width
    out[:] = np.clip((HARDLY - way) / (HARDLY - SURELY), 0.0, 1.0)
    out[~reached.any(axis=1)] = 0.0
    return out
