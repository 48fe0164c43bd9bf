"""Rendered laser spots: Gaussian blobs that saturate, with speckle, ambient light, noise; truth at hand."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.records import Array, Image


def spot_image(
    uv_px: Array, rng: np.random.Generator, *, size_px: tuple[int, int] = (640, 480), sigma_px: float = 3.0,
    height: float = 200.0, speckle: float = 0.0, ambient: Array | None = None, noise: float = 2.0, colour: bool = False,
    reflections: tuple[tuple[float, float, float], ...] = (), dtype: type = np.uint8,
) -> Image:  # fmt: skip
    """``height`` in grey levels over the background, cut off at full scale; ``speckle`` contrast of the grains;
    ``reflections`` further blobs (u, v, height); ``ambient`` (h, w) grey levels.
    """
    width, rows = size_px
    v, u = np.mgrid[0:rows, 0:width].astype(float)
    light = np.zeros((rows, width))
    for x, y, peak in ((*np.asarray(uv_px).tolist(), height), *reflections):
        light += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * sigma_px**2))
    if speckle:
        grains = cv2.GaussianBlur(rng.normal(size=light.shape), (0, 0), 1.0)
        light *= np.exp(speckle * grains / grains.std())
    scale = 1.0 if dtype == np.uint8 else 16.0
    background = (np.full(light.shape, 30.0) if ambient is None else ambient)[:, :, None]
    shares = np.array([0.1, 0.2, 1.0]) if colour else np.ones(1)  # a red laser
    image = scale * (background + light[:, :, None] * shares + rng.normal(0.0, noise, (*light.shape, len(shares))))
    image = np.clip(np.rint(image), 0.0, 255.0 if dtype == np.uint8 else 4095.0).astype(dtype)
    return np.ascontiguousarray(image[:, :, 0] if image.shape[2] == 1 else image)


def cluttered(rng: np.random.Generator, size_px: tuple[int, int] = (640, 480)) -> Array:
    """Ambient light with gradients, edges and bright objects, grey levels."""
    width, rows = size_px
    v, u = np.mgrid[0:rows, 0:width].astype(float)
    out = 40.0 + 40.0 * u / width + 20.0 * np.sin(v / 60.0)
    for _ in range(6):
        x, y = rng.uniform(0.1, 0.9, 2) * [width, rows]
        out[(np.abs(u - x) < rng.uniform(30, 80)) & (np.abs(v - y) < rng.uniform(30, 80))] += rng.uniform(20.0, 90.0)
    return cv2.GaussianBlur(out, (0, 0), 1.5)
