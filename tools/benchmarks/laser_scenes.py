"""Laser set-ups with known truth: the laser-pointer paper's, and poses that keep the spot in view.

The paper doesn't say how far the hand may be from the plane, how slanted the beam, nor how long the shifts: here the
laser is 15 to 35 cm from its spot, up to 50 degrees off the plane's normal, shifts are up to 12 cm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.laser.pointer.setup import LaserSetup, spots_on_plane
from gripmon.model.camera import BrownConradyLens, Camera, make_camera
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array

PAPER_LENS = BrownConradyLens(width_px=640, height_px=480, fx_px=543.0, fy_px=543.0, cx_px=320.0, cy_px=240.0)


@dataclass(frozen=True)
class LaserData:
    camera: Camera
    truth: LaserSetup
    base_T_ee: Array
    uv_px: Array  # without noise
    group: Array


def paper_setup(rng: np.random.Generator) -> LaserSetup:
    """The paper's simulation: base_T_cam, laser, and a plane 550 mm away that is tilted by up to 5 degrees twice."""
    rotation = Rotation.from_euler("ZYX", [-90.0, -10.0, -170.0], degrees=True).as_matrix()
    base_T_cam = make_transform(rotation, np.array([0.510, 0.151, 0.430]))
    theta, phi = np.radians([-1.80, 53.39])
    beam = np.array([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])
    normal = Rotation.from_euler("xy", rng.uniform(-5.0, 5.0, 2), degrees=True).apply([0.0, 0.0, 1.0])
    return LaserSetup(invert(base_T_cam), normal, 0.55 * float(normal[2]), np.array([0.0, -0.010, 0.030]), beam)


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
    return LaserSetup(invert(base_T_cam), normal, 0.72 * float(normal[2]), np.array([0.0, -0.010, 0.030]), beam)


def sampled(
    setup: LaserSetup, rng: np.random.Generator, *, lens: BrownConradyLens = PAPER_LENS, orientations: int = 5,
    reach_m: tuple[float, float] = (0.15, 0.35), tilt_deg: float = 50.0, shift_m: float = 0.12,
) -> LaserData:  # fmt: skip
    """Ten spots an orientation: a first pose and three shifts along each of three random directions."""
    camera = make_camera(lens)
    base_T_cam = invert(setup.cam_T_base)
    poses: list[Array] = []
    while len(poses) < 10 * orientations:
        target = camera.undistort(rng.uniform([0.1, 0.1], [0.9, 0.9], (1, 2)) * [lens.width_px, lens.height_px])
        ray = np.array([*target[0], 1.0])
        spot = ray * setup.distance_m / (setup.normal_cam @ ray)
        tilt, around = np.radians(tilt_deg) * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        lean = Rotation.from_rotvec(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
        beam = lean.apply(setup.normal_cam)
        turned = Rotation.align_vectors([beam], [setup.direction_ee])[0]
        turned = turned * Rotation.from_rotvec(setup.direction_ee * rng.uniform(-np.pi / 3, np.pi / 3))
        base_R_ee = base_T_cam[:3, :3] @ turned.as_matrix()
        laser = spot - beam * rng.uniform(*reach_m)
        first = base_T_cam[:3, :3] @ laser + base_T_cam[:3, 3] - base_R_ee @ setup.point_ee_m
        group = _shifted(setup, camera, base_R_ee, first, shift_m, rng)
        if group is not None:
            poses += group
    base_T_ee = np.stack(poses)
    uv_px = camera.project(spots_on_plane(setup, base_T_ee)[0])
    return LaserData(camera, setup, base_T_ee, uv_px, np.repeat(np.arange(orientations), 10))


def _shifted(
    setup: LaserSetup, camera: Camera, base_R_ee: Array, first: Array, shift_m: float, rng: np.random.Generator
) -> list[Array] | None:
    directions = np.linalg.qr(rng.normal(size=(3, 3)))[0] + 0.3 * rng.uniform(-1.0, 1.0, (3, 3))
    shifts = [np.zeros(3)]
    for direction in directions:
        for _ in range(3):
            for _ in range(20):
                shift = direction / np.linalg.norm(direction) * rng.uniform(-shift_m, shift_m)
                pose = make_transform(base_R_ee, first + shift)[None]
                spot = spots_on_plane(setup, pose)[0]
                uv = camera.project(spot)
                size = np.array([camera.width_px, camera.height_px])
                if (
                    abs(np.linalg.norm(shift)) > 0.25 * shift_m
                    and np.isfinite(uv).all()
                    and (uv > 2).all()
                    and (uv < size - 3).all()
                ):
                    shifts.append(shift)
                    break
            else:
                return None
    return [make_transform(base_R_ee, first + shift) for shift in shifts]
