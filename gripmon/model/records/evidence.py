"""What one frame shows of each finger by itself, for the analysis of what has moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gripmon.model.records.values import Array

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class EdgeEvidence:
    """Stretches (s of them) of the fingers' edges, as found by the best rigid motion of each finger by itself; f
    fingers.

    ``cam_T_grip`` (4, 4) is the pose that all fingers together show, ``jaw_opening_m`` the opening that goes with it,
    and ``jaw_reported_m`` the opening that the robot reported (None if none).  A stretch is a piece of the gripper's
    edge number ``edge`` (s,), at about the fraction ``fraction`` (s,) between its ends: the mean of its measured points
    lies at ``xy`` (s, 2), ideal image coordinates x/z, y/z, where a distance ``per_px`` (s,) across the edge is one
    pixel.  ``sigma_px`` (s,) is the standard deviation of that mean if the points' errors are independent,
    ``spread_px`` (s,) the one that all stretches of an edge share.  ``blur_px2`` (s,): variance of the edge's blur
    across it, and ``across`` (s, 2) that direction in the image.

    ``finger_share`` (f,): inlier ratio of each finger's search lines at the finger's own best pose, NaN where none was
    sampled.  ``reach_px``: how far from the measured pose edges were searched at first.  About the image, as fractions
    of full scale: ``noise`` of a pixel; ``brightest``: the level that only one pixel in a hundred exceeds;
    ``steepest``: the difference that only one pair of neighbours in a thousand exceeds; ``cells`` (12, 16): the mean
    grey levels of a grid of cells.  ``found``: whether all fingers together were measured, so that the pose is one.
    """

    cam_T_grip: Array
    jaw_opening_m: float
    jaw_reported_m: float | None
    edge: NDArray[np.intp]
    fraction: Array
    xy: Array
    per_px: Array
    sigma_px: Array
    spread_px: Array
    blur_px2: Array
    across: Array
    finger_share: Array
    noise: float
    brightest: float
    steepest: float
    cells: Array
    reach_px: float
    found: bool = True


@dataclass(frozen=True, slots=True)
class EdgeSums:
    """The inlier edge points of one frame, summed over stretches of neighbours; arrays over the stretches, n points
    each.

    ``edge`` (s,) of the gripper and its ``finger`` (s,), ``stretch`` (s,) counts along the edge; ``weight`` (s,) sum of
    the points' weights, 1/px²; ``residual_px`` (s,) weighted mean of their residuals at the frame's pose; ``jacobian``
    (s, 6) weighted mean Jacobian of px by ``xi = (rho, omega)``; ``moment`` (s, 6) and ``information`` (s, 6, 6): sums
    of weight times Jacobian times residual, and of weight times Jacobian times Jacobian; ``spread_px`` (s,) standard
    deviation of an error that all points of the edge may share.
    """

    edge: NDArray[np.intp]
    finger: NDArray[np.intp]
    stretch: NDArray[np.intp]
    weight: Array
    residual_px: Array
    jacobian: Array
    moment: Array
    information: Array
    spread_px: Array
