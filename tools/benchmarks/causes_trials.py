"""Trials of ``tools/bench causes``: a gripper before a camera, all well at first, and then one thing goes wrong.

Everything is drawn at random, and every draw counts: gripper, camera, lens, pose, opening, background, light, how the
opening is reported, and how much of what goes wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from benchmarks.drawn import Place, Rng, in_view, lenses, reference
from benchmarks.fingers import bevelled, gripper_models, gripper_of, wedge_fingers
from benchmarks.scenes import ordinary_look
from gripmon import simulate
from gripmon.model.camera import Camera, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import exp_rotation, perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause, Frame, Image
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import BentFinger, Cover, Defocus, JawScript, Light, LightStep, Tilt

WELL, AFTER = 24, 24
"""Frames before and after it."""

JAW_NOISE_M = 3e-5


@dataclass(frozen=True)
class Rig:
    """What is watched: the reference is ``start_cam_T_grip``; ``jaw_sigma_m``: the setting for the opening."""

    camera_settings: LensSettings
    gripper: Gripper
    cam_T_grip: Array
    start_cam_T_grip: Array
    scenario: Scenario
    jaw_sigma_m: float
    seed: int

    def simulator(self, lens: LensSettings | None = None, pose: Array | None = None, **changes: Any) -> Simulator:
        """The same scene with changes."""
        scenario = msgspec.structs.replace(self.scenario, **changes)
        camera = make_camera(lens or self.camera_settings)
        shown = simulate.Rig(camera, self.gripper, self.cam_T_grip if pose is None else pose)
        return shown.simulator(scenario, self.seed)

    @property
    def at_s(self) -> float:
        """When it goes wrong: between two frames."""
        return (WELL - 0.5) / self.scenario.fps


def draw_rig(rng: Rng, reported: bool) -> Rig:
    """Everything that is drawn before what goes wrong; ``reported``: the robot has to report the opening."""
    lens, models = list(lenses().values())[int(rng.integers(3))], [*gripper_models(), wedge_fingers()]
    model = models[int(rng.integers(4))]
    if model is not models[-1] and rng.random() < 0.5:
        model = bevelled(model, float(rng.uniform(0.0, 3e-4)))
    gripper, camera = gripper_of(model), make_camera(lens)
    cam_T_grip, opening_m = _placed(rng, camera, gripper)
    how = ("exact", "noisy", "unreported")[int(rng.integers(2 if reported else 3))]
    later_m = opening_m + (float(rng.uniform(-3e-3, 3e-3)) if rng.random() < 0.3 else 0.0)
    later_m = min(max(later_m, gripper.jaw_min_m + 1e-3), gripper.jaw_max_m - 1e-3)
    fps = float(rng.uniform(10.0, 22.0))
    background, fingers, sensor = ordinary_look(rng)
    motion = ("still", "wander", "linear", "stop_and_go")[int(rng.integers(4))]
    plain = rng.random() < 0.15
    background = msgspec.structs.replace(
        background, motion=motion, **({"kind": "plain", "boxes": 0, "cables": 0} if plain else {})
    )
    sensor = msgspec.structs.replace(sensor, read_noise_dn=float(rng.uniform(0.5, 2.5)))
    jaw = JawScript(
        knots=((0.0, opening_m), ((WELL + AFTER) / fps, later_m)),
        reported=how != "unreported",
        reported_noise_m=JAW_NOISE_M if how == "noisy" else 0.0,
    )
    scenario = Scenario(
        name="causes",
        fps=fps,
        duration_s=(WELL + AFTER) / fps,
        background=background,
        fingers=fingers,
        sensor=sensor,
        jaw=jaw,
        light=Light(flicker=float(rng.uniform(0.0, 0.05))),
    )
    start = reference(rng, cam_T_grip)
    sigma_m = 0.0 if how == "exact" else JAW_NOISE_M if how == "noisy" else 5e-5
    return Rig(camera.settings, gripper, cam_T_grip, start, scenario, sigma_m, int(rng.integers(2**31)))


def _placed(rng: Rng, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose and an opening at which all fingertips are in the image."""
    front = gripper.corner_points[gripper.points_grip_m(None)[gripper.corner_points, 2] > -0.02]

    def draw(rng: Rng) -> Place:
        turn = exp_rotation(np.deg2rad([rng.uniform(25.0, 40.0), rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)]))
        tcp_m = np.array([rng.uniform(-4e-3, 4e-3), rng.uniform(-4e-3, 4e-3), rng.uniform(0.085, 0.13)])
        low, high = gripper.jaw_min_m + 2e-3, gripper.jaw_max_m - 2e-3
        opening_m = float(rng.uniform(max(low, gripper.jaw_nominal_m - 8e-3), min(high, gripper.jaw_nominal_m + 8e-3)))
        return Place(turn, tcp_m, opening_m, gripper.points_grip_m(opening_m)[front])

    return in_view(rng, camera, draw)


_RING = 24
"""Frames that are rendered for a stream of which the images don't matter; it is played forwards and backwards."""


@dataclass(frozen=True)
class Trial:
    """``frames`` from the first on, of which the first ``well`` are before anything happens; ``part``: the finger that
    is bent; ``what`` in words.
    """

    rig: Rig
    what: str
    part: str | None
    well: int
    frames: Callable[[], Iterator[Frame]]


def make_trial(row: Row, seed: int, number: int) -> Trial:
    """Trial ``number`` of a row: a pure function of the three."""
    rng = np.random.default_rng([seed, list(ROWS).index(row.name), number])
    return row.draw(rng, draw_rig(rng, row.reported))


@dataclass(frozen=True)
class Row:
    """What goes wrong, the cause that is right (None: nothing is), and which grippers and reports it needs."""

    name: str
    cause: Cause | None
    draw: Callable[[Rng, Rig], Trial]
    reported: bool = False


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _direction(rng: Rng, count: int = 3) -> Array:
    way = rng.normal(size=count)
    return np.asarray(way / np.linalg.norm(way))


def _shown(rig: Rig, what: str, part: str | None = None, **changes: Any) -> Trial:
    """A trial in which the simulator shows what goes wrong."""

    def frames() -> Iterator[Frame]:
        simulator = rig.simulator(**changes)
        return (simulator.frame(index) for index in range(WELL + AFTER))

    return Trial(rig, what, part, WELL, frames)


def _changed(rig: Rig, what: str, change: Callable[[Frame, int], Frame]) -> Trial:
    """A trial in which the frames are changed afterwards; ``change`` gets how many it is after the event, from 0."""

    def frames() -> Iterator[Frame]:
        simulator = rig.simulator()
        for index in range(WELL + AFTER):
            frame = simulator.frame(index)
            yield frame if index < WELL else change(frame, index - WELL)

    return Trial(rig, what, None, WELL, frames)


def _other_camera(rig: Rig, what: str, lens: LensSettings, pose: Array, **changes: Any) -> Trial:
    """A trial in which another camera goes on."""

    def frames() -> Iterator[Frame]:
        before, after = rig.simulator(), rig.simulator(lens, pose, **changes)
        return ((before if index < WELL else after).frame(index) for index in range(WELL + AFTER))

    return Trial(rig, what, None, WELL, frames)


def _nothing(rng: Rng, rig: Rig) -> Trial:
    return _shown(rig, "nothing")


def _mount(rng: Rng, rig: Rig) -> Trial:
    """The TCP moves by 0.1 to 10 mm, the camera turns by 0.05 to 5 degrees: either, or both."""
    kind = int(rng.integers(3))
    shift_m = _log_uniform(rng, 1e-4, 1e-2) * _direction(rng) if kind != 1 else np.zeros(3)
    roll_deg, lever_m = 0.0, 0.0
    if kind != 0:
        turn_rad = math.radians(_log_uniform(rng, 0.05, 5.0)) * _direction(rng)
        roll_deg, lever_m = math.degrees(turn_rad[2]), float(rig.cam_T_grip[2, 3])
        across = lever_m * turn_rad[:2]
    else:
        across = np.zeros(2)
    tilt = Tilt(
        start_s=rig.at_s,
        time_s=float(rng.choice([0.0, 0.1])),
        tcp_shift_m=(float(across[0]), float(across[1])),
        roll_deg=roll_deg,
        translation_m=tuple(shift_m.tolist()),
    )
    turned_deg = math.hypot(roll_deg, math.degrees(float(np.hypot(*across)) / lever_m) if lever_m else 0.0)
    what = f"shift {1e3 * np.linalg.norm(shift_m):.2f} mm, turn {turned_deg:.2f} degrees"
    return _shown(rig, what, mount=(tilt,))


def _finger(rng: Rng, rig: Rig) -> Trial:
    """A fingertip moves by 0.15 to 1.5 mm across its finger."""
    finger = str(rng.choice(rig.gripper.finger_ids))
    x, y = (_log_uniform(rng, 1.5e-4, 1.5e-3) * _direction(rng, 2)).tolist()
    bent = BentFinger(finger=finger, tip_shift_m=(x, y, 0.0), start_s=rig.at_s)
    return _shown(rig, f"{finger} by {1e3 * x:+.2f} {1e3 * y:+.2f} mm", finger, bent_fingers=(bent,))


def _jaw(rng: Rng, rig: Rig) -> Trial:
    """The report is 0.1 to 2 mm wrong from some time on."""
    size_m, gripper = _log_uniform(rng, 1e-4, 2e-3), rig.gripper
    openings = [opening for _, opening in rig.scenario.jaw.knots]
    signs = [s for s in (-1.0, 1.0) if gripper.jaw_min_m <= min(openings) + s * size_m]
    signs = [s for s in signs if max(openings) + s * size_m <= gripper.jaw_max_m]
    offset_m = float(rng.choice(signs)) * size_m

    def change(frame: Frame, _: int) -> Frame:
        assert frame.jaw_opening_m is not None
        reported_m = min(max(frame.jaw_opening_m + offset_m, gripper.jaw_min_m), gripper.jaw_max_m)
        return replace(frame, jaw_opening_m=reported_m)

    return _changed(rig, f"{1e3 * offset_m:+.2f} mm", change)


def scaled(lens: LensSettings, factor: float) -> LensSettings:
    """The camera with its focal length changed, lens and principal point as they are."""
    changes: dict[str, float] = {"fx_px": lens.fx_px * factor, "fy_px": lens.fy_px * factor}
    if isinstance(lens, PaperLens):
        changes["kappa_per_px2"] = lens.kappa_per_px2 / factor**2
    return msgspec.structs.replace(lens, **changes)  # type: ignore[arg-type]


def _focal(rng: Rng, rig: Rig) -> Trial:
    change = float(rng.choice([-1.0, 1.0])) * _log_uniform(rng, 2e-3, 3e-2)
    return _other_camera(rig, f"{100.0 * change:+.2f} %", scaled(rig.camera_settings, 1.0 + change), rig.cam_T_grip)


def _focus(rng: Rng, rig: Rig) -> Trial:
    """A blur of 1 to 3 px, half of the time with a lens that breathes."""
    sigma_px = float(rng.uniform(1.0, 3.0))
    breath = float(rng.uniform(-5e-3, 5e-3)) if rng.random() < 0.5 else 0.0
    lens, blur = scaled(rig.camera_settings, 1.0 + breath), (Defocus(sigma_px=sigma_px, start_s=rig.at_s),)
    return _other_camera(rig, f"{sigma_px:.1f} px, {100.0 * breath:+.2f} %", lens, rig.cam_T_grip, defocus=blur)


def _blocked(rng: Rng, rig: Rig) -> Trial:
    """A hand or a sheet comes in within some frames, and stays."""
    kind, side = str(rng.choice(["hand", "sheet"])), str(rng.choice(["left", "right", "top", "bottom"]))
    reach = float(rng.uniform(0.5, 1.0))
    cover = Cover(
        kind=kind,  # type: ignore[arg-type]
        side=side,  # type: ignore[arg-type]
        start_s=rig.at_s,
        end_s=1e4,
        move_s=4.0 / rig.scenario.fps,
        reach=reach,
        distance_m=float(rng.uniform(0.04, 0.07)),
    )
    return _shown(rig, f"{kind} from the {side}, {100.0 * reach:.0f} %", covers=(cover,))


def _bad_image(rng: Rng, rig: Rig) -> Trial:
    """Dark, over-exposed, flat, all noise, or none at all."""
    kind = str(rng.choice(["dark", "white", "flat", "noise", "none"]))
    if kind in ("dark", "white"):
        factors = [float(rng.uniform(0.001, 0.015))] if kind == "dark" else [19.0, float(rng.uniform(2.0, 19.0))]
        light = Light(steps=tuple(LightStep(at_s=rig.at_s, factor=factor) for factor in factors))
        return _shown(rig, kind, light=light)
    level, sigma = float(rng.uniform(20.0, 230.0)), float(rng.uniform(30.0, 80.0))
    seed = int(rng.integers(2**31))

    def change(frame: Frame, after: int) -> Frame:
        if kind == "none":
            return replace(frame, image=None, fault="the frame can't be decoded")
        own = np.random.default_rng([seed, after])
        shape = np.asarray(frame.image).shape
        grey = np.full(shape, level) if kind == "flat" else np.asarray(frame.image, float) + own.normal(0, sigma, shape)
        return replace(frame, image=np.clip(grey, 0.0, 255.0).astype(np.uint8))

    return _changed(rig, kind, change)


def _ring(rig: Rig, count: int, change: Callable[[int, Frame, Frame], Frame], well: int, what: str) -> Trial:
    """A long stream of which few frames are rendered.  ``change`` gets how many frames it is after the event (negative
    before), the frame as it would be, and the last one before the event.
    """

    def frames() -> Iterator[Frame]:
        simulator = rig.simulator()
        ring = [simulator.frame(index) for index in range(_RING)]
        period = 2 * (_RING - 1)

        def frame(index: int) -> Frame:
            place = index % period
            shown = ring[min(place, period - place)]
            stamp_ns = rig.scenario.start_ns + round(index * 1e9 / rig.scenario.fps)
            return replace(shown, seq=index, stamp_ns=stamp_ns)

        for index in range(well + count):
            yield change(index - well, frame(index), frame(well - 1))

    return Trial(rig, what, None, well, frames)


def _seconds(rig: Rig, seconds: float) -> int:
    return math.ceil(seconds * rig.scenario.fps)


def _frozen(rng: Rng, rig: Rig) -> Trial:
    """The last images come again, 1 to 4 of them in turn."""
    buffers = int(rng.integers(1, 5))
    kept: list[Image | None] = []

    def change(after: int, frame: Frame, last: Frame) -> Frame:
        if after < 0:
            kept.append(frame.image)
            return frame
        image = kept[len(kept) - buffers + after % buffers] if len(kept) >= buffers else last.image
        return replace(frame, image=image)

    return _ring(rig, _seconds(rig, 1.5), change, _seconds(rig, 3.0), f"{buffers} images in turn")


def _clock(rng: Rng, rig: Rig) -> Trial:
    """Stamps go back, stand still, or jump ahead."""
    kind = str(rng.choice(["back", "still", "ahead"]))
    jump_ns = int(1e9 * _log_uniform(rng, 0.1 if kind == "back" else 10.0, 1e5))

    def change(after: int, frame: Frame, last: Frame) -> Frame:
        if after < 0:
            return frame
        if kind == "still":
            return replace(frame, stamp_ns=last.stamp_ns)
        return replace(frame, stamp_ns=frame.stamp_ns + (jump_ns if kind == "ahead" else -jump_ns))

    return _ring(rig, AFTER, change, _seconds(rig, 3.0), f"{kind}, {1e-9 * jump_ns:.1f} s")


def _replaced(rng: Rng, rig: Rig) -> Trial:
    """Images of another size or type; or, after some time without any, of the same from another camera."""
    if rng.random() < 0.5:
        smaller = bool(rng.random() < 0.5)

        def change(frame: Frame, _: int) -> Frame:
            image = np.asarray(frame.image)
            other = image[:-96, :-128] if smaller else image.astype(np.uint16) * 257
            return replace(frame, image=other)

        return _changed(rig, "another size" if smaller else "another type", change)
    lens = rig.camera_settings
    lens = msgspec.structs.replace(
        scaled(lens, 1.0 + float(rng.choice([-1.0, 1.0])) * _log_uniform(rng, 0.005, 0.05)),
        cx_px=lens.cx_px + float(rng.normal(0.0, 8.0)),
        cy_px=lens.cy_px + float(rng.normal(0.0, 8.0)),
    )
    pose = perturb(rig.cam_T_grip, rng.normal(0.0, [5e-4] * 3 + [0.01] * 3))
    sensor = msgspec.structs.replace(
        rig.scenario.sensor,
        read_noise_dn=float(rng.uniform(0.5, 4.0)),
        psf_sigma_px=float(rng.uniform(0.5, 0.9)),
    )
    away_ns = int(1e9 * _log_uniform(rng, 10.0, 1000.0))  # no one exchanges a camera within a frame

    def frames() -> Iterator[Frame]:
        before, after = rig.simulator(), rig.simulator(lens, pose, sensor=sensor)
        for index in range(WELL + AFTER):
            frame = (before if index < WELL else after).frame(index)
            yield frame if index < WELL else replace(frame, stamp_ns=frame.stamp_ns + away_ns)

    return Trial(rig, f"the same type, focal length {lens.fx_px:.0f} px", None, WELL, frames)


ROWS: dict[str, Row] = {
    row.name: row
    for row in (
        Row("nothing", None, _nothing),
        Row("mount", Cause.CAMERA_MOUNT, _mount),
        Row("finger", Cause.FINGER_BENT, _finger),
        Row("jaw", Cause.JAW_OPENING, _jaw, reported=True),
        Row("focal", Cause.LENS, _focal),
        Row("focus", Cause.LENS, _focus),
        Row("blocked", Cause.VIEW_BLOCKED, _blocked),
        Row("image", Cause.IMAGE_BAD, _bad_image),
        Row("frozen", Cause.CAMERA_FROZEN, _frozen),
        Row("replaced", Cause.CAMERA_REPLACED, _replaced),
        Row("clock", Cause.CLOCK, _clock),
    )
}
