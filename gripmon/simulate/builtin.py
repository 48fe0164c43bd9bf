"""Named scenarios.  All times scale with the requested duration."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from gripmon.simulate.scenario import (
    Background,
    BentFinger,
    Bump,
    Cover,
    Creep,
    GraspedObject,
    JawScript,
    Light,
    LightStep,
    Pairs,
    Scenario,
    Sensor,
    Shadow,
    Vibration,
)

_PAIRS = 20
_PAIR_FPS = 0.1


def _between_frames(t_s: float, fps: float) -> float:
    """The last midpoint between two frames before ``t_s``: a jump at that time is in no frame's exposure."""
    return max(math.floor(t_s * fps - 0.5) + 0.5, 0.5) / fps


_HALF_OPEN_M, _WIDE_M, _NARROW_M = 0.034, 0.044, 0.024
_OPENINGS_M = (_HALF_OPEN_M, _WIDE_M, _NARROW_M, _WIDE_M, _NARROW_M, _HALF_OPEN_M)
_GRASPED_M = GraspedObject().size_m[0]


def _knock(t: float, fps: float, x_m: float, y_m: float) -> tuple[Bump]:
    return (Bump(at_s=_between_frames(0.5 * t, fps), tcp_shift_m=(x_m, y_m)),)


_TIMED: dict[str, tuple[float, Callable[[float, float], dict[str, Any]]]] = {
    "demo": (20.0, lambda t, fps: {
        "mount": (Creep(start_s=0.08 * t, time_s=0.1 * t, tcp_shift_m=(0.0012, 4e-4)), *_knock(t, fps, 2e-4, 0.0045)),
        "covers": (Cover(start_s=0.74 * t, end_s=0.86 * t, move_s=0.025 * t),),
        "light": Light(flicker=0.02, shadows=(Shadow(start_s=0.58 * t, end_s=0.7 * t, depth=0.35),)),
    }),
    "static": (10.0, lambda _t, _fps: {}),
    "clutter": (10.0, lambda _t, _fps: {"background": Background(
        kind="printed", boxes=45, cables=14, contrast=0.9, motion="stop_and_go", speed_m_per_s=0.12
    )}),
    "creep": (20.0, lambda t, _fps: {
        "mount": (Creep(start_s=0.1 * t, time_s=0.25 * t, tcp_shift_m=(0.0015, 0.0003)),),
        "background": Background(kind="speckle"),
    }),
    "bump": (10.0, lambda t, fps: {
        "mount": _knock(t, fps, 0.0002, 0.0045), "background": Background(kind="chequer"),
    }),
    "vibration": (8.0, lambda t, _fps: {"mount": (
        Vibration(start_s=0.25 * t, end_s=0.75 * t, frequency_hz=13.0, tcp_shift_m=(0.00015, 0.0003)),
    )}),
    "jaw_cycle": (10.0, lambda t, _fps: {"jaw": JawScript(knots=tuple(
        (k * t / (len(_OPENINGS_M) - 1), opening_m) for k, opening_m in enumerate(_OPENINGS_M)
    ))}),
    "grasp": (12.0, lambda t, _fps: {
        "grasped": GraspedObject(arrive_s=(0.12 * t, 0.35 * t), leave_s=(0.72 * t, 0.92 * t)),
        "jaw": JawScript(knots=(
            (0.36 * t, _HALF_OPEN_M), (0.44 * t, _GRASPED_M), (0.63 * t, _GRASPED_M), (0.71 * t, _HALF_OPEN_M),
        )),
        "background": Background(kind="speckle"),
    }),
    "hand": (12.0, lambda t, _fps: {"covers": (
        Cover(start_s=0.2 * t, end_s=0.45 * t, move_s=0.05 * t),
        Cover(kind="sheet", side="left", start_s=0.6 * t, end_s=0.85 * t, move_s=0.04 * t),
    )}),
    "lighting": (12.0, lambda t, _fps: {
        "light": Light(
            flicker=0.08, steps=(LightStep(at_s=0.25 * t, factor=0.45), LightStep(at_s=0.6 * t, factor=2.6)),
            auto_exposure_s=0.04 * t,
            shadows=(
                Shadow(start_s=0.35 * t, end_s=0.55 * t),
                Shadow(start_s=0.75 * t, end_s=0.95 * t, softness=0.01, angle_deg=75.0),
            ),
        ),
        "sensor": Sensor(jpeg_quality=80),
    }),
    # The robot moves over a table; then something hits the camera.
    "work": (3.0, lambda t, fps: {"mount": _knock(t, fps, 0.0, 0.0009)}),
    "bent_finger": (10.0, lambda _t, _fps: {}),
}  # fmt: skip
"""Default duration (s) of each, and a function from duration (s) and frame rate (1/s) to what happens."""
_SERIES = {"series1": ((1.5e-3, 0.0), 3e-4), "series2": ((0.0, 4.5e-3), 2e-4)}
"""1: a cable pulls sideways, 1.5 ± 0.3 mm; 2: the mount is rotated, 4.5 ± 0.2 mm.  As in the paper, the gripper is
parked on the calibration plate in both images of a pair.
"""
SCENARIO_NAMES = (*_TIMED, *_SERIES)
DEFAULT_FPS = 30.0


def make_scenario(
    name: str,
    *,
    duration_s: float | None = None,
    fps: float | None = None,
    finger: str = "left",
    jaw_opening_m: float | None = None,
) -> Scenario:
    """A named scenario, its times scaled to a duration (the default if None).

    ``finger`` is the one that ``bent_finger`` bends, ``jaw_opening_m`` the jaw opening in ``work`` (nominal if None).
    The series are the paper's: twenty pairs of images without a time scale, so that a duration or a frame rate is
    refused.  ValueError for an unknown name.
    """
    if name in _SERIES:
        if duration_s is not None or fps is not None:
            raise ValueError(f"scenario: {name} is {2 * _PAIRS} single images; neither duration_s nor fps")
        shift_m, sigma_m = _SERIES[name]
        plate = Background(
            kind="discs", distance_m=0.0, level_dn=180.0, contrast=0.7, boxes=0, cables=0, motion="still",
            defocus_px=0.0,
        )  # fmt: skip
        pairs = Pairs(tcp_shift_m=shift_m, tcp_shift_sigma_m=sigma_m)
        return Scenario(name=name, duration_s=2 * _PAIRS / _PAIR_FPS, fps=_PAIR_FPS, pairs=pairs, background=plate)
    if name not in _TIMED:
        raise ValueError(f"scenario: there is no '{name}'; one of {', '.join(SCENARIO_NAMES)}")
    default_s, happening = _TIMED[name]
    t, rate = default_s if duration_s is None else duration_s, DEFAULT_FPS if fps is None else fps
    parts = happening(t, rate)
    if name == "bent_finger":
        bent = BentFinger(finger=finger, tip_shift_m=(0.0008, 0.0012, 0.0), start_s=_between_frames(0.5 * t, rate))
        parts["bent_fingers"] = (bent,)
    elif name == "work" and jaw_opening_m is not None:
        parts["jaw"] = JawScript(knots=((0.0, jaw_opening_m),))
    return Scenario(name=name, duration_s=t, fps=rate, **parts)
