"""The corrected transform at instants that are no frame's."""

from __future__ import annotations

import numpy as np

from gripmon.analyse.smoother import chart
from gripmon.analyse.smoother.correction import Correction
from gripmon.analyse.smoother.run import Ints
from gripmon.model.records import Array


def sample(correction: Correction, wanted_ns: Ints) -> tuple[Array, Array, Ints]:
    """Transforms (k, 4, 4), their errors' covariances (k, 6, 6) and segments (k,) at the capture times ``wanted_ns``.

    A frame's own time gives the frame's.  Between two frames the transform is taken to go from one to the other, and
    may have done so at once, at any moment: so much is added to the covariance.  All NaN, and segment -1, before the
    first frame and after the last.  ValueError for a recording in which time runs backwards.
    """
    stamps = correction.stamp_ns
    if (np.diff(stamps) < 0).any():
        raise ValueError("time runs backwards in the recording: an instant may lie in several places")
    wanted_ns = np.asarray(wanted_ns, np.int64)
    after = np.clip(np.searchsorted(stamps, wanted_ns, side="left"), 0, len(stamps) - 1)
    before = np.where(stamps[after] == wanted_ns, after, np.maximum(after - 1, 0))
    outside = (wanted_ns < stamps[0]) | (wanted_ns > stamps[-1])
    span = np.maximum(stamps[after] - stamps[before], 1)
    f = np.clip((wanted_ns - stamps[before]) / span, 0.0, 1.0)
    poses, covariances = np.full((len(f), 4, 4), np.nan), np.full((len(f), 6, 6), np.nan)
    for k in np.flatnonzero(~outside).tolist():
        from_T, to_T = correction.cam_T_grip[before[k]], correction.cam_T_grip[after[k]]
        way = chart.to_vectors(from_T, to_T[None])[0]
        poses[k] = chart.to_poses(from_T, f[k] * way[None])[0]
        own = (1.0 - f[k]) * correction.covariance[before[k]] + f[k] * correction.covariance[after[k]]
        covariances[k] = own + f[k] * (1.0 - f[k]) * np.outer(way, way)
    segment = np.where(f < 0.5, correction.segment[before], correction.segment[after])
    return poses, covariances, np.where(outside, -1, segment)
