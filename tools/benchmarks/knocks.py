"""Trials of ``tools/bench recalibration``: a camera that is knocked once, with whatever else may go wrong then.

Every trial is a pure function of the seed and its number: gripper, camera, pose, opening, light, background, the knock,
what the robot says of the jaw, and what happens at the same moment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import drawn, jumps
from benchmarks.drawn import Place, in_view, lenses
from benchmarks.fingers import gripper_models, gripper_of, wedge_fingers
from gripmon.model.camera import Camera, make_camera
from gripmon.model.geometry import exp_rotation
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate import Rig, Scenario, Simulator
from gripmon.simulate.scenario import (
    Background,
    BentFinger,
    Cover,
    Defocus,
    GraspedObject,
    JawScript,
    Light,
    LightStep,
)

FPS = 30.0
LARGEST_M, LARGEST_RAD = 0.015, math.radians(8.0)
"""Knocks: shift of the TCP and turn about it, each uniform in size and direction."""

BEFORE = 4
"""Frames before the knock."""

JAWS = ("rests", "moves", "moves, noise", "moves, offset", "rests, offset", "unreported")
JAW_SHARES = (0.35, 0.25, 0.1, 0.1, 0.1, 0.1)
ALSO = ("nothing", "occlusion", "object", "defocus", "light step", "bent finger")
ALSO_SHARES = (0.5, 0.1, 0.05, 0.1, 0.1, 0.15)
"""What else happens at the moment of the knock, and how often."""

_BORDER_PX = 20.0
_NOISE_M, _OFFSET_M = 3e-5, 2e-4


@dataclass(frozen=True)
class Knock:
    """One trial: what was drawn, in words, and the simulator that shows it.  ``start_cam_T_grip``: the reference that
    the monitor is given.  ``jaw_sigma_m``: its setting for the reported opening, None for the default.
    """

    number: int
    gripper: str
    lens: str
    background: str
    jaw: str
    also: str
    xi: NDArray[np.float64]
    camera: Camera
    model: Gripper
    simulator: Simulator
    start_cam_T_grip: Array
    jaw_sigma_m: float | None

    @property
    def words(self) -> str:
        """All that was drawn, in one line."""
        shift, turn = 1e3 * np.linalg.norm(self.xi[:3]), np.degrees(np.linalg.norm(self.xi[3:]))
        return (
            f"{self.gripper}, {self.lens}, {self.background}; jaw {self.jaw}; {self.also}; {shift:.1f} mm, {turn:.1f}°"
        )


def draw_knock(seed: int, number: int) -> Knock:
    """Trial ``number``."""
    rng = np.random.default_rng([seed, 77, number])
    grippers = _grippers()
    gripper_name, lens_name = str(rng.choice(list(grippers))), str(rng.choice(list(lenses())))
    gripper, camera = grippers[gripper_name], make_camera(lenses()[lens_name])
    cam_T_grip, opening_m = _placed(rng, camera, gripper)
    background_name, still = str(rng.choice(jumps.BACKGROUNDS)), bool(rng.random() < 0.4)
    jaw = str(rng.choice(JAWS, p=JAW_SHARES)) if gripper.has_jaw else "none"
    also = str(rng.choice(ALSO, p=ALSO_SHARES))
    if also == "object" and not gripper.has_jaw:
        also = "nothing"
    xi = _xi(rng)
    knock_s = (BEFORE - 0.5) / FPS
    script, sigma_m = _jaw(rng, gripper, jaw, opening_m)
    pivot_m = cam_T_grip[:3, 3] - [0.0, 0.0, 0.1]
    sections: dict[str, Any] = {
        "name": "recalibration",
        "fps": FPS,
        "pivot_cam_m": tuple(pivot_m.tolist()),
        "mount": (jumps.tilt(xi, pivot_m, cam_T_grip[:3, 3], knock_s),),
        "jaw": script,
        "background": _background(rng, background_name, still),
        "fingers": msgspec.structs.replace(drawn.finger_look(rng), carriers=gripper.has_jaw),
        "sensor": drawn.sensor(rng),
    }
    sections |= _what_else(rng, also, gripper, opening_m, knock_s)
    simulator = Rig(camera, gripper, cam_T_grip).simulator(Scenario(**sections), int(rng.integers(2**31)))
    return Knock(
        number=number,
        gripper=gripper_name,
        lens=lens_name,
        background=f"{background_name}{' still' if still else ''}",
        jaw=jaw,
        also=also,
        xi=xi,
        camera=camera,
        model=gripper,
        simulator=simulator,
        start_cam_T_grip=drawn.reference(rng, cam_T_grip),
        jaw_sigma_m=sigma_m,
    )


def _xi(rng: np.random.Generator) -> Array:
    ways = rng.normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    return np.concatenate([LARGEST_M * rng.uniform(0.0, 1.0) * ways[0], LARGEST_RAD * rng.uniform(0.0, 1.0) * ways[1]])


def _placed(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose and an opening at which all corners are inside the image."""

    def draw(rng: np.random.Generator) -> Place:
        opening_m = gripper.jaw_nominal_m
        if gripper.has_jaw:
            opening_m = float(rng.uniform(gripper.jaw_min_m + 0.012, min(gripper.jaw_max_m - 0.008, 0.046)))
        tilt, others = rng.uniform(26.0, 40.0), rng.uniform(-5.0, 5.0, 2)
        turn = exp_rotation(np.deg2rad([0.0, *others])) @ exp_rotation(np.deg2rad([tilt, 0.0, 0.0]))
        points = gripper.points_grip_m(opening_m if gripper.has_jaw else None)[gripper.corner_points]
        tcp_m = np.array([*rng.uniform(-0.004, 0.004, 2), rng.uniform(0.092, 0.128)])
        return Place(turn, tcp_m, opening_m, points)

    return in_view(rng, camera, draw, _BORDER_PX)


def _background(rng: np.random.Generator, name: str, still: bool) -> Background:
    background = jumps.background(name)
    changes: dict[str, Any] = {
        "level_dn": float(rng.uniform(60.0, 180.0)),
        "distance_m": float(rng.uniform(0.08, 0.25)),
    }
    if still:
        changes["motion"] = "still"
    return msgspec.structs.replace(background, **changes)


def _jaw(rng: np.random.Generator, gripper: Gripper, jaw: str, opening_m: float) -> tuple[JawScript, float | None]:
    """The jaw's script, and the monitor's settings for the report's error."""
    if jaw == "none":
        return JawScript(), None
    knots: tuple[tuple[float, float], ...] = ((0.0, opening_m),)
    if jaw.startswith("moves"):
        way_m = float(rng.choice((-1.0, 1.0)) * rng.uniform(3e-3, 7e-3))
        other_m = min(max(opening_m + way_m, gripper.jaw_min_m + 2e-3), gripper.jaw_max_m - 2e-3)
        knots = tuple((0.8 * k, opening_m if k % 2 == 0 else other_m) for k in range(8))
    if jaw == "unreported":
        return JawScript(knots=knots, reported=False), None
    if jaw.endswith("noise"):
        return JawScript(knots=knots, reported_noise_m=_NOISE_M), _NOISE_M
    if jaw.endswith("offset"):
        return JawScript(knots=knots, reported_offset_m=float(rng.normal(0.0, _OFFSET_M))), None
    return JawScript(knots=knots), 0.0


def _what_else(
    rng: np.random.Generator, also: str, gripper: Gripper, opening_m: float, knock_s: float
) -> dict[str, Any]:
    """Sections of the scenario that differ."""
    if also == "occlusion":
        kind, side = str(rng.choice(("hand", "sheet"))), str(rng.choice(("left", "right", "top", "bottom")))
        reach = float(rng.uniform(0.06, 0.22))
        return {"covers": (Cover(kind=kind, side=side, start_s=0.0, end_s=1e4, move_s=0.1, reach=reach),)}  # type: ignore[arg-type]
    if also == "object":
        size_m = (opening_m, float(rng.uniform(0.02, 0.036)), 0.04)
        held = GraspedObject(
            size_m=size_m, depth_m=float(rng.uniform(0.008, 0.022)), arrive_s=(0.0, 0.001), leave_s=(1e4, 2e4)
        )
        return {"grasped": held, "jaw": JawScript(knots=((0.0, opening_m),))}
    if also == "defocus":
        return {"defocus": (Defocus(sigma_px=float(rng.uniform(0.5, 2.0)), start_s=knock_s),)}
    if also == "light step":
        return {"light": Light(steps=(LightStep(at_s=knock_s, factor=float(rng.uniform(0.4, 1.8))),))}
    if also == "bent finger":
        way = rng.normal(size=3)
        shift_m = way / np.linalg.norm(way) * rng.uniform(1e-4, 1e-3)
        finger = str(rng.choice(gripper.finger_ids))
        return {"bent_fingers": (BentFinger(finger=finger, tip_shift_m=tuple(shift_m.tolist()), start_s=knock_s),)}
    return {}


@cache
def _grippers() -> dict[str, Gripper]:
    box, tapered, arcs = gripper_models()
    models = {"boxes": box, "arcs": arcs, "wedges": wedge_fingers(), "tapered": tapered}
    return {name: gripper_of(model) for name, model in models.items()}
