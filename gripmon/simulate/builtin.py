"""Named scenarios.  All times scale with the duration that is asked for."""

from __future__ import annotations

import math
from collections.abc import Callable

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
    """The last time before ``t_s`` in the middle between two frames: a jump there is in no frame's exposure."""
    return max(math.floor(t_s * fps - 0.5) + 0.5, 0.5) / fps


def _demo(t: float, fps: float) -> Scenario:
    return Scenario(
        name="demo",
        duration_s=t,
        fps=fps,
        mount=(
            Creep(start_s=0.08 * t, time_s=0.1 * t, tcp_shift_m=(0.0012, 0.0004)),
            Bump(at_s=_between_frames(0.5 * t, fps), tcp_shift_m=(0.0002, 0.0045)),
        ),
        covers=(Cover(start_s=0.74 * t, end_s=0.86 * t, move_s=0.025 * t),),
        light=Light(flicker=0.02, shadows=(Shadow(start_s=0.58 * t, end_s=0.7 * t, depth=0.35),)),
    )


def _static(t: float, fps: float) -> Scenario:
    return Scenario(name="static", duration_s=t, fps=fps)


def _clutter(t: float, fps: float) -> Scenario:
    background = Background(kind="printed", boxes=45, cables=14, contrast=0.9, motion="stop_and_go", speed_m_per_s=0.12)
    return Scenario(name="clutter", duration_s=t, fps=fps, background=background)


def _creep(t: float, fps: float) -> Scenario:
    creep = Creep(start_s=0.1 * t, time_s=0.25 * t, tcp_shift_m=(0.0015, 0.0003))
    return Scenario(name="creep", duration_s=t, fps=fps, mount=(creep,), background=Background(kind="speckle"))


def _bump(t: float, fps: float) -> Scenario:
    return Scenario(
        name="bump",
        duration_s=t,
        fps=fps,
        mount=(Bump(at_s=_between_frames(0.5 * t, fps), tcp_shift_m=(0.0002, 0.0045)),),
        background=Background(kind="chequer"),
    )


def _vibration(t: float, fps: float) -> Scenario:
    shake = Vibration(start_s=0.25 * t, end_s=0.75 * t, frequency_hz=13.0, tcp_shift_m=(0.00015, 0.0003))
    return Scenario(name="vibration", duration_s=t, fps=fps, mount=(shake,))


def _bent_finger(t: float, fps: float, finger: str) -> Scenario:
    bent = BentFinger(finger=finger, tip_shift_m=(0.0008, 0.0012, 0.0), start_s=_between_frames(0.5 * t, fps))
    return Scenario(name="bent_finger", duration_s=t, fps=fps, bent_fingers=(bent,))


def _jaw_cycle(t: float, fps: float) -> Scenario:
    openings = (0.034, 0.044, 0.024, 0.044, 0.024, 0.034)
    knots = tuple((k * t / (len(openings) - 1), opening) for k, opening in enumerate(openings))
    return Scenario(name="jaw_cycle", duration_s=t, fps=fps, jaw=JawScript(knots=knots))


def _grasp(t: float, fps: float) -> Scenario:
    grasped = GraspedObject(arrive_s=(0.12 * t, 0.35 * t), leave_s=(0.72 * t, 0.92 * t))
    knots = ((0.36 * t, 0.034), (0.44 * t, grasped.size_m[0]), (0.63 * t, grasped.size_m[0]), (0.71 * t, 0.034))
    jaw, background = JawScript(knots=knots), Background(kind="speckle")
    return Scenario(name="grasp", duration_s=t, fps=fps, jaw=jaw, grasped=grasped, background=background)


def _hand(t: float, fps: float) -> Scenario:
    covers = (
        Cover(start_s=0.2 * t, end_s=0.45 * t, move_s=0.05 * t),
        Cover(kind="sheet", side="left", start_s=0.6 * t, end_s=0.85 * t, move_s=0.04 * t),
    )
    return Scenario(name="hand", duration_s=t, fps=fps, covers=covers)


def _lighting(t: float, fps: float) -> Scenario:
    light = Light(
        flicker=0.08,
        steps=(LightStep(at_s=0.25 * t, factor=0.45), LightStep(at_s=0.6 * t, factor=2.6)),
        auto_exposure_s=0.04 * t,
        shadows=(
            Shadow(start_s=0.35 * t, end_s=0.55 * t),
            Shadow(start_s=0.75 * t, end_s=0.95 * t, softness=0.01, angle_deg=75.0),
        ),
    )
    return Scenario(name="lighting", duration_s=t, fps=fps, light=light, sensor=Sensor(jpeg_quality=80))


def _work(t: float, fps: float, jaw_opening_m: float | None) -> Scenario:
    """The robot wanders over a table; then something hits the camera."""
    return Scenario(
        name="work",
        duration_s=t,
        fps=fps,
        mount=(Bump(at_s=_between_frames(0.5 * t, fps), tcp_shift_m=(0.0, 0.0009)),),
        jaw=JawScript(knots=() if jaw_opening_m is None else ((0.0, jaw_opening_m),)),
    )


def _series(name: str, tcp_shift_m: tuple[float, float], sigma_m: float) -> Scenario:
    """As in the paper the gripper is parked on the calibration plate, in both images of a pair."""
    plate = Background(
        kind="discs", distance_m=0.0, level_dn=180.0, contrast=0.7, boxes=0, cables=0, motion="still", defocus_px=0.0
    )
    return Scenario(
        name=name,
        duration_s=2 * _PAIRS / _PAIR_FPS,
        fps=_PAIR_FPS,
        pairs=Pairs(tcp_shift_m=tcp_shift_m, tcp_shift_sigma_m=sigma_m),
        background=plate,
    )


_TIMED: dict[str, tuple[Callable[[float, float], Scenario], float]] = {
    "demo": (_demo, 20.0),
    "static": (_static, 10.0),
    "clutter": (_clutter, 10.0),
    "creep": (_creep, 20.0),
    "bump": (_bump, 10.0),
    "vibration": (_vibration, 8.0),
    "jaw_cycle": (_jaw_cycle, 10.0),
    "grasp": (_grasp, 12.0),
    "hand": (_hand, 12.0),
    "lighting": (_lighting, 12.0),
}
SCENARIO_NAMES = (*_TIMED, "work", "bent_finger", "series1", "series2")
DEFAULT_FPS = 30.0


def make_scenario(
    name: str,
    *,
    duration_s: float | None = None,
    fps: float | None = None,
    finger: str = "left",
    jaw_opening_m: float | None = None,
) -> Scenario:
    """A named scenario, its times scaled to a duration (its own if None).

    ``finger`` is the one that ``bent_finger`` bends, ``jaw_opening_m`` where the jaws stand in ``work`` (nominal if
    None).  The series are the paper's: twenty pairs of images, without a
    time scale, so a duration or a frame rate is refused.  ValueError for an unknown name.
    """
    if name in ("series1", "series2"):
        if duration_s is not None or fps is not None:
            raise ValueError(f"scenario: {name} is {2 * _PAIRS} single images; neither duration_s nor fps")
        # Series 1: a cable pulls sideways, 1.5 ± 0.3 mm; series 2: the mount is turned, 4.5 ± 0.2 mm.
        return _series(name, (1.5e-3, 0.0), 3e-4) if name == "series1" else _series(name, (0.0, 4.5e-3), 2e-4)
    rate = DEFAULT_FPS if fps is None else fps
    if name == "bent_finger":
        return _bent_finger(10.0 if duration_s is None else duration_s, rate, finger)
    if name == "work":
        return _work(3.0 if duration_s is None else duration_s, rate, jaw_opening_m)
    if name not in _TIMED:
        raise ValueError(f"scenario: there is no '{name}'; one of {', '.join(SCENARIO_NAMES)}")
    make, default_s = _TIMED[name]
    return make(default_s if duration_s is None else duration_s, rate)
