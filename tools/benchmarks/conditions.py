"""The conditions of ``tools/bench accuracy`` as data: what each changes in an ordinary scene, and what to reach.

An ordinary scene is a gripper that stands still before moderate clutter that moves, with the simulator's usual noise.
A condition draws its own values from the generator that it is given; everything else is drawn by
:mod:`benchmarks.scenes`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from gripmon.simulate.scenario import (
    Background,
    Bump,
    Cover,
    Creep,
    Defocus,
    FingerLook,
    GraspedObject,
    JawScript,
    Light,
    Scenario,
    Sensor,
    Shadow,
    Vibration,
)

FPS = 30.0
SCENES, FRAMES = 10, 32
"""Scenes of a condition and frames of a scene, where it doesn't say otherwise.  Systematic errors are constant in a
scene: their spread shows only over many."""

Limit = tuple[float, float, float]
CLEAN: Limit = (0.5, 1.5, 2.5)
HARD: Limit = (1.5, 5.0, 8.0)
POOR: Limit = (3.0, 10.0, 20.0)
"""To reach: mean error of the TCP in camera x, y, z, µm."""


@dataclass(frozen=True)
class Draw:
    """What is drawn before the condition: the generator, length, opening, the jaw's range and the look of things."""

    rng: np.random.Generator
    frames: int
    opening_m: float
    jaw_range_m: tuple[float, float]
    background: Background
    fingers: FingerLook
    sensor: Sensor

    @property
    def duration_s(self) -> float:
        return self.frames / FPS

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice((-1.0, 1.0)))


@dataclass(frozen=True)
class Condition:
    """A row of the table.

    ``changes``: the scenario's sections that differ from an ordinary scene.  ``jaw_sigma_m``: what the monitor is told
    about the reported opening (None: the product's default).  ``judged_s``: errors count from this time on;
    ``always_seen``: every judged frame has to be measured.  ``standing``: nothing moves but the background, so the
    smoothed transform has one second to settle.  ``missing_finger``: only one finger is drawn.  ``bevel_m``: range of
    bevels on all edges; ``taught``: they were taught from images at the reference, which the scene is some tenths of a
    millimetre and of a degree away from.
    """

    name: str
    what: str
    limit_um: Limit | None
    changes: Callable[[Draw], dict[str, Any]]
    jaw_sigma_m: float | None = 0.0
    frames: int = FRAMES
    scenes: int = SCENES
    judged_s: float = 0.0
    always_seen: bool = True
    standing: bool = False
    missing_finger: bool = False
    bevel_m: tuple[float, float] | None = None
    taught: bool = False


def _with(settings: Any, **changes: Any) -> Any:
    return msgspec.structs.replace(settings, **changes)


def _clean(draw: Draw) -> dict[str, Any]:
    """Neither texture nor noise; the camera creeps by some pixels, so that no two frames are the same."""
    dark_table = draw.rng.random() < 0.5
    level_dn = draw.uniform(10.0, 25.0) if dark_table else draw.uniform(180.0, 215.0)
    shift_m = 1e-4 * draw.rng.normal(0.0, 1.0, 2)
    return {
        "background": Background(kind="plain", contrast=0.0, level_dn=level_dn, boxes=0, cables=0, motion="still"),
        "fingers": _with(draw.fingers, texture=0.0, carriers=False, level_dn=draw.uniform(110.0, 150.0)),
        "sensor": _with(draw.sensor, read_noise_dn=0.0, shot_noise_dn=0.0, exposure_time_s=0.0),
        "mount": (
            Creep(
                law="linear",
                time_s=draw.duration_s,
                tcp_shift_m=(float(shift_m[0]), float(shift_m[1])),
                translation_m=(0.0, 0.0, 1e-4 * draw.sign()),
            ),
        ),
    }


def _standing(draw: Draw) -> dict[str, Any]:
    """Without vignetting, so that the noise of a pixel follows from the light alone (see :mod:`benchmarks.bound`)."""
    changes = _clean(draw)
    del changes["mount"]
    return {**changes, "sensor": _with(draw.sensor, vignetting=0.0)}


def _clutter(kind: str) -> Callable[[Draw], dict[str, Any]]:
    def changes(draw: Draw) -> dict[str, Any]:
        motion = str(draw.rng.choice(("wander", "linear", "stop_and_go")))
        return {
            "background": _with(
                draw.background,
                kind=kind,
                boxes=45,
                cables=14,
                contrast=0.9,
                motion=motion,
                speed_m_per_s=draw.uniform(0.06, 0.15),
            )
        }

    return changes


def _clutter_still(draw: Draw) -> dict[str, Any]:
    return {"background": _with(_clutter("printed")(draw)["background"], motion="still")}


def _grasp(draw: Draw) -> dict[str, Any]:
    """Comes within 0.4 s, the jaws close on it within 0.3 s and hold it."""
    width_m = max(draw.opening_m - draw.uniform(0.004, 0.010), 0.008)
    size = (width_m, draw.uniform(0.02, 0.036), 0.04)
    grasped = GraspedObject(
        size_m=size,
        depth_m=draw.uniform(0.008, 0.022),
        side_m=draw.uniform(-0.006, 0.006),
        arrive_s=(0.1, 0.5),
        leave_s=(1e5, 1e5 + 1.0),
    )
    return {"grasped": grasped, "jaw": JawScript(knots=((0.5, draw.opening_m), (0.8, width_m)))}


def _hand(draw: Draw) -> dict[str, Any]:
    kind = "hand" if draw.rng.random() < 0.5 else "sheet"
    side = str(draw.rng.choice(("left", "right", "top", "bottom")))
    cover = Cover(kind=kind, side=side, start_s=0.3, end_s=1.4, move_s=0.3, distance_m=0.05)  # type: ignore[arg-type]
    return {"covers": (cover,)}


def _defocus(sigma_px: float) -> Callable[[Draw], dict[str, Any]]:
    return lambda draw: {"defocus": (Defocus(sigma_px=sigma_px),)}


def _smeared_background(draw: Draw) -> dict[str, Any]:
    """The table rushes by: smeared by some 30 px, the gripper sharp."""
    return {
        "background": _with(_clutter("printed")(draw)["background"], motion="linear", speed_m_per_s=0.35),
        "sensor": _with(draw.sensor, exposure_time_s=0.012),
    }


def _smeared_gripper(draw: Draw) -> dict[str, Any]:
    """The camera swings slowly: up to 2 px within the exposure, 5 px from frame to frame.

    At 2 Hz the mean pose over the exposure is within 0.1 % of the swing of that in its middle, the truth: 1.5 µm.
    """
    angle = draw.uniform(0.0, 2.0 * np.pi)
    shift = (1.3e-3 * float(np.cos(angle)), 1.3e-3 * float(np.sin(angle)))
    return {
        "mount": (Vibration(frequency_hz=2.0, tcp_shift_m=shift),),
        "sensor": _with(draw.sensor, exposure_time_s=0.014),
    }


def _vibration(draw: Draw) -> dict[str, Any]:
    shift = (draw.sign() * draw.uniform(1e-4, 2e-4), draw.sign() * draw.uniform(1e-4, 3e-4))
    return {"mount": (Vibration(frequency_hz=draw.uniform(9.0, 17.0), tcp_shift_m=shift),)}


def _noise(draw: Draw) -> dict[str, Any]:
    return {
        "sensor": _with(draw.sensor, read_noise_dn=draw.uniform(4.0, 6.0), shot_noise_dn=draw.uniform(0.15, 0.3)),
    }


def _saturation(draw: Draw) -> dict[str, Any]:
    """Over-exposed: bright parts of the table, and often a face, at full scale."""
    return {"light": Light(exposure=draw.uniform(1.4, 2.2))}


def _highlights(draw: Draw) -> dict[str, Any]:
    """Glossy fingers: a band of each face is several times brighter than the rest, often at full scale."""
    return {"fingers": _with(draw.fingers, highlights=draw.uniform(1.0, 4.0))}


def _shadow(draw: Draw) -> dict[str, Any]:
    shadow = Shadow(
        start_s=0.0,
        end_s=draw.duration_s,
        depth=draw.uniform(0.4, 0.7),
        width=draw.uniform(0.3, 0.6),
        softness=draw.uniform(0.01, 0.06),
        angle_deg=draw.uniform(-90.0, 90.0),
    )
    return {"light": Light(shadows=(shadow,))}


def _flicker(draw: Draw) -> dict[str, Any]:
    return {"light": Light(flicker=draw.uniform(0.2, 0.4), flicker_hz=draw.uniform(96.0, 104.0))}


def _jpeg(draw: Draw) -> dict[str, Any]:
    return {"sensor": _with(draw.sensor, jpeg_quality=int(draw.rng.integers(60, 81)))}


def _jaw(**settings: Any) -> Callable[[Draw], dict[str, Any]]:
    """Closes and opens by up to 10 mm within a second."""

    def changes(draw: Draw) -> dict[str, Any]:
        low, high = draw.jaw_range_m
        ends = [draw.opening_m + way for way in (draw.sign() * draw.uniform(5e-3, 10e-3), 0.0)]
        first, second = (min(max(end, low + 1e-3), high - 1e-3) for end in ends)
        t = draw.duration_s
        return {"jaw": JawScript(knots=((0.1 * t, draw.opening_m), (0.5 * t, first), (0.9 * t, second)), **settings)}

    return changes


def _bump(along_m: tuple[float, float], sigma_m: float) -> Callable[[Draw], dict[str, Any]]:
    def changes(draw: Draw) -> dict[str, Any]:
        x, y = draw.sign() * np.array(along_m) + draw.rng.normal(0.0, sigma_m, 2)
        return {"mount": (Bump(at_s=BUMP_AT_S, tcp_shift_m=(float(x), float(y))),)}

    return changes


def _ordinary(draw: Draw) -> dict[str, Any]:
    return {}


BUMP_AT_S = 9.5 / FPS
"""Between two frames, so that the jump is in no frame's exposure."""
_BUMP: dict[str, Any] = {"frames": 48, "judged_s": BUMP_AT_S + 5.0 / FPS}
_JAW_NOISE_M, _JAW_OFFSET_M = 3e-5, 3e-4
_BEVEL_M = (2e-4, 5e-4)

CONDITIONS: tuple[Condition, ...] = (
    Condition("clean", "plain table, even fingers, no noise", CLEAN, _clean, frames=9, scenes=40),
    Condition("standing", "as clean, nothing moves, usual noise", CLEAN, _standing, standing=True),
    Condition("ordinary", "some clutter moves, usual noise", HARD, _ordinary, standing=True),
    Condition("clutter printed", "boxes, cables, print move", HARD, _clutter("printed"), standing=True),
    Condition("clutter chequer", "a chequered floor moves", HARD, _clutter("chequer"), standing=True),
    Condition("clutter still", "printed clutter that stands still", HARD, _clutter_still),
    Condition("grasp", "an object hides inner corners", HARD, _grasp, frames=48, scenes=10),
    Condition("hand", "a hand or sheet covers all", HARD, _hand, frames=60, scenes=8, always_seen=False),
    Condition("finger gone", "one finger isn't there", HARD, _ordinary, missing_finger=True),
    Condition("defocus 1 px", "Gaussian blur of 1 px added", POOR, _defocus(1.0)),
    Condition("defocus 2 px", "Gaussian blur of 2 px added", POOR, _defocus(2.0)),
    Condition("defocus 3 px", "Gaussian blur of 3 px added", POOR, _defocus(3.0)),
    Condition("smeared table", "the table rushes by, 12 ms exposure", POOR, _smeared_background),
    Condition("smeared gripper", "the camera swings, 14 ms exposure", POOR, _smeared_gripper),
    Condition("noise", "read noise 5 DN, strong shot noise", HARD, _noise),
    Condition("saturation", "over-exposed 1.4 to 2.2 times", POOR, _saturation),
    Condition("shadow", "a shadow sweeps over", HARD, _shadow),
    Condition("flicker", "light flickers by 20 to 40 %", HARD, _flicker),
    Condition("highlights", "lamps reflected in glossy fingers", HARD, _highlights),
    Condition("jpeg", "quality 60 to 80", HARD, _jpeg),
    Condition("jaw exact", "jaw cycle, opening exact", HARD, _jaw()),
    Condition(
        "jaw noise",
        "jaw cycle, 30 µm noise, monitor told so",
        HARD,
        _jaw(reported_noise_m=_JAW_NOISE_M),
        jaw_sigma_m=_JAW_NOISE_M,
    ),
    Condition(
        "jaw offset",
        "jaw cycle, 0.3 mm off, monitor told so",
        HARD,
        _jaw(reported_offset_m=_JAW_OFFSET_M),
        jaw_sigma_m=_JAW_OFFSET_M,
    ),
    Condition(
        "jaw offset untold",
        "0.3 mm off, monitor's default sigma",
        HARD,
        _jaw(reported_offset_m=_JAW_OFFSET_M),
        jaw_sigma_m=None,
    ),
    Condition("jaw unreported", "jaw cycle, opening unknown", HARD, _jaw(reported=False), jaw_sigma_m=None),
    Condition("bevel untaught", "bevels of 0.2 to 0.5 mm on all edges", HARD, _ordinary, bevel_m=_BEVEL_M),
    Condition("bevel taught", "the same after gripmon teach", HARD, _ordinary, bevel_m=_BEVEL_M, taught=True),
    Condition("vibration", "mount vibrates by 0.1 to 0.3 mm", HARD, _vibration),
    Condition("bump 1.5 mm", "sideways jump, from 5 frames after", HARD, _bump((1.5e-3, 0.0), 3e-4), **_BUMP),
    Condition("bump 4.5 mm", "jump along y, from 5 frames after", HARD, _bump((0.0, 4.5e-3), 2e-4), **_BUMP),
)


def scenario(condition: Condition, draw: Draw) -> Scenario:
    """The condition's scenario: an ordinary scene with its changes."""
    sections: dict[str, Any] = {
        "name": condition.name,
        "fps": FPS,
        "duration_s": draw.duration_s,
        "background": draw.background,
        "fingers": draw.fingers,
        "sensor": draw.sensor,
        "jaw": JawScript(knots=((0.0, draw.opening_m),)),
    }
    return Scenario(**{**sections, **condition.changes(draw)})
