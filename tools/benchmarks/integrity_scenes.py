"""Scenes of ``tools/bench integrity``: a condition with a drawn camera, gripper, pose, opening, light and frame rate.

Every scene is a pure function of the condition's name, the seed, the scene's number and its number of frames.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import msgspec
import numpy as np

from benchmarks import padded
from benchmarks.drawn import (
    REFERENCE_SIGMA,
    Changes,
    Draft,
    Draw,
    Place,
    drawn,
    finger_look,
    in_view,
    reference,
)
from benchmarks.fingers import first_finger, gripper_models, gripper_of
from benchmarks.rounded import rounded_model, rounded_solids
from gripmon.model.camera import Camera, PaperLens, make_camera
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause
from gripmon.simulate import PAPER_LENS, Rig, Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerMark, JawScript, Sensor

LEAD_FRAMES = (15, 20)
"""Frames at the start of a scene in which the gripper is seen free."""
INSIDE_SHARE = 0.1
"""Share of scenes that start in the midst of what their condition does."""
MARKED_SHARE = 0.35
"""Share of scenes in which the fingers carry marks that the model doesn't know."""
SHORT_PX = (20.0, 30.0)
"""Of fingers that the image's border cuts off."""
_INSIDE_AT = (0.3, 0.6)
_KINDS = ("blobs", "speckle", "stripes", "printed", "chequer")
_JAW_NOISE_M = 3e-5


@dataclass(frozen=True)
class SceneDraft(Draft):
    """And between which times things happen, ``start_s`` and ``end_s``: before and after, the gripper is free."""

    fps: float
    start_s: float
    end_s: float
    gripper: Gripper
    cam_T_grip: Array
    jaw: JawScript

    def at_s(self, share: float) -> float:
        """A time between start and end."""
        return self.start_s + share * (self.end_s - self.start_s)

    def between_frames_s(self, share: float) -> float:
        """Near a share of the time, between two frames: a jump there is in no frame's exposure."""
        return (round(self.at_s(share) * self.fps) + 0.5) / self.fps

    @property
    def tip_low_m(self) -> Array:
        """Smallest x, y, z (3,) of all tips' corners at the drawn opening: y is the side towards the camera."""
        return np.asarray(self._tips_m.min(axis=0))

    @property
    def tip_high_m(self) -> Array:
        """Largest x, y, z (3,) of all tips' corners at the drawn opening."""
        return np.asarray(self._tips_m.max(axis=0))

    @property
    def thick_m(self) -> float:
        """Extent of the tips along y."""
        return float(self.tip_high_m[1] - self.tip_low_m[1])

    @property
    def _tips_m(self) -> Array:
        return self.gripper.points_grip_m(self.opening_m)[self.gripper.corner_points]


class Fingers(Enum):
    """Which grippers: the usual ones; two fingers with rounded tips; one finger of the usual that stands still; the
    usual, of which the image's border leaves 25 px; tapered fingers with pads before a colour camera.
    """

    USUAL = ""
    ROUND_TIPS = "round tips"
    ONE = "one finger"
    SHORT = "25 px"
    PADDED = "pads"


@dataclass(frozen=True)
class Condition:
    """A kind of scene.

    ``enough``: the gripper shows enough wherever its outline is seen, so that ``valid`` may be asked for; ``wrong``:
    what is wrong, so that an alert which names it is true; ``inside``: a scene may begin in the midst of it;
    ``truth``: what the true gripper is instead of the one that the monitor knows; ``fingers``: of which grippers.
    """

    name: str
    what: str
    changes: Changes | Draw = field(default_factory=dict)
    enough: bool = True
    wrong: tuple[Cause, ...] = ()
    inside: bool = True
    truth: Callable[[np.random.Generator, dict[str, Any]], dict[str, Any]] | None = None
    fingers: Fingers = Fingers.USUAL


def both(*parts: Draw) -> Draw:
    """Several changes together; a later one wins where they meet."""

    def changes(draft: SceneDraft) -> Changes:
        out: Changes = {}
        for part in parts:
            out |= drawn(draft, part)
        return out

    return changes


@dataclass(frozen=True)
class IntegrityScene:
    """A simulated sequence and what the monitor knows before it.

    The sequence begins at frame ``first`` of the simulator; ``jaw_sigma_m`` None: the product's default.
    """

    condition: Condition
    simulator: Simulator
    gripper: Gripper
    start_cam_T_grip: Array
    start_covariance: Array
    jaw_sigma_m: float | None
    first: int
    frames: int

    @property
    def camera(self) -> Camera:
        return self.simulator.camera

    @property
    def fps(self) -> float:
        return self.simulator.scenario.fps

    @property
    def indices(self) -> Iterator[int]:
        """The simulator's frames in order."""
        yield from range(self.first, self.first + self.frames)


def make_integrity_scene(condition: Condition, seed: int, number: int, frames: int) -> IntegrityScene:
    """Scene ``number`` of a condition."""
    rng = np.random.default_rng([seed, zlib.crc32(b"integrity " + condition.name.encode()), number])
    camera = make_camera(padded.LENS) if condition.fingers is Fingers.PADDED else _camera(rng)
    gripper, shown = _grippers(condition.fingers, number, rng)
    cam_T_grip, opening_m = _PLACED.get(condition.fingers, _placed)(rng, camera, shown)
    draft = _draft(rng, frames, shown, cam_T_grip, opening_m)
    if condition.truth is not None:
        shown = gripper_of(condition.truth(rng, msgspec.to_builtins(gripper.model)))
    scenario = _scenario(condition, draft)
    if not shown.has_jaw:
        scenario = msgspec.structs.replace(scenario, jaw=JawScript())
    simulator = Rig(camera, shown, cam_T_grip).simulator(scenario, int(rng.integers(2**31)))
    inside = condition.inside and rng.random() < INSIDE_SHARE
    first = round(draft.at_s(float(rng.uniform(*_INSIDE_AT))) * draft.fps) if inside else 0
    return IntegrityScene(
        condition=condition,
        simulator=simulator,
        gripper=gripper,
        start_cam_T_grip=reference(rng, simulator.truth(first).cam_T_grip),
        start_covariance=np.diag(REFERENCE_SIGMA**2),
        jaw_sigma_m=0.0 if scenario.jaw.reported_noise_m == 0.0 and not scenario.jaw.reported_offset_m else None,
        first=first,
        frames=frames,
    )


def _grippers(fingers: Fingers, number: int, rng: np.random.Generator) -> tuple[Gripper, Gripper]:
    """What the monitor knows, and what is shown."""
    if fingers is Fingers.ROUND_TIPS:
        return _round_tipped(rng)
    if fingers is Fingers.PADDED:
        return padded.padded_model(), padded.padded_solids()
    models = gripper_models()
    model = models[number % len(models)]
    gripper = gripper_of(first_finger(model) if fingers is Fingers.ONE else model)
    return gripper, gripper


def _round_tipped(rng: np.random.Generator) -> tuple[Gripper, Gripper]:
    """What the monitor knows of fingers with rounded tips, and what they are: tips from a little to wholly round."""
    width_m = float(rng.uniform(0.008, 0.02))
    radius_m = float(rng.uniform(0.002, 0.5 * width_m))
    return rounded_model(width_m, radius_m), rounded_solids(width_m, radius_m)


def _scenario(condition: Condition, draft: SceneDraft) -> Scenario:
    """An ordinary scene with the condition's changes."""
    sections: dict[str, Any] = {
        "name": condition.name,
        "fps": draft.fps,
        "duration_s": draft.frames / draft.fps,
        "background": draft.background,
        "fingers": draft.fingers,
        "sensor": draft.sensor,
        "jaw": draft.jaw,
    }
    return Scenario(**{**sections, **drawn(draft, condition.changes)})


def _draft(rng: np.random.Generator, frames: int, gripper: Gripper, cam_T_grip: Array, opening_m: float) -> SceneDraft:
    """Times and looks of an ordinary scene."""
    fps = float(rng.integers(15, 31))
    lead = int(rng.integers(LEAD_FRAMES[0], LEAD_FRAMES[1] + 1)) if frames >= 60 else max(frames // 4, 1)
    background = Background(
        kind=_KINDS[rng.integers(len(_KINDS))],  # type: ignore[arg-type]
        level_dn=float(rng.uniform(40.0, 200.0)),
        contrast=float(rng.uniform(0.3, 0.9)),
        distance_m=float(rng.uniform(0.06, 0.3)),
        speed_m_per_s=float(rng.uniform(0.03, 0.12)),
        motion=str(rng.choice(("wander", "linear", "stop_and_go"))),  # type: ignore[arg-type]
    )
    fingers = msgspec.structs.replace(
        finger_look(rng, level_dn=(50.0, 170.0), texture=(0.03, 0.2)),
        highlights=float(rng.uniform(0.0, 2.0)) if rng.random() < 0.2 else 0.0,
        marks=_marks(rng) if rng.random() < MARKED_SHARE else (),
    )
    noise_m = _JAW_NOISE_M if rng.random() < 0.5 else 0.0
    return SceneDraft(
        rng=rng,
        frames=frames,
        fps=fps,
        start_s=lead / fps,
        end_s=(frames - lead) / fps,
        gripper=gripper,
        cam_T_grip=cam_T_grip,
        opening_m=opening_m,
        background=background,
        fingers=fingers,
        sensor=Sensor(psf_sigma_px=float(rng.uniform(0.5, 0.8)), exposure_time_s=float(rng.uniform(0.001, 0.006))),
        jaw=JawScript(knots=((0.0, opening_m),), reported_noise_m=noise_m),
    )


def _marks(rng: np.random.Generator) -> tuple[FingerMark, ...]:
    """A pad, two tones, a step across the fingers, a slot along them, or screws."""

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    gain = between(0.25, 0.75) if rng.random() < 0.5 else between(1.3, 2.5)
    start_m = between(0.002, 0.012)
    match int(rng.integers(5)):
        case 0:
            half = between(0.4, 0.9)
            return (FingerMark(from_tip_m=(start_m, start_m + between(5e-3, 15e-3)), across=(-half, half), gain=gain),)
        case 1:
            return (FingerMark(from_tip_m=(start_m, 0.3), across=(-2.0, 2.0), gain=gain),)
        case 2:
            return (FingerMark(from_tip_m=(start_m, start_m + between(3e-4, 1e-3)), across=(-2.0, 2.0), gain=gain),)
        case 3:
            left = between(-0.7, 0.5)
            return (FingerMark(from_tip_m=(start_m, 0.3), across=(left, left + between(0.08, 0.3)), gain=gain),)
        case _:
            size_m, pitch_m = between(2e-3, 5e-3), between(6e-3, 12e-3)
            places = (start_m + k * pitch_m for k in range(3))
            return tuple(
                FingerMark(shape="disc", from_tip_m=(m, m + size_m), across=(0.0, 0.0), gain=gain) for m in places
            )


def _camera(rng: np.random.Generator) -> Camera:
    """Mostly that of the paper; some smaller ones, and other focal lengths."""
    kind = rng.random()
    if kind < 0.6:
        return make_camera(PAPER_LENS)
    width, height = (640, 480) if kind < 0.8 else (768, 576)
    focal_px = float(rng.uniform(0.75, 1.35)) * width
    middle = (0.5 * np.array([width, height]) - 0.5 + rng.uniform(-8.0, 8.0, 2)).tolist()
    kappa = float(rng.uniform(-0.5, 1.5)) * 1.9e-7 * (768 / width) ** 2
    lens = PaperLens(
        width_px=width,
        height_px=height,
        fx_px=focal_px,
        fy_px=focal_px * float(rng.uniform(0.99, 1.01)),
        cx_px=middle[0],
        cy_px=middle[1],
        kappa_per_px2=kappa,
    )
    return make_camera(lens)


def _placed(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose and an opening at which all of the fingertips are in the image, also some millimetres wider."""

    def draw(rng: np.random.Generator) -> Place:
        turn = exp_rotation(np.deg2rad([rng.uniform(20.0, 45.0), rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)]))
        depth_m = rng.uniform(0.08, 0.2)
        tcp_m = np.array([*rng.uniform(-0.06, 0.06, 2) * depth_m, depth_m])
        opening_m = gripper.jaw_nominal_m + float(rng.uniform(-14e-3, 10e-3))
        opening_m = min(max(opening_m, 10e-3), gripper.jaw_max_m - 4e-3)
        return Place(turn, tcp_m, opening_m, gripper.points_grip_m(opening_m + 4e-3)[gripper.corner_points])

    return in_view(rng, camera, draw)


def _placed_short(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """As usual, then shifted until of the finger that is seen least only ``SHORT_PX`` are between its tip and the
    border: a roll of the camera shows more of the other.
    """
    for _ in range(1000):
        cam_T_grip, opening_m = _placed(rng, camera, gripper)
        short_px = float(rng.uniform(*SHORT_PX))
        points = gripper.points_grip_m(opening_m)
        corners = np.isin(np.arange(len(points)), gripper.corner_points)
        tips = [corners & (gripper.point_finger == finger) for finger in range(len(gripper.finger_ids))]
        for _ in range(5):  # Newton's: the lens is nearly linear there
            v_px = camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])[:, 1]
            down = bool(np.nanmean(v_px[~corners]) > np.nanmean(v_px[corners]))
            nearest_px = [float(v_px[tip].min() if down else v_px[tip].max()) for tip in tips]
            tip_px = max(nearest_px) if down else min(nearest_px)
            off_px = tip_px - (camera.height_px - 1.0 - short_px if down else short_px)
            cam_T_grip[1, 3] -= off_px * cam_T_grip[2, 3] / camera.fy_px
        if abs(off_px) < 1.0:
            return cam_T_grip, opening_m
    raise ValueError(f"gripper {gripper.name} has no tips at the image's border")


def _placed_padded(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """10 px/mm at the TCP, tilted by some 38 degrees; the fingers leave the image."""
    turn = exp_rotation(np.deg2rad([rng.uniform(34.0, 42.0), *rng.uniform(-3.0, 3.0, 2)]))
    tcp_m = np.array([*rng.uniform(-4e-3, 4e-3, 2), rng.uniform(0.086, 0.094)])
    return make_transform(turn, tcp_m), gripper.jaw_nominal_m + float(rng.uniform(-2e-3, 2e-3))


_PLACED = {Fingers.SHORT: _placed_short, Fingers.PADDED: _placed_padded}
