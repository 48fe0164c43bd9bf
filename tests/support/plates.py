"""Images of calibration plates with what tests want in front of them: the simulator's plates, drawn by sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.records import Array, Image
from gripmon.model.targets import Target
from gripmon.simulate.plates import Plate, Print, develop, points_of, sample_rays
from gripmon.simulate.plates import facing as pose
from support.kept import kept

__all__ = ["Cover", "Look", "fingers", "points_of", "pose", "render", "true_uv"]

Cover = tuple[Array, float]
"""A polygon (k, 2) in the image (px) and its grey value: something in front of the plate."""


@dataclass(frozen=True)
class Look(Print):
    """How the image is taken.  ``falloff``: part of the light that is gone at the darkest border."""

    supersampling: int = 3
    blur_px: float = 0.6
    noise: float = 1.5
    falloff: float = 0.0
    mirrored: bool = False


def true_uv(settings: LensSettings, cam_T_plate: Array, plate_m: Array) -> Array:
    """Pixels (n, 2) of points on the plate."""
    return make_camera(settings).project(plate_m @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])


def fingers(settings: LensSettings, reach: float = 0.3) -> list[Cover]:
    """Two fingers from the left and the right border, each over this part of the image's width."""
    w, h = settings.width_px, settings.height_px
    top, bottom = 0.325 * h, 0.675 * h
    left = np.array([[-5, top - 9], [reach * w, top], [reach * w + 4, bottom], [-5, bottom + 6]])
    right = np.array([[w + 5, top + 4], [(1 - reach) * w, top], [(1 - reach) * w - 6, bottom], [w + 5, bottom]])
    return [(left, 115.0), (right, 85.0)]


def render(
    settings: LensSettings,
    cam_T_plate: Array,
    target: Target,
    look: Look = Look(),
    *,
    covers: Sequence[Cover] = (),
    solid: Callable[[Array, Array], Array] | None = None,
    seed: int = 0,
) -> Image:
    """An image (H, W) of 8 bit.  ``solid`` takes ideal coordinates (n, 2) and what is seen there, (n,) grey values, and
    gives what is seen with something in front.
    """
    draw = _drawn if solid is None else _drawn.__wrapped__  # what it draws may not be told from something else
    return draw(settings, cam_T_plate, target, look, tuple(covers), solid, seed)


@kept
def _drawn(
    settings: LensSettings,
    cam_T_plate: Array,
    target: Target,
    look: Look,
    covers: Sequence[Cover],
    solid: Callable[[Array, Array], Array] | None,
    seed: int,
) -> Image:
    rng, ss = np.random.default_rng(seed), look.supersampling
    xy = sample_rays(settings, ss)
    grey = Plate(target, cam_T_plate, look).grey(xy)
    if solid is not None:
        grey = np.nan_to_num(solid(xy.reshape(-1, 2), grey.ravel())).reshape(grey.shape)
    grey = np.ascontiguousarray(grey[:, ::-1] if look.mirrored else grey, np.float32)
    for polygon, level in covers:
        # A pixel's centre has an integer coordinate, before supersampling and after.
        corners = np.rint(((np.asarray(polygon) + 0.5) * ss - 0.5) * 256.0).astype(np.int32)
        cv2.fillPoly(grey, [corners], level, lineType=cv2.LINE_8, shift=8)
    image = develop(grey, ss, look.blur_px).astype(np.float64)
    if look.falloff:
        image = image * (1.0 - look.falloff * np.linspace(0.0, 1.0, settings.width_px))
    return np.clip(np.rint(image + rng.normal(0.0, look.noise, image.shape)), 0, 255).astype(np.uint8)
