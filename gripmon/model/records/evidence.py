"""What one frame shows of each finger by itself, for those who ask what has moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gripmon.model.records.values import Array

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class EdgeEvidence:
    """Stretches of the fingers' edges (s of them) as each finger's own best rigid motion finds them; f fingers.

    ``cam_T_grip`` (4, 4) is where all fingers together show, ``jaw_opening_m`` the opening that goes with it, and
    ``jaw_reported_m`` what the robot said (None if nothing was reported).  A stretch is a piece of the gripper's edge
    number ``edge`` (s,), about ``fraction`` (s,) of the way between its ends: the middle of the points measured on it
    lies at ``xy`` (s, 2), ideal image coordinates x/z, y/z, and a distance of ``per_px`` (s,) across the edge shows as
    one pixel.  ``sigma_px`` (s,) is the standard deviation of that middle if the points erred independently,
    ``spread_px`` (s,) what all stretches of an edge share.  ``blur_px2`` (s,): variance of the edge's blur across it,
    and ``across`` (s, 2) that direction in the image.

    ``finger_share`` (f,): share of each finger's profiles that agree with the finger's own best place, NaN where
    none was sampled.  ``reach_px``: how far from the measured pose edges were looked for at first.  Of the image, as
    parts of the full scale: ``noise`` of a pixel; ``brightest``: what only one pixel in a hundred exceeds;
    ``steepest``: what only one difference of neighbours in a thousand exceeds; ``cells`` (12, 16): the grey levels of
    its parts.
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


@dataclass(frozen=True, slots=True)
class EdgeSums:
    """The agreed edge points of one frame in stretches of neighbours, arrays over the stretches; n points each.

    ``edge`` (s,) of the gripper and its ``finger`` (s,), ``stretch`` (s,) counts along the edge;
    ``weight`` (s,) sum of the points' weights, 1/px²; ``residual_px`` (s,) weighted mean of what is left of their
    offsets at the frame's pose; ``jacobian`` (s, 6) weighted mean of px by ``xi = (rho, omega)``; ``moment`` (s, 6)
    and ``information`` (s, 6, 6): sums of weight times Jacobian times residual, and times Jacobian; ``spread_px``
    (s,) standard deviation that all points of the edge may share.
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
