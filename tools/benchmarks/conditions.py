"""The conditions of ``tools/bench accuracy`` as data: what each changes in an ordinary scene, and what to reach.

An ordinary scene is a gripper that stands still before moderate clutter that moves, with the simulator's usual noise.
A condition draws its own values from the generator that it is given; everything else is drawn by
:mod:`benchmarks.scenes`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.drawn import Changes, Draft, Draw, change, drawn, make, one_of, uniform, whole, with_
from gripmon.simulate.scenario import (
    Background,
    Bump,
    Cover,
    Creep,
    Defocus,
    GraspedObject,
    JawScript,
    Light,
    Scenario,
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
class SceneDraft(Draft):
    """And the jaw's range."""

    jaw_range_m: tuple[float, float]

    @property
    def duration_s(self) -> float:
        return self.frames / FPS


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
    changes: Changes | Draw = field(default_factory=dict)
    jaw_sigma_m: float | None = 0.0
    frames: int = FRAMES
    scenes: int = SCENES
    judged_s: float = 0.0
    always_seen: bool = True
    standing: bool = False
    missing_finger: bool = False
    bevel_m: tuple[float, float] | None = None
    taught: bool = False


def _clean(draft: SceneDraft) -> Changes:
    """Neither texture nor noise; the camera creeps by some pixels, so that no two frames are the same."""
    dark_table = draft.rng.random() < 0.5
    level_dn = draft.uniform(10.0, 25.0) if dark_table else draft.uniform(180.0, 215.0)
    shift_m = 1e-4 * draft.rng.normal(0.0, 1.0, 2)
    return {
        "background": Background(kind="plain", contrast=0.0, level_dn=level_dn, boxes=0, cables=0, motion="still"),
        "fingers": with_(draft.fingers, texture=0.0, carriers=False, level_dn=draft.uniform(110.0, 150.0)),
        "sensor": with_(draft.sensor, read_noise_dn=0.0, shot_noise_dn=0.0, exposure_time_s=0.0),
        "mount": (
            Creep(
                law="linear",
                time_s=draft.duration_s,
                tcp_shift_m=(float(shift_m[0]), float(shift_m[1])),
                translation_m=(0.0, 0.0, 1e-4 * draft.sign()),
            ),
        ),
    }


def _standing(draft: SceneDraft) -> Changes:
    """Without vignetting, so that the noise of a pixel follows from the light alone (see :mod:`benchmarks.bound`)."""
    changes = _clean(draft)
    del changes["mount"]
    return {**changes, "sensor": with_(draft.sensor, vignetting=0.0)}


def _clutter(kind: str, **others: Any) -> Draw:
    """Moving clutter, unless ``others`` say otherwise."""
    usual = {"motion": one_of("wander", "linear", "stop_and_go"), "speed_m_per_s": uniform(0.06, 0.15)}
    cluttered = change("background", kind=kind, boxes=45, cables=14, contrast=0.9, **usual)
    return lambda draft: with_(cluttered(draft), **others)


def _grasp(draft: SceneDraft) -> Changes:
    """Comes within 0.4 s, the jaws close on it within 0.3 s and hold it."""
    width_m = max(draft.opening_m - draft.uniform(0.004, 0.010), 0.008)
    size = (width_m, draft.uniform(0.02, 0.036), 0.04)
    grasped = GraspedObject(
        size_m=size,
        depth_m=draft.uniform(0.008, 0.022),
        side_m=draft.uniform(-0.006, 0.006),
        arrive_s=(0.1, 0.5),
        leave_s=(1e5, 1e5 + 1.0),
    )
    return {"grasped": grasped, "jaw": JawScript(knots=((0.5, draft.opening_m), (0.8, width_m)))}


def _hand(draft: SceneDraft) -> Changes:
    kind = "hand" if draft.rng.random() < 0.5 else "sheet"
    side = draft.one_of("left", "right", "top", "bottom")
    return {"covers": (Cover(kind=kind, side=side, start_s=0.3, end_s=1.4, move_s=0.3, distance_m=0.05),)}


def _swing(draft: SceneDraft) -> Vibration:
    """Slowly: up to 2 px within an exposure of 14 ms, 5 px from frame to frame.

    At 2 Hz the mean pose over the exposure is within 0.1 % of the swing of that in its middle, the truth: 1.5 µm.
    """
    angle = draft.uniform(0.0, 2.0 * np.pi)
    return Vibration(frequency_hz=2.0, tcp_shift_m=(1.3e-3 * float(np.cos(angle)), 1.3e-3 * float(np.sin(angle))))


def _vibration(draft: SceneDraft) -> Vibration:
    shift = (draft.sign() * draft.uniform(1e-4, 2e-4), draft.sign() * draft.uniform(1e-4, 3e-4))
    return Vibration(frequency_hz=draft.uniform(9.0, 17.0), tcp_shift_m=shift)


def _shadow(draft: SceneDraft) -> Light:
    shadow = Shadow(
        start_s=0.0,
        end_s=draft.duration_s,
        depth=draft.uniform(0.4, 0.7),
        width=draft.uniform(0.3, 0.6),
        softness=draft.uniform(0.01, 0.06),
        angle_deg=draft.uniform(-90.0, 90.0),
    )
    return Light(shadows=(shadow,))


def _jaw(**settings: Any) -> Draw:
    """Closes and opens by up to 10 mm within a second."""

    def cycle(draft: SceneDraft) -> JawScript:
        low, high = draft.jaw_range_m
        ends = [draft.opening_m + way for way in (draft.sign() * draft.uniform(5e-3, 10e-3), 0.0)]
        first, second = (min(max(end, low + 1e-3), high - 1e-3) for end in ends)
        t = draft.duration_s
        return JawScript(knots=((0.1 * t, draft.opening_m), (0.5 * t, first), (0.9 * t, second)), **settings)

    return cycle


def _bump(along_m: tuple[float, float], sigma_m: float) -> Draw:
    def bump(draft: SceneDraft) -> Bump:
        x, y = draft.sign() * np.array(along_m) + draft.rng.normal(0.0, sigma_m, 2)
        return Bump(at_s=BUMP_AT_S, tcp_shift_m=(float(x), float(y)))

    return bump


BUMP_AT_S = 9.5 / FPS
"""Between two frames, so that the jump is in no frame's exposure."""
_BUMP: dict[str, Any] = {"frames": 48, "judged_s": BUMP_AT_S + 5.0 / FPS}
_JAW_NOISE_M, _JAW_OFFSET_M = 3e-5, 3e-4
_BEVEL_M = (2e-4, 5e-4)

_EXACT, _TOLD_NOISE, _TOLD_OFFSET, _USUAL = 0.0, _JAW_NOISE_M, _JAW_OFFSET_M, None
"""What the monitor is told of the jaw's report."""
CONDITIONS: tuple[Condition, ...] = (
    Condition("clean", "plain table, even fingers, no noise", CLEAN, _clean, frames=9, scenes=40),
    Condition("standing", "as clean, nothing moves, usual noise", CLEAN, _standing, standing=True),
    Condition("ordinary", "some clutter moves, usual noise", HARD, standing=True),
    Condition(
        "clutter printed", "boxes, cables, print move", HARD, {"background": _clutter("printed")}, standing=True
    ),
    Condition("clutter chequer", "a chequered floor moves", HARD, {"background": _clutter("chequer")}, standing=True),
    Condition(
        "clutter still", "printed clutter that stands still", HARD, {"background": _clutter("printed", motion="still")}
    ),
    Condition("grasp", "an object hides inner corners", HARD, _grasp, frames=48, scenes=10),
    Condition("hand", "a hand or sheet covers all", HARD, _hand, frames=60, scenes=8, always_seen=False),
    Condition("finger gone", "one finger isn't there", HARD, missing_finger=True),
    *(
        Condition(f"defocus {n} px", f"Gaussian blur of {n} px added", POOR, {"defocus": (Defocus(sigma_px=float(n)),)})
        for n in (1, 2, 3)
    ),
    Condition(
        "smeared table", "the table rushes by, 12 ms exposure", POOR,
        {
            "background": _clutter("printed", motion="linear", speed_m_per_s=0.35),
            "sensor": change("sensor", exposure_time_s=0.012),
        },
    ),
    Condition(
        "smeared gripper", "the camera swings, 14 ms exposure", POOR,
        {"mount": (_swing,), "sensor": change("sensor", exposure_time_s=0.014)},
    ),
    Condition(
        "noise", "read noise 5 DN, strong shot noise", HARD,
        {"sensor": change("sensor", read_noise_dn=uniform(4.0, 6.0), shot_noise_dn=uniform(0.15, 0.3))},
    ),
    Condition("saturation", "over-exposed 1.4 to 2.2 times", POOR, {"light": make(Light, exposure=uniform(1.4, 2.2))}),
    Condition("shadow", "a shadow sweeps over", HARD, {"light": _shadow}),
    Condition(
        "flicker", "light flickers by 20 to 40 %", HARD,
        {"light": make(Light, flicker=uniform(0.2, 0.4), flicker_hz=uniform(96.0, 104.0))},
    ),
    Condition(
        "highlights", "lamps reflected in glossy fingers", HARD,
        {"fingers": change("fingers", highlights=uniform(1.0, 4.0))},
    ),
    Condition("jpeg", "quality 60 to 80", HARD, {"sensor": change("sensor", jpeg_quality=whole(60, 81))}),
    Condition("jaw exact", "jaw cycle, opening exact", HARD, {"jaw": _jaw()}),
    Condition(
        "jaw noise", "jaw cycle, 30 µm noise, monitor told so", HARD, {"jaw": _jaw(reported_noise_m=_JAW_NOISE_M)},
        _TOLD_NOISE,
    ),
    Condition(
        "jaw offset", "jaw cycle, 0.3 mm off, monitor told so", HARD, {"jaw": _jaw(reported_offset_m=_JAW_OFFSET_M)},
        _TOLD_OFFSET,
    ),
    Condition(
        "jaw offset untold", "0.3 mm off, monitor's default sigma", HARD,
        {"jaw": _jaw(reported_offset_m=_JAW_OFFSET_M)}, _USUAL,
    ),
    Condition("jaw unreported", "jaw cycle, opening unknown", HARD, {"jaw": _jaw(reported=False)}, _USUAL),
    Condition("bevel untaught", "bevels of 0.2 to 0.5 mm on all edges", HARD, bevel_m=_BEVEL_M),
    Condition("bevel taught", "the same after gripmon teach", HARD, bevel_m=_BEVEL_M, taught=True),
    Condition("vibration", "mount vibrates by 0.1 to 0.3 mm", HARD, {"mount": (_vibration,)}),
    Condition(
        "bump 1.5 mm", "sideways jump, from 5 frames after", HARD, {"mount": (_bump((1.5e-3, 0.0), 3e-4),)}, **_BUMP
    ),
    Condition(
        "bump 4.5 mm", "jump along y, from 5 frames after", HARD, {"mount": (_bump((0.0, 4.5e-3), 2e-4),)}, **_BUMP
    ),
)  # fmt: skip


def scenario(condition: Condition, draft: SceneDraft) -> Scenario:
    """The condition's scenario: an ordinary scene with its changes."""
    sections: dict[str, Any] = {
        "name": condition.name,
        "fps": FPS,
        "duration_s": draft.duration_s,
        "background": draft.background,
        "fingers": draft.fingers,
        "sensor": draft.sensor,
        "jaw": JawScript(knots=((0.0, draft.opening_m),)),
    }
    return Scenario(**{**sections, **drawn(draft, condition.changes)})
