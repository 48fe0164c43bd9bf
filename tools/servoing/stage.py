"""What happens in one run: the mount is knocked half way of the approach, the object comes between the fingers.

The images show the object where the planned approach has it; arms that are off, or stopped, see their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array
from gripmon.simulate.disturbance import smooth_step
from gripmon.simulate.scenario import Background, Bump, Cover, GraspedObject, Scenario
from servoing.arm import HOME_RAD, Arm

BEGIN_S = 2.0
"""When the arms may set off: until then the monitor looks."""
APPROACH_S = 4.0
DISTANCE_M = 0.08
BUMP_S = BEGIN_S + 0.5 * APPROACH_S
SETTLE_S = 4.0
COVERED_S = 2.5
"""From the moment when the hand begins to move in to when it is gone.  A transform is held for a second
(``policy.hold_s``), so a view that is covered for less never becomes ``unknown``.
"""

_BACKGROUNDS = ("blobs", "printed", "speckle", "chequer", "stripes", "plain")
_ROLL_DEG = 1.0
_PLACE_M = np.array([0.1, 0.12, 0.06])
_START_M, _START_RAD = 0.01, 0.07
_LEAST_DEXTERITY = 0.1
_HAND_AFTER_S, _HAND_MOVES_S = (-0.3, 0.1), 0.3


@dataclass(frozen=True)
class Row:
    """One kind of run."""

    bump_m: float
    covered: bool

    @property
    def name(self) -> str:
        return f"{1e3 * self.bump_m:g} mm" + (", then a hand" if self.covered else "")


ROWS = tuple(Row(bump_m, covered) for covered in (False, True) for bump_m in (1.5e-3, 4.5e-3))


def duration_s(row: Row) -> float:
    return BEGIN_S + APPROACH_S + SETTLE_S + row.covered * (COVERED_S + 1.0)


def standoff_m(progress_s: float) -> float:
    """How far before the object the approach is, as the simulated object's own motion."""
    return DISTANCE_M * (1.0 - smooth_step(progress_s, 0.0, APPROACH_S))


def scenario(row: Row, rng: np.random.Generator, fps: float, tcp_m: Array) -> Scenario:
    """The mount jumps by ``row.bump_m`` at the TCP, which was at ``tcp_m`` (3,) camera axes, in any direction: across
    by a turn about the mount's pivot, along by a shift.  It rolls by up to a degree, too, and rings down.  A hand comes
    a little before it or after, so that some jumps are not seen.
    """
    way = rng.normal(size=3)
    way *= row.bump_m / np.linalg.norm(way)
    lever = tcp_m - np.array(Scenario().pivot_cam_m)
    arc_m = math.sqrt(lever @ lever - ((lever + way)[:2] ** 2).sum()) - lever[2]
    # Between two frames, so that no exposure is smeared by the jump itself.
    at_s = (math.floor(BUMP_S * fps) + 0.5) / fps
    bump = Bump(
        at_s=at_s,
        tcp_shift_m=(float(way[0]), float(way[1])),
        translation_m=(0.0, 0.0, float(way[2] - arc_m)),  # the turn alone moves it along, too
        roll_deg=float(rng.uniform(-_ROLL_DEG, _ROLL_DEG)),
    )
    start_s = at_s + float(rng.uniform(*_HAND_AFTER_S))
    side = ("left", "right", "top", "bottom")[int(rng.integers(4))]
    hand = Cover(start_s=start_s, end_s=start_s + COVERED_S, move_s=_HAND_MOVES_S, side=side)
    kind = _BACKGROUNDS[int(rng.integers(len(_BACKGROUNDS)))]
    end_s = duration_s(row)
    return Scenario(
        name="servo",
        duration_s=end_s,
        fps=fps,
        mount=(bump,),
        covers=(hand,) if row.covered else (),
        grasped=GraspedObject(
            distance_m=DISTANCE_M, arrive_s=(BEGIN_S, BEGIN_S + APPROACH_S), leave_s=(end_s + 1.0, end_s + 2.0)
        ),
        background=Background(kind=kind),
    )


def placement(arm: Arm, rng: np.random.Generator) -> tuple[Array, Array]:
    """``base_T_object`` (4, 4), somewhere in the arm's reach, and joint angles (6,) from which the approach begins.

    They are some millimetres and degrees beside the stand-off.  Drawn again until the arm reaches both well.
    """
    home_T = arm.base_T_grip(HOME_RAD)
    while True:
        turn = exp_rotation(rng.normal(0.0, 0.15, 3)) @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-1.0, 1.0)]))
        place_m = home_T[:3, 3] + np.array([0.0, 0.0, -0.1]) + rng.uniform(-1.0, 1.0, 3) * _PLACE_M
        base_T_object = make_transform(home_T[:3, :3] @ turn, place_m)
        beside_m = np.array([0.0, 0.0, -DISTANCE_M]) + rng.uniform(-_START_M, _START_M, 3)
        start_T = base_T_object @ make_transform(exp_rotation(rng.uniform(-_START_RAD, _START_RAD, 3)), beside_m)
        start, end = arm.reach(start_T, HOME_RAD), arm.reach(base_T_object, HOME_RAD)
        if start is not None and end is not None and min(map(arm.dexterity, (start, end))) > _LEAST_DEXTERITY:
            return base_T_object, start
