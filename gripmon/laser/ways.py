"""Three ways to the same spot: beam and plane (7)-(9), camera ray and plane (10)-(12), beam and ray (13), (14).

Each omits one of camera, plane and pointer: if the plane moved, beam and ray still meet.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from gripmon.laser.documents import Calibrated
from gripmon.laser.setup import COUNT, LaserSetup, nearest_points, spots_on_plane, spots_on_rays
from gripmon.model.records import Array

BEAM_PLANE, RAY_PLANE, BEAM_RAY = "beam and plane", "ray and plane", "beam and ray"
PAIRS = (((BEAM_PLANE, RAY_PLANE), 2), ((BEAM_PLANE, BEAM_RAY), 2), ((RAY_PLANE, BEAM_RAY), 1), (("beam", "ray"), 1))
"""What is compared, and how many directions it differs in: two ways lie in the plane, or on a common line."""
_STEP = 1e-6


class SpotGap(msgspec.Struct, frozen=True):
    """Two of the three ways to a spot, and how far apart they put it.

    ``distance_m``, with its standard deviation ``sigma_m``; ``square``: normalised square of the gap, chi-square with
    ``degrees_of_freedom`` while nothing has moved.
    """

    ways: tuple[str, str]
    distance_m: float
    sigma_m: float
    square: float
    degrees_of_freedom: int


def three_ways(known: Calibrated, setup: LaserSetup, base_T_ee: Array, uv_px: Array) -> tuple[Array, Array]:
    """Spots (n, 3, 3), base frame, by beam and plane, by ray and plane, by beam and ray (the ray's point), and the gaps
    (n, 4, 3) of :data:`PAIRS`, for pixels (n, 2) at poses (n, 4, 4); NaN where undefined.
    """
    xy = known.camera.undistort(uv_px)
    first, second = spots_on_plane(setup, base_T_ee), spots_on_rays(setup, xy)
    on_rays, on_beams = nearest_points(setup, base_T_ee, xy)
    gaps = np.stack([second - first, on_rays - first, on_rays - second, on_beams - on_rays], axis=1)
    return np.stack([first, second, on_rays], axis=1), gaps


def disagreements(known: Calibrated, base_T_ee: Array, uv_px: Array, noise_px2: Array) -> list[tuple[SpotGap, ...]]:
    """For each spot (n, 2) with its noise (n, 2, 2) the gaps that are defined; the covariance of each gap is that of
    the calibration and of the noise, to first order (central differences).
    """

    def gaps_at(step: Array) -> Array:
        return three_ways(known, known.setup.moved(step[:COUNT]), base_T_ee, uv_px + step[COUNT:])[1]

    steps = _STEP * np.eye(COUNT + 2)
    slopes = np.stack([(gaps_at(step) - gaps_at(-step)) / (2.0 * _STEP) for step in steps], axis=-1)  # (n, 4, 3, 15)
    by_setup, by_pixel = slopes[..., :COUNT], slopes[..., COUNT:]
    covariance = by_setup @ known.covariance @ by_setup.swapaxes(-1, -2)
    covariance += by_pixel @ noise_px2[:, None] @ by_pixel.swapaxes(-1, -2)
    gaps = three_ways(known, known.setup, base_T_ee, uv_px)[1]
    out = []
    for each, spread in zip(gaps, covariance, strict=True):
        defined = np.isfinite(each).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
        out.append(tuple(_gap(*PAIRS[k], each[k], spread[k]) for k in np.flatnonzero(defined)))
    return out


def _gap(ways: tuple[str, str], freedom: int, gap_m: Array, covariance: Array) -> SpotGap:
    """Its ``freedom`` directions are those with the largest variance."""
    values, axes = np.linalg.eigh(covariance)
    along = axes.T @ gap_m
    square = float((along[-freedom:] ** 2 / values[-freedom:]).sum())
    distance_m = float(np.linalg.norm(gap_m))
    direction = gap_m / distance_m if distance_m > 0.0 else axes[:, -1]
    sigma_m = math.sqrt(max(float(direction @ covariance @ direction), 0.0))
    return SpotGap(ways, distance_m, sigma_m, square, freedom)
