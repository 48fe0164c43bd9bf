"""Did the hand stand still during a pulse?  If not, its spot is smeared, and at none of the poses on its way."""

from __future__ import annotations

import math

import numpy as np

from gripmon.laser.pointer.spots import SHARE_OF_PEAK, Spot
from gripmon.model.records import Array, Frame, Image

_REACH = 3.0
"""Half of the window's width, in radii of a disc of the spot's area."""
_LEAST_SHARE = 0.5
"""Of the light of the brighter half of a pulse: with less in the other one there is nothing to compare."""


def way_px(lit: tuple[Frame, ...], dark: Frame | None, spot: Spot) -> Array | None:
    """(2,) by how much ``spot``, of the mean of ``lit``, moved from the first half of these frames to the second, px.
    A hand at a steady speed moved about twice as far.  None where that can't be told: a single frame, or a laser that
    wasn't on all the time.
    """
    if len(lit) < 2:
        return None
    reach = math.ceil(_REACH * math.sqrt(spot.area_px / math.pi))
    u, v = (round(float(value)) for value in spot.uv_px)
    window = (slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1))
    before = None if dark is None or dark.image is None else _light(dark.image, window)
    half = len(lit) // 2
    found = [_centre(frames, window, before) for frames in (lit[:half], lit[-half:])]
    (first, first_flux), (last, last_flux) = found
    if not min(first_flux, last_flux) > _LEAST_SHARE * max(first_flux, last_flux):
        return None
    out: Array = last - first
    return out


def _centre(frames: tuple[Frame, ...], window: tuple[slice, slice], before: Array | None) -> tuple[Array, float]:
    """Centroid (2,) in the window, column and row, and the light that it is of."""
    images = [_light(frame.image, window) for frame in frames if frame.image is not None]
    mean = np.mean(images, axis=0)
    signal = mean - (np.median(mean) if before is None else before)
    weight = np.maximum(signal - SHARE_OF_PEAK * signal.max(), 0.0)
    flux = float(weight.sum())
    rows, columns = np.indices(weight.shape)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / max(flux, 1e-9), flux


def _light(image: Image, window: tuple[slice, slice]) -> Array:
    part = image[window].astype(float)
    return part if part.ndim == 2 else part.max(axis=2)
