"""Images for ``tools/bench offline``: calibration plates behind the simulator's fingers, and plates alone."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.fingers import gripper_of, shipped
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import exp_rotation, make_transform, perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.model.targets import Chequerboard, CircleGrid
from gripmon.simulate import PAPER_LENS, Scenario, Simulator, paper_rig
from gripmon.simulate.plates import Plate, PlateBackdrop, Print
from gripmon.simulate.scenario import Background, FingerLook, JawScript, Sensor

DISCS = CircleGrid(8, 8, 0.008, 0.004)
OPENING_M = 0.05
"""The fingers then stand near the left and the right border, as in the paper."""
TILT_RAD = np.radians(32.0)
DISTANCE_M = 0.115


@functools.lru_cache(maxsize=1)
def gripper() -> Gripper:
    return gripper_of(shipped("two_box_fingers"))


@dataclass(frozen=True)
class Setting:
    """One image of the gripper on the plate: where it is, how the plate lies, what isn't as it should be."""

    cam_T_grip: Array
    grip_T_plate: Array
    errors_m: Array | None = None

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, print_m: float = 0.0, tilt_rad: tuple[float, float] = (0.0, 0.0),
        gap_m: float = 0.0,
    ) -> Setting:  # fmt: skip
        """The paper's geometry, scattered; a plate turned any way, printed with errors (standard deviation each axis)
        and standing off the gripper's contact plane by a tilt about its x and y and a gap.
        """
        nominal = make_transform(exp_rotation(np.array([TILT_RAD, 0.0, 0.0])), np.array([0.0, 0.002, DISTANCE_M]))
        cam_T_grip = perturb(nominal, rng.normal(0.0, [2e-3] * 3 + [0.02] * 3))
        turn = exp_rotation(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        middle = 0.5 * DISCS.spacing_m * np.array([DISCS.columns - 1.0, DISCS.rows - 1.0, 0.0])
        shift = np.array([*rng.uniform(-4e-3, 4e-3, 2), 0.0])
        off = make_transform(exp_rotation(np.array([*tilt_rad, 0.0])), np.array([0.0, 0.0, gap_m]))
        errors = rng.normal(0.0, print_m, (DISCS.rows, DISCS.columns, 2)) if print_m else None
        return cls(cam_T_grip, off @ make_transform(turn, shift - turn @ middle), errors)

    def simulators(self, seed: int, noises_dn: tuple[float, ...]) -> list[Simulator]:
        """The same scene with sensors of so much read noise each, sharing one plate."""
        look = Print(margin=np.inf, errors_m=self.errors_m)
        plate = Plate(DISCS, self.cam_T_grip @ self.grip_T_plate, look)
        backdrop = PlateBackdrop(plate, PAPER_LENS, Sensor().psf_sigma_px)
        made = []
        for noise in noises_dn:
            scenario = Scenario(
                name="plate",
                background=Background(kind="plain", boxes=0, cables=0, motion="still"),
                fingers=FingerLook(carriers=False),
                jaw=JawScript(knots=((0.0, OPENING_M),)),
                sensor=msgspec.structs.replace(Sensor(), read_noise_dn=noise, exposure_time_s=0.0),
            )
            made.append(paper_rig(gripper(), self.cam_T_grip).simulator(scenario, seed, backdrop))
        return made


class View(NamedTuple):
    """An image of a chequerboard, and where its n corners truly are in it, ``corners_px`` (n, 2), row by row."""

    image: NDArray[np.uint8]
    corners_px: Array


def corners_of(target: Chequerboard) -> Array:
    """(n, 3) row by row, on the plate."""
    r, c = np.mgrid[: target.rows, : target.columns]
    return np.stack([c.ravel(), r.ravel(), np.zeros(c.size)], axis=1) * target.square_m


def views(lens: LensSettings, target: Chequerboard, count: int, rng: np.random.Generator) -> list[View]:
    """A plate held before a camera, tilted to all sides, whole in every view."""
    images: list[View] = []
    camera = make_camera(lens)
    size = np.array([target.columns - 1, target.rows - 1]) * target.square_m
    outer = np.array([[-1, -1], [target.columns, -1], [target.columns, target.rows], [-1, target.rows]])
    corners_m = np.concatenate([outer * target.square_m, np.zeros((4, 1))], axis=1)
    while len(images) < count:
        way = rng.uniform(0.0, 2.0 * np.pi)
        tilt = rng.uniform(0.2, 0.75) * np.array([np.cos(way), np.sin(way), 0.0])
        rotation = exp_rotation(tilt) @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        depth = 1.15 * lens.fx_px * size[0] / lens.width_px * rng.uniform(1.0, 1.7)
        middle = depth * np.array([*rng.uniform(-0.2, 0.2, 2), 1.0])
        cam_T_plate = make_transform(rotation, middle - rotation @ np.array([*(0.5 * size), 0.0]))
        with np.errstate(invalid="ignore"):
            uv = camera.project(corners_m @ rotation.T + cam_T_plate[:3, 3])
            if not ((uv > 4.0) & (uv < np.array([lens.width_px, lens.height_px]) - 5.0)).all():
                continue
        light = Plate(target, cam_T_plate, Print(margin=np.inf)).light(lens, Sensor().psf_sigma_px)
        noisy = light + rng.normal(0.0, 1.5, light.shape)
        corners_px = camera.project(corners_of(target) @ rotation.T + cam_T_plate[:3, 3])
        images.append(View(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), corners_px))
    return images
