"""Everything that moves, as closed functions of time without history: camera mount, fingers, jaws, things in the way,
light.  And the sensor, from light to counts: vignetting, exposure, shadows, defocus, shot and read noise, saturation,
JPEG.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array
from gripmon.simulate.coverage import CELL_PX, RayGrid, enlarge_cells
from gripmon.simulate.scenario import (
    Bump,
    Creep,
    Defocus,
    FingerLook,
    GraspedObject,
    JawScript,
    Light,
    MountMotion,
    MountScript,
    Prop,
    Scenario,
    Shadow,
    Tilt,
    Vibration,
)

_QUIET_RING = 0.02


def smooth_step(t_s: float, start_s: float, time_s: float) -> float:
    """0 before, 1 after, half a cosine wave between; a jump at ``start_s`` for ``time_s`` = 0."""
    if t_s <= start_s:
        return 0.0
    if t_s >= start_s + time_s:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * (t_s - start_s) / time_s)


def pulse(t_s: float, start_s: float, end_s: float, ramp_s: float) -> float:
    """Rises within ``ramp_s`` from ``start_s`` on, falls within ``ramp_s`` before ``end_s``."""
    return min(smooth_step(t_s, start_s, ramp_s), 1.0 - smooth_step(t_s, end_s - ramp_s, ramp_s))


def law(script: MountScript, t_s: float) -> float:
    """Factor on the script's full motion at a time."""
    match script:
        case Creep():
            since = max(t_s - script.start_s, 0.0) / script.time_s
            return min(since, 1.0) if script.law == "linear" else 1.0 - math.exp(-since)
        case Bump():
            since = t_s - script.at_s
            if since < 0.0:
                return 0.0
            ring = script.ring_fraction * math.exp(-since / script.ring_decay_s)
            return 1.0 - ring * math.cos(2.0 * math.pi * script.ring_hz * since)
        case Vibration():
            if not script.start_s <= t_s < script.end_s:
                return 0.0
            return math.sin(2.0 * math.pi * script.frequency_hz * (t_s - script.start_s))
        case Tilt():
            return smooth_step(t_s, script.start_s, script.time_s)


def law_events(script: MountScript, t_s: float) -> tuple[str, ...]:
    """Labels of the mount's motions at a time; empty while it rests."""
    match script:
        case Creep():
            past = (t_s - script.start_s) / script.time_s
            return ("creep",) if 0.0 < past < (1.0 if script.law == "linear" else 6.0) else ()
        case Bump():
            since = t_s - script.at_s
            if since < 0.0:
                return ()
            ringing = script.ring_fraction * math.exp(-since / script.ring_decay_s) > _QUIET_RING
            return ("bumped", "ringing") if ringing else ("bumped",)
        case Vibration():
            return ("vibration",) if script.start_s <= t_s < script.end_s else ()
        case Tilt():
            return ("tilting",) if 0.0 < smooth_step(t_s, script.start_s, script.time_s) < 1.0 else ()


def full_motion(motion: MountMotion, pivot_m: Array, tcp_m: Array) -> tuple[Array, Array]:
    """Rotation vector (3,) about the pivot and translation (3,) of a full-size motion, camera axes.

    Raises ValueError if no rotation about the pivot can shift the TCP that far.
    """
    lever = tcp_m - pivot_m
    turned = lever.copy()
    turned[:2] += motion.tcp_shift_m
    rest = float(lever @ lever - turned[:2] @ turned[:2])
    if not rest > 0.0 or lever[2] <= 0.0:
        raise ValueError(
            f"tcp_shift_m: no turn about the pivot shifts the TCP by {motion.tcp_shift_m} m; a smaller shift"
        )
    turned[2] = math.sqrt(rest)
    axis = np.cross(lever, turned)
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(lever @ turned))
    turn = axis * (angle / sine) if sine > 0.0 else np.zeros(3)
    roll = turned / np.linalg.norm(turned) * math.radians(motion.roll_deg)
    return turn + roll, np.array(motion.translation_m)


def mount_motion(
    scripts: tuple[MountScript, ...], full: tuple[tuple[Array, Array], ...], pivot_m: Array, t_s: float
) -> Array:
    """The gripper's motion as the camera sees it, 4x4, identity at rest.  The scripts' rotation vectors add up."""
    turn, shift = np.zeros(3), np.zeros(3)
    for script, (rotation, translation) in zip(scripts, full, strict=True):
        factor = law(script, t_s)
        turn += factor * rotation
        shift += factor * translation
    return about_pivot(turn, shift, pivot_m)


def about_pivot(turn: Array, shift: Array, pivot_m: Array) -> Array:
    """4x4 motion: a rotation vector about the pivot, then a shift."""
    rotation = exp_rotation(turn)
    return make_transform(rotation, pivot_m - rotation @ pivot_m + shift)


def jaw_opening_m(script: JawScript, nominal_m: float, t_s: float) -> float:
    """True opening at a time."""
    knots = script.knots
    if not knots:
        return nominal_m
    if t_s <= knots[0][0]:
        return knots[0][1]
    for (t0, a), (t1, b) in itertools.pairwise(knots):
        if t_s < t1:
            share = smooth_step(t_s, t0, t1 - t0) if script.smooth else (t_s - t0) / (t1 - t0)
            return a + share * (b - a)
    return knots[-1][1]


def object_distance_m(script: GraspedObject, t_s: float) -> float:
    """Distance of the object from its place between the fingers, along gripper z."""
    start, end = script.arrive_s
    gone, away = script.leave_s
    here = smooth_step(t_s, start, end - start) - smooth_step(t_s, gone, away - gone)
    return (1.0 - here) * script.distance_m


def prop_offset_m(script: Prop, t_s: float) -> Array | None:
    """Offset (3,) of a prop from its place, gripper axes; None while it isn't there."""
    if not script.start_s <= t_s < script.end_s:
        return None
    here = pulse(t_s, script.start_s, script.end_s, script.move_s)
    sway = math.sin(2.0 * math.pi * script.sway_hz * t_s)
    return (1.0 - here) * np.array(script.from_m) + sway * np.array(script.sway_m)


def defocus_sigma_px(scripts: tuple[Defocus, ...], t_s: float) -> float:
    """Standard deviation of the added blur; several add as variances."""
    return math.sqrt(sum((s.sigma_px * pulse(t_s, s.start_s, s.end_s, s.ramp_s)) ** 2 for s in scripts))


def exposure(light: Light, t_s: float) -> float:
    """Factor on all grey values.  The automatic exposure follows each step with one time constant, in closed form."""
    product = light.exposure * (1.0 + light.flicker * math.sin(2.0 * math.pi * light.flicker_hz * t_s))
    for step in light.steps:
        since = t_s - step.at_s
        if since >= 0.0:
            left = math.exp(-since / light.auto_exposure_s) if light.auto_exposure_s > 0.0 else 1.0
            product *= step.factor**left
    return product


def lamp_direction(look: FingerLook, t_s: float) -> Array:
    """Unit vector (3,) to the lamp, camera axes; between two of its places it passes along the arc between them."""
    here = _unit(look.lamp_cam)
    for change in look.lamp_changes:
        share = smooth_step(t_s, change.at_s, change.time_s)
        if share > 0.0:
            here = _unit((1.0 - share) * here + share * _unit(change.lamp_cam))
    return here


def _unit(direction: Array | tuple[float, float, float]) -> Array:
    return np.asarray(direction, dtype=float) / np.linalg.norm(direction)


Light32 = NDArray[np.float32]
_BANK_MARGIN_PX = 96
_SAMPLED_FROM_PX = 0.8
_COARSE_FROM_PX = 4.0  # a shadow with a softer border may be computed on coarse cells


class SensorModel:
    """Turns the light on the sensor (DN at exposure 1, float32) into an 8-bit image."""

    def __init__(self, rays: RayGrid, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self._size = (rays.height_px, rays.width_px)
        self._vignette = self._fall_off(rays)
        rng = np.random.default_rng([seed, 3])
        shape = (rays.height_px + _BANK_MARGIN_PX, rays.width_px + _BANK_MARGIN_PX)
        banks = [rng.standard_normal(shape, np.float32) for _ in range(2)]
        self._banks = [(b - b.mean()) / b.std() for b in banks]

    def expose(self, light: Light32, index: int, time_s: float) -> NDArray[np.uint8]:
        """Image of frame ``index``; ``light`` is overwritten."""
        scenario = self._scenario
        cv2.multiply(light, self._vignette, light, scale=exposure(scenario.light, time_s))
        for shadow in scenario.light.shadows:
            if shadow.start_s < time_s < shadow.end_s:
                cv2.multiply(light, self._shadow(shadow, time_s), light)
        light = blur(light, defocus_sigma_px(scenario.defocus, time_s))
        self._add_noise(light, index)
        if scenario.sensor.response == "srgb":
            light = srgb_dn(light)
        image = np.asarray(cv2.convertScaleAbs(light), dtype=np.uint8)
        return image if scenario.sensor.jpeg_quality == 0 else _jpeg(image, scenario.sensor.jpeg_quality)

    def _add_noise(self, light: Light32, index: int) -> None:
        """Two fixed noise images, each at a random offset, mixed by a random angle: cheap, and new for every frame."""
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
        """Factor on all pixels: a band that travels across the view, its borders half cosine waves."""
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
        """1 at the centre, less by the square of the distance; zero outside the lens's domain."""
        height, width = self._size
        u = np.linspace(-1.0, 1.0, width, dtype=np.float32)
        v = np.linspace(-1.0, 1.0, height, dtype=np.float32)
        fall_off = 1.0 - np.float32(0.5 * self._scenario.sensor.vignetting) * (u[None, :] ** 2 + v[:, None] ** 2)
        if not rays.seen.all():
            fall_off = fall_off * rays.enlarge(rays.seen.astype(np.float32))
        return np.ascontiguousarray(fall_off, dtype=np.float32)


def blur(light: Light32, sigma_px: float) -> Light32:
    """Gaussian blur with the exact variance however small: three taps where a sampled Gaussian would be too narrow."""
    if sigma_px == 0.0:
        return light
    if sigma_px >= _SAMPLED_FROM_PX:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px), dtype=np.float32)
    side = 0.5 * sigma_px**2
    taps = np.array([side, 1.0 - 2.0 * side, side], np.float32)
    return np.asarray(cv2.sepFilter2D(light, -1, taps, taps), dtype=np.float32)


def srgb_dn(light_dn: Light32) -> Light32:
    """Grey values of light by IEC 61966-2-1, both in DN from 0 to 255; more than 255 saturates."""
    share = np.minimum(light_dn * np.float32(1.0 / 255.0), np.float32(1.0))
    curved = 1.055 * cv2.pow(share, 1.0 / 2.4) - 0.055
    return np.asarray(255.0 * np.where(share <= 0.0031308, 12.92 * share, curved), dtype=np.float32)


def _jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    done, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "OpenCV could not encode a grey image as JPEG"
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
