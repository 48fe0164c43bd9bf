"""Is this frame an image that the monitor can measure?  Examines about 1,700 pixels, whatever the image's size."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Frame, Image, Refusal

_DARK, _FLAT = 0.02, 0.01
"""Parts of the full scale: an image is black if nothing is brighter than the first, white if nothing is farther than
that from the top, flat if its grey levels spread no more than the second.
"""

FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): 1.0}
"""Largest grey level of the types that images may have."""


def sparse(image: Image) -> Image:
    """About 1,700 pixels spread over an image (h, w) or (h, w, 3), whatever its size; a copy."""
    return image[8 :: max(1, image.shape[0] // 36), 8 :: max(1, image.shape[1] // 48)].copy()


def inspect(frame: Frame, camera: Camera, gripper: Gripper, pixels: Image | None = None) -> tuple[Refusal, str] | None:
    """None if the frame may be measured; else the reason, and a text with what came and what would be right.

    ``pixels``: the image's :func:`sparse` pixels, if they are already known.
    """
    image = frame.image
    if image is None or not isinstance(image, np.ndarray):
        return frame.refusal, frame.fault or "there is no image"
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        return Refusal.WRONG_TYPE, f"shape {image.shape}; H x W, or H x W x 3 in the order BGR"
    if image.shape[:2] != (camera.height_px, camera.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        return (
            Refusal.WRONG_SIZE,
            f"{size} pixels; {camera.width_px}x{camera.height_px} as the camera's calibration says",
        )
    if image.dtype not in FULL_SCALE:
        return Refusal.WRONG_TYPE, f"pixels of type {image.dtype}; uint8, uint16 or float32 in 0 to 1"
    return _grey_levels(sparse(image) if pixels is None else pixels) or _jaw(frame, gripper)


def _grey_levels(pixels: Image) -> tuple[Refusal, str] | None:
    low, high = float(pixels.min()), float(pixels.max())
    scale = FULL_SCALE[pixels.dtype]
    if not (np.isfinite(low) and np.isfinite(high)):
        return Refusal.NOT_FINITE, "pixels that are NaN or infinite; float images in 0 to 1"
    if low < 0.0 or high > scale:
        return Refusal.WRONG_TYPE, f"float pixels from {low:g} to {high:g}; float images in 0 to 1"
    if high <= _DARK * scale:
        said = f"no pixel brighter than {100.0 * high / scale:.0f} % of the full scale"
        if pixels.dtype == np.uint16 and high > 0.0:
            said += " of 16 bits; monitor.bit_depth, if the camera fills only 10 or 12 of them"
        return Refusal.BLACK, said
    if low >= (1.0 - _DARK) * scale:
        return Refusal.WHITE, f"no pixel darker than {100.0 * low / scale:.0f} % of the full scale"
    if high - low <= _FLAT * scale:
        return Refusal.FLAT, f"all pixels within {100.0 * (high - low) / scale:.1f} % of the full scale"
    return None


def _jaw(frame: Frame, gripper: Gripper) -> tuple[Refusal, str] | None:
    opening_m = frame.jaw_opening_m
    if opening_m is None or not gripper.has_jaw:
        return None
    if not gripper.jaw_min_m - 1e-3 <= opening_m <= gripper.jaw_max_m + 1e-3:
        range_m = f"{gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m"
        return Refusal.JAW_OPENING, f"jaw opening {opening_m:g} m; {range_m}, as the gripper file says (jaw)"
    return None
