"""A spot by itself: where it should be, how far off it is and how surely, by each of the three ways."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gripmon.laser.pointer.spots import Spot
from gripmon.laser.watch.judgement import Disagreement
from gripmon.laser.watch.ways import INPUTS, disagreements, ways
from gripmon.laser.watch.world import COUNT, Calibrated, Foreseen, larger
from gripmon.model.records import Array

MOST_UNCERTAIN = 0.1
"""Of the image's diagonal: a foreseen spot that is less certain is none."""


@dataclass(frozen=True, slots=True)
class Single:
    """See :class:`~gripmon.laser.watch.judgement.SpotJudgement`."""

    uv_px: Array
    off_px: Array
    covariance_px: Array
    square: float
    spots_base_m: Array
    disagreements: tuple[Disagreement, ...]


def visible(calibrated: Calibrated, foreseen: Foreseen, arm: Array) -> str | None:
    """Why there is no spot to be foreseen at a pose; ``arm`` (6, 6) covariance of its poses.  None if there is one."""
    if not foreseen.finite:
        if not np.isfinite(foreseen.spot_base_m).all():
            return "the beam runs along the plane"
        return "the beam meets the plane behind the camera or outside of its lens"
    spread = spread_px(calibrated, foreseen, arm)
    largest = math.sqrt(float(np.linalg.eigvalsh(spread)[-1]))
    if largest > MOST_UNCERTAIN * math.hypot(calibrated.camera.width_px, calibrated.camera.height_px):
        return f"the beam nearly runs along the plane: the spot can't be foreseen to better than {largest:.0f} px"
    return None


def spread_px(calibrated: Calibrated, foreseen: Foreseen, arm: Array) -> Array:
    """Covariance (2, 2) of a foreseen spot: by the calibration and the arm."""
    return foreseen.rows @ calibrated.covariance @ foreseen.rows.T + foreseen.arm_rows @ arm @ foreseen.arm_rows.T


def alone(calibrated: Calibrated, foreseen: Foreseen, base_T_ee: Array, spot: Spot, arm: Array) -> Single:
    """The calibration's residuals have the arm in them: noise is what they show, or what is said of spot and arm,
    whichever is more.
    """
    floor = calibrated.sigma_px**2 * np.eye(2)
    by_arm = foreseen.arm_rows @ arm @ foreseen.arm_rows.T
    noise = larger(spot.covariance_px + by_arm, floor)
    covariance = foreseen.rows @ calibrated.covariance @ foreseen.rows.T + noise
    off = spot.uv_px - foreseen.uv_px
    inputs = np.zeros((INPUTS, INPUTS))
    inputs[:COUNT, :COUNT] = calibrated.covariance
    inputs[COUNT : COUNT + 2, COUNT : COUNT + 2] = noise  # the arm is counted as pixels, once
    found = ways(calibrated.world, calibrated.camera, base_T_ee, spot.uv_px)
    return Single(
        spot.uv_px,
        off,
        covariance,
        float(off @ np.linalg.solve(covariance, off)),
        found.spots_base_m,
        disagreements(found, inputs),
    )
