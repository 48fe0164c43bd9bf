"""From light to counts: vignetting, exposure, shadows, defocus, shot and read noise, saturation, JPEG."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.simulate import disturbance
from gripmon.simulate.scenario import Scenario, Shadow
from gripmon.simulate.viewing import CELL_PX, RayGrid, enlarge_cells

Light32 = NDArray[np.float32]
_BANK_MARGIN_PX = 96
_SAMPLED_FROM_PX = 0.8
_COARSE_FROM_PX = 4.0  # a shadow with a softer border may be computed on coarse cells


class SensorModel:
    """Turns the light that falls on the sensor (DN at exposure 1, float32) into an 8-bit image."""

    def __init__(self, rays: RayGrid, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self._size = (rays.height_px, rays.width_px)
        self._vignette = self._fall_off(rays)
        rng = np.random.default_rng([seed, 3])
        shape = (rays.height_px + _BANK_MARGIN_PX, rays.width_px + _BANK_MARGIN_PX)
        banks = [rng.standard_normal(shape, np.float32) for _ in range(2)]
        self._banks = [(b - b.mean()) / b.std() for b in banks]

    def expose(self, light: Light32, index: int, time_s: float) -> NDArray[np.uint8]:
        """Image of frame ``index``; ``light`` is used up."""
        scenario = self._scenario
        cv2.multiply(light, self._vignette, light, scale=disturbance.exposure(scenario.light, time_s))
        for shadow in scenario.light.shadows:
            if shadow.start_s < time_s < shadow.end_s:
                cv2.multiply(light, self._shadow(shadow, time_s), light)
        light = blur(light, disturbance.defocus_sigma_px(scenario.defocus, time_s))
        self._add_noise(light, index)
        image = np.asarray(cv2.convertScaleAbs(light), dtype=np.uint8)
        return image if scenario.sensor.jpeg_quality == 0 else _jpeg(image, scenario.sensor.jpeg_quality)

    def _add_noise(self, light: Light32, index: int) -> None:
        """Two banks of noise, each at a random place, mixed by a random angle: cheap, and new for every frame."""
        sensor = self._scenario.sensor
        if sensor.read_noise_dn > 0.0 or sensor.shot_noise_dn > 0.0:
            rng = np.random.default_rng([self._seed, 4, index])
            height, width = self._size
            places = rng.integers(0, _BANK_MARGIN_PX + 1, (2, 2)).tolist()
            a, b = (bank[v : v + height, u : u + width] for bank, (v, u) in zip(self._banks, places, strict=True))
            angle = float(rng.uniform(0.0, 2.0 * math.pi))
            noise = cv2.addWeighted(a, math.cos(angle), b, math.sin(angle), 0.0)
            np.maximum(light, 0.0, out=light)
            sigma = cv2.addWeighted(light, sensor.shot_noise_dn, light, 0.0, sensor.read_noise_dn**2)
            cv2.sqrt(sigma, sigma)
            cv2.multiply(noise, sigma, noise)
            cv2.add(light, noise, light)
        np.maximum(light, 0.0, out=light)

    def _shadow(self, shadow: Shadow, time_s: float) -> Light32:
        """Factor of all pixels: a band that travels across the view, its borders half cosine waves."""
        height, width = self._size
        cell_px = CELL_PX if shadow.softness * width > _COARSE_FROM_PX else 1
        u = (np.arange(-(-width // cell_px)) + 0.5) * cell_px / width - 0.5
        v = (np.arange(-(-height // cell_px)) + 0.5) * cell_px / width - 0.5 * height / width
        angle = math.radians(shadow.angle_deg)
        along = u[None, :] * math.cos(angle) + v[:, None] * math.sin(angle)
        travel = 1.2 + shadow.width + 2.0 * shadow.softness
        way = (time_s - shadow.start_s) / (shadow.end_s - shadow.start_s)
        centre = travel * ((way if shadow.still_at is None else shadow.still_at) - 0.5)
        inside = (0.5 * shadow.width - np.abs(along - centre)) / shadow.softness
        depth = 0.5 + 0.5 * np.sin(0.5 * np.pi * np.clip(inside, -1.0, 1.0))
        coarse = (1.0 - shadow.depth * depth).astype(np.float32)
        return coarse if cell_px == 1 else np.ascontiguousarray(enlarge_cells(coarse)[:height, :width])

    def _fall_off(self, rays: RayGrid) -> Light32:
        """1 at the middle, less by the square of the distance; nothing where the lens doesn't see."""
        height, width = self._size
        u = np.linspace(-1.0, 1.0, width, dtype=np.float32)
        v = np.linspace(-1.0, 1.0, height, dtype=np.float32)
        fall_off = 1.0 - np.float32(0.5 * self._scenario.sensor.vignetting) * (u[None, :] ** 2 + v[:, None] ** 2)
        if not rays.seen.all():
            fall_off = fall_off * rays.enlarge(rays.seen.astype(np.float32))
        return np.ascontiguousarray(fall_off, dtype=np.float32)


def blur(light: Light32, sigma_px: float) -> Light32:
    """Gaussian blur whose variance is right however small: three taps where a sampled Gaussian would be too narrow."""
    if sigma_px == 0.0:
        return light
    if sigma_px >= _SAMPLED_FROM_PX:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px), dtype=np.float32)
    side = 0.5 * sigma_px**2
    taps = np.array([side, 1.0 - 2.0 * side, side], np.float32)
    return np.asarray(cv2.sepFilter2D(light, -1, taps, taps), dtype=np.float32)


def _jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    done, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "OpenCV could not encode a grey image as JPEG"
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
