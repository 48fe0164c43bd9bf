"""Laser set-ups with known truth: the laser-pointer paper's, and poses that keep the spot in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.laser.setup import LaserSetup
from gripmon.model.camera import BrownConradyLens, Camera, make_camera
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array
from gripmon.simulate.laser import LaserCell, paper_cell, pixels_of, poses_on_plane

PAPER_LENS = BrownConradyLens(width_px=640, height_px=480, fx_px=543.0, fy_px=543.0, cx_px=320.0, cy_px=240.0)


@dataclass(frozen=True)
class LaserData:
    camera: Camera
    truth: LaserSetup
    base_T_ee: Array
    uv_px: Array  # without noise
    group: Array


def paper_setup(rng: np.random.Generator) -> LaserSetup:
    """The paper's simulation."""
    return LaserSetup.seen(**vars(paper_cell(rng)))


REAL_LENS = BrownConradyLens(
    width_px=640, height_px=480, fx_px=2283.161, fy_px=2283.039, cx_px=269.910, cy_px=248.321,
    coefficients=(0.044, 3.869, -0.002, -0.009),
)  # fmt: skip
"""The paper's real camera."""


def real_setup(rng: np.random.Generator) -> LaserSetup:
    """Like the paper's real one: a camera about 1 m from the base that looks down on a plane 1.1 m from it, of which it
    sees about 20 x 15 cm.
    """
    plane = np.array([1.1, 0.0, 0.0]) + rng.uniform(-0.05, 0.05, 3)
    down = Rotation.from_euler("xyz", [180.0, *rng.uniform(-15.0, 15.0, 2)], degrees=True).as_matrix()
    base_T_cam = make_transform(down, plane - 0.72 * down[:, 2])
    normal = Rotation.from_euler("xy", rng.uniform(-5.0, 5.0, 2), degrees=True).apply(-base_T_cam[:3, :3].T[:, 2])
    theta, phi = np.radians([-1.80, 53.39])
    beam = np.array([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])
    normal = normal * np.sign(normal[2])
    return LaserSetup.seen(invert(base_T_cam), normal, 0.72 * float(normal[2]), np.array([0.0, -0.010, 0.030]), beam)


def sampled(
    setup: LaserSetup, rng: np.random.Generator, *, lens: BrownConradyLens = PAPER_LENS, orientations: int = 5,
    reach_m: tuple[float, float] = (0.15, 0.35), tilt_deg: float = 50.0, shift_m: float = 0.12,
) -> LaserData:  # fmt: skip
    """Ten spots an orientation: a first pose and three shifts along each of three random directions."""
    camera = make_camera(lens)
    cell = LaserCell(setup.cam_T_base, setup.normal_cam, setup.distance_cam_m, setup.point_ee_m, setup.direction_ee)
    base_T_ee, group = poses_on_plane(
        cell, camera, rng, orientations=orientations, reach_m=reach_m, tilt_deg=tilt_deg, shift_m=shift_m
    )
    return LaserData(camera, setup, base_T_ee, pixels_of(cell, camera, base_T_ee), group)
