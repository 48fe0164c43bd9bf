"""A laser pointer on an arm, a plane and a fixed camera: poses that keep the spot in view, and its images.

The set-up is the laser-pointer paper's (Hu and Chang, Industrial Robot 39/2, 2012).  The paper doesn't state the
distance of the hand from the plane, the slant of the beam, or the length of the shifts: here the laser is 15 to 35 cm
from its spot, up to 50 degrees off the plane's normal, and shifts are up to 12 cm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array, Image


@dataclass(frozen=True)
class LaserCell:
    """``cam_T_base`` (4, 4); the plane ``normal_cam . p = distance_m`` with a unit normal (3,) away from the camera;
    the laser line through ``point_ee_m`` (3,) along the unit vector ``direction_ee`` (3,), end-effector frame.
    """

    cam_T_base: Array
    normal_cam: Array
    distance_m: float
    point_ee_m: Array
    direction_ee: Array

    def seen_by(self, cam_T_base: Array) -> LaserCell:
        """The same plane and laser, seen by a camera at another pose."""
        new_T_old = cam_T_base @ invert(self.cam_T_base)
        normal = new_T_old[:3, :3] @ self.normal_cam
        distance_m = self.distance_m + float(normal @ new_T_old[:3, 3])
        return LaserCell(cam_T_base, normal, distance_m, self.point_ee_m, self.direction_ee)


def paper_cell(rng: np.random.Generator) -> LaserCell:
    """The paper's simulation: base_T_cam, laser, and a plane 550 mm away, tilted by up to 5 degrees about x and y."""
    rotation = Rotation.from_euler("ZYX", [-90.0, -10.0, -170.0], degrees=True).as_matrix()
    base_T_cam = make_transform(rotation, np.array([0.510, 0.151, 0.430]))
    theta, phi = np.radians([-1.80, 53.39])
    beam = np.array([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])
    normal = Rotation.from_euler("xy", rng.uniform(-5.0, 5.0, 2), degrees=True).apply([0.0, 0.0, 1.0])
    return LaserCell(invert(base_T_cam), normal, 0.55 * float(normal[2]), np.array([0.0, -0.010, 0.030]), beam)


def spots_cam_m(cell: LaserCell, base_T_ee: Array) -> Array:
    """Where the beam meets the plane (n, 3), camera frame, at poses (n, 4, 4)."""
    cam_T_ee = cell.cam_T_base @ base_T_ee
    points = cam_T_ee[:, :3, :3] @ cell.point_ee_m + cam_T_ee[:, :3, 3]
    beams = cam_T_ee[:, :3, :3] @ cell.direction_ee
    ways = (cell.distance_m - points @ cell.normal_cam) / (beams @ cell.normal_cam)
    return np.asarray(points + ways[:, None] * beams)


def pixels_of(cell: LaserCell, camera: Camera, base_T_ee: Array) -> Array:
    """The spots' pixels (n, 2), NaN outside the lens's domain."""
    return camera.project(spots_cam_m(cell, base_T_ee))


def poses_on_plane(
    cell: LaserCell, camera: Camera, rng: np.random.Generator, *, orientations: int = 5,
    reach_m: tuple[float, float] = (0.15, 0.35), tilt_deg: float = 50.0, shift_m: float = 0.12, border_px: float = 2.0,
) -> tuple[Array, Array]:  # fmt: skip
    """``base_T_ee`` (n, 4, 4) and the number of each one's orientation (n,): ten spots per orientation, a first pose
    and three shifts along each of three random directions, all farther than ``border_px`` from the image's border.
    """
    base_T_cam = invert(cell.cam_T_base)
    size = np.array([camera.width_px, camera.height_px])
    poses: list[Array] = []
    while len(poses) < 10 * orientations:
        target = camera.undistort(rng.uniform([0.1, 0.1], [0.9, 0.9], (1, 2)) * size)
        ray = np.array([*target[0], 1.0])
        spot = ray * cell.distance_m / (cell.normal_cam @ ray)
        tilt, around = np.radians(tilt_deg) * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        lean = Rotation.from_rotvec(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
        beam = lean.apply(cell.normal_cam)
        turned = Rotation.align_vectors([beam], [cell.direction_ee])[0]
        turned = turned * Rotation.from_rotvec(cell.direction_ee * rng.uniform(-np.pi / 3, np.pi / 3))
        base_R_ee = base_T_cam[:3, :3] @ turned.as_matrix()
        laser = spot - beam * rng.uniform(*reach_m)
        first = base_T_cam[:3, :3] @ laser + base_T_cam[:3, 3] - base_R_ee @ cell.point_ee_m
        group = _shifted(cell, camera, base_R_ee, first, shift_m, border_px, rng)
        if group is not None:
            poses += group
    return np.stack(poses), np.repeat(np.arange(orientations), 10)


def _shifted(
    cell: LaserCell, camera: Camera, base_R_ee: Array, first: Array, shift_m: float, border_px: float,
    rng: np.random.Generator,
) -> list[Array] | None:  # fmt: skip
    directions = np.linalg.qr(rng.normal(size=(3, 3)))[0] + 0.3 * rng.uniform(-1.0, 1.0, (3, 3))
    size = np.array([camera.width_px, camera.height_px])
    shifts = [np.zeros(3)]
    for direction in directions:
        for _ in range(3):
            for _ in range(20):
                shift = direction / np.linalg.norm(direction) * rng.uniform(-shift_m, shift_m)
                uv = pixels_of(cell, camera, make_transform(base_R_ee, first + shift)[None])
                far = np.linalg.norm(shift) > 0.25 * shift_m
                if far and np.isfinite(uv).all() and (uv > border_px).all() and (uv < size - 1.0 - border_px).all():
                    shifts.append(shift)
                    break
            else:
                return None
    return [make_transform(base_R_ee, first + shift) for shift in shifts]


def spot_image(
    uv_px: Array | None, rng: np.random.Generator, *, size_px: tuple[int, int] = (640, 480), sigma_px: float = 3.0,
    height: float = 200.0, speckle: float = 0.0, ambient: Array | None = None, noise: float = 2.0, colour: bool = False,
    reflections: tuple[tuple[float, float, float], ...] = (), dtype: type[Any] = np.uint8,
) -> Image:  # fmt: skip
    """Image of a spot at a pixel (2,); None: the laser is off.  A Gaussian of ``height`` grey levels over the
    background, saturated at full scale; ``speckle``: contrast of its grains; ``reflections``: further blobs (u, v,
    height); ``ambient`` (h, w) grey levels.  16-bit images hold 12 bits.
    """
    width, rows = size_px
    v, u = np.mgrid[0:rows, 0:width].astype(float)
    light = np.zeros((rows, width))
    own = () if uv_px is None else ((float(uv_px[0]), float(uv_px[1]), height),)
    for x, y, peak in (*own, *reflections):
        light += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * sigma_px**2))
    if speckle:
        grains = cv2.GaussianBlur(rng.normal(size=light.shape), (0, 0), 1.0)
        light *= np.exp(speckle * grains / grains.std())
    scale, full = (1.0, 255.0) if dtype == np.uint8 else (16.0, 4095.0)
    background = (np.full(light.shape, 30.0) if ambient is None else ambient)[:, :, None]
    shares = np.array([0.1, 0.2, 1.0]) if colour else np.ones(1)  # a red laser
    image = scale * (background + light[:, :, None] * shares + rng.normal(0.0, noise, (*light.shape, len(shares))))
    image = np.clip(np.rint(image), 0.0, full).astype(dtype)
    return np.ascontiguousarray(image[:, :, 0] if image.shape[2] == 1 else image)


def cluttered(rng: np.random.Generator, size_px: tuple[int, int] = (640, 480)) -> Array:
    """Ambient light with gradients, edges and bright objects, grey levels."""
    width, rows = size_px
    v, u = np.mgrid[0:rows, 0:width].astype(float)
    out = 40.0 + 40.0 * u / width + 20.0 * np.sin(v / 60.0)
    for _ in range(6):
        x, y = rng.uniform(0.1, 0.9, 2) * [width, rows]
        out[(np.abs(u - x) < rng.uniform(30, 80)) & (np.abs(v - y) < rng.uniform(30, 80))] += rng.uniform(20.0, 90.0)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 1.5))
