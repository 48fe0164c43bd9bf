"""``tools/bench look --motions``: frames until a small motion of the mount is noticed, without and with the look."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from benchmarks.conditions import CONDITIONS
from benchmarks.scenes import Scene, make_scene
from gripmon.model.records import AlertKind
from gripmon.monitor import Monitor
from gripmon.simulate import Simulator
from gripmon.simulate.scenario import Defocus, JawScript, Light, LightStep, Tilt

BEGINS_S = 10.0
"""When the mount moves: by then the look is learnt, and so is how the stream scatters."""

DRIFT_S, DRIFT_M, COUNTED_FROM_M = 3.0, 4e-4, 1e-4
"""The drift's time and size, and from what size on frames until it is noticed are counted."""

_NOTICED = (AlertKind.STEP, AlertKind.DRIFT)


@dataclass(frozen=True)
class Motion:
    """A motion of the mount, and for how many frames it is waited for; ``shift_m`` in camera axes, within ``time_s``;
    ``counted_s``: after its beginning frames are counted.
    """

    name: str
    fps: float
    frames: int
    shift_m: tuple[float, float, float]
    time_s: float = 0.0
    counted_s: float = 0.0
    disturbed: bool = False


MOTIONS = (
    Motion("step 0.05 mm, x, 15 frames/s", 15.0, 60, (5e-5, 0.0, 0.0)),
    Motion("step 0.05 mm, y, 15 frames/s", 15.0, 60, (0.0, 5e-5, 0.0)),
    Motion("step 0.05 mm, x, 60 frames/s", 60.0, 60, (5e-5, 0.0, 0.0)),
    Motion("step 0.02 mm, x, 15 frames/s", 15.0, 60, (2e-5, 0.0, 0.0)),
    Motion("step 0.05 mm, z, 15 frames/s", 15.0, 60, (0.0, 0.0, 5e-5)),
    Motion(
        "drift 0.4 mm within 3 s, x; jaws, light, focus change; 15 frames/s",
        15.0,
        45,
        (DRIFT_M, 0.0, 0.0),
        DRIFT_S,
        # A half cosine wave: where it passes what is counted from.
        DRIFT_S * math.acos(1.0 - 2.0 * COUNTED_FROM_M / DRIFT_M) / math.pi,
        disturbed=True,
    ),
)

HEAD = (
    "| motion of the mount | frames until noticed, without the look | with it | noticed before it, without | with |\n"
    "| --- | --- | --- | --- | --- |"
)


def motion_row(motion: Motion, seed: int, scenes: int, monitors_of: Callable[[Scene], list[Monitor]]) -> str:
    """A line of the table: of each scene the number of frames until an alert, and how many had one before it."""
    late: list[list[str]] = [[], []]
    early = [0, 0]
    for number in range(scenes):
        scene = _moving(motion, seed, number)
        print(f"look: {motion.name}, {number}", file=sys.stderr)
        for k, noticed in enumerate(_noticed(scene, monitors_of(scene))):
            counted = math.ceil((BEGINS_S + motion.counted_s) * motion.fps)
            moves = math.ceil(BEGINS_S * motion.fps)
            early[k] += any(index < moves for index in noticed)
            after = [index for index in noticed if index >= moves]
            late[k].append(str(max(after[0] - counted + 1, 0)) if after else "–")
    cells = [motion.name, *(", ".join(frames) for frames in late), *(f"{count} of {scenes}" for count in early)]
    return f"| {' | '.join(cells)} |"


def _noticed(scene: Scene, monitors: list[Monitor]) -> list[list[int]]:
    """For each monitor the frames with an alert of a step or a drift."""
    noticed: list[list[int]] = [[] for _ in monitors]
    for index in range(scene.frames):
        frame = scene.simulator.frame(index)
        for monitor, frames in zip(monitors, noticed, strict=True):
            record = monitor.process(frame)
            monitor.learn()
            frames += [index] if any(alert.kind in _NOTICED for alert in record.alerts) else []
    return noticed


def _moving(motion: Motion, seed: int, number: int) -> Scene:
    """An ordinary scene, whose mount moves."""
    frames = math.ceil((BEGINS_S + motion.counted_s) * motion.fps) + motion.frames
    condition = next(each for each in CONDITIONS if each.name == "ordinary")
    scene = make_scene(condition, seed, number, frames)
    before = scene.simulator
    # Between two frames, so that none shows half of a step.
    tilt = Tilt(start_s=BEGINS_S - 0.5 / motion.fps, time_s=motion.time_s, translation_m=motion.shift_m)
    changes: dict[str, Any] = {"fps": motion.fps, "duration_s": frames / motion.fps, "mount": (tilt,)}
    if motion.disturbed:
        changes |= _disturbances(before, frames / motion.fps)
    scenario = msgspec.structs.replace(before.scenario, **changes)
    simulator = Simulator(before.camera, before.gripper, before.nominal_cam_T_grip, scenario, before.seed)
    return replace(scene, simulator=simulator, fps=motion.fps)


def _disturbances(simulator: Simulator, duration_s: float) -> dict[str, Any]:
    """Jaws that close and open by 4 mm every two seconds, light that changes by a fifth with them, and the focus."""
    opening_m = simulator.scenario.jaw.knots[0][1]
    times_s = np.arange(0.0, duration_s + 1.0, 1.0).tolist()
    ways_m = [0.0 if k % 2 == 0 else -4e-3 for k in range(len(times_s))]
    knots = tuple((at_s, opening_m + way_m) for at_s, way_m in zip(times_s, ways_m, strict=True))
    steps = tuple(LightStep(at_s=at_s + 0.5, factor=0.8 if k % 2 else 1.25) for k, at_s in enumerate(times_s))
    focus = tuple(Defocus(sigma_px=1.0, start_s=at_s, end_s=at_s + 2.0, ramp_s=1.0) for at_s in times_s[1::4])
    return {"jaw": JawScript(knots=knots), "light": Light(steps=steps), "defocus": focus}
