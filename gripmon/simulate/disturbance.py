"""What moves, as closed functions of time: camera mount, fingers, jaws, things in the way, light.  No history."""

from __future__ import annotations

import itertools
import math

import numpy as np

from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array
from gripmon.simulate.scenario import (
    Bump,
    Cover,
    Creep,
    Defocus,
    GraspedObject,
    JawScript,
    Light,
    MountMotion,
    MountScript,
    Prop,
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
    """Rises within ``ramp_s`` from ``start_s`` on, falls within ``ramp_s`` up to ``end_s``."""
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
    """Labels of what the mount does at a time; empty while it rests."""
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
    """Rotation vector (3,) about the pivot and translation (3,) of a motion at full size, camera axes.

    Raises ValueError when no turn about the pivot can shift the TCP so far.
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
    """4x4 motion that turns by a rotation vector about the pivot, then shifts."""
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
    """How far the object still is from its place between the fingers, along gripper z."""
    start, end = script.arrive_s
    gone, away = script.leave_s
    here = smooth_step(t_s, start, end - start) - smooth_step(t_s, gone, away - gone)
    return (1.0 - here) * script.distance_m


def prop_offset_m(script: Prop, t_s: float) -> Array | None:
    """How far a prop is from its place (3,), gripper axes; None while it isn't there."""
    if not script.start_s <= t_s < script.end_s:
        return None
    here = pulse(t_s, script.start_s, script.end_s, script.move_s)
    sway = math.sin(2.0 * math.pi * script.sway_hz * t_s)
    return (1.0 - here) * np.array(script.from_m) + sway * np.array(script.sway_m)


def cover_share(script: Cover, t_s: float) -> float:
    """How far a cover has moved in, 0 (outside the view) to 1."""
    return pulse(t_s, script.start_s, script.end_s, script.move_s)


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
