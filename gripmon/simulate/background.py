"""The table below the gripper and the things on it, seen through the lens while the robot moves over it.

The image needn't be exact to a hundredth of a pixel, only realistic: textures with straight strong edges, parallax
between the table and the tops of boxes, motion blur.  Table frame: z into the table, which is z = 0; x and y periodic.
"""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array
from gripmon.simulate import textures
from gripmon.simulate.coverage import RayGrid
from gripmon.simulate.scenario import Background

_TILE_PX = 2048
_SQUARE_M = 0.01
_LEG_S = 1.6
_LIVELY_M_PER_S = 0.06  # from this speed on a wandering robot also rotates and changes its height fully
_LEAST_TEXTURED_PX = 12.0
_SMEAR_FROM_PX = 0.4


@dataclass(frozen=True)
class _Block:
    """A box that stands on the table: base centre, half sizes, rotation, height, five textures (top, four sides)."""

    centre_m: Array
    half_m: tuple[float, float]
    turn_rad: float
    height_m: float
    faces: tuple[NDArray[np.uint8], ...]


class _Table:
    """A table's ``tile``, two periods wide so that a view rarely crosses the seam, and the ``blocks`` on it; ``rng`` is
    as these have left it.
    """

    def __init__(self, settings: Background, seed: int, px_per_m: float) -> None:
        self._settings, self._px_per_m, self._period_m = settings, px_per_m, _TILE_PX / px_per_m
        self.rng = np.random.default_rng([seed, 1])
        self._tile = textures.table(self.rng, settings, _TILE_PX, px_per_m)
        self.blocks = self._place_blocks(self.rng)
        for block in self.blocks:
            self._cast_shadow(block)
        self.tile = np.pad(self._tile, _TILE_PX // 2, mode="wrap")

    def _place_blocks(self, rng: np.random.Generator) -> list[_Block]:
        """Boxes at random places that don't overlap."""
        count = round(self._settings.boxes * self._period_m**2 / 0.6)
        tallest = min(0.06, 0.45 * self._settings.distance_m)
        blocks: list[_Block] = []
        for _ in range(count * 6):
            half = rng.uniform(0.008, 0.03, 2)
            centre = rng.uniform(0.0, self._period_m, 2)
            if len(blocks) == count:
                break
            if any(self._apart(centre, b.centre_m) < np.hypot(*half) + math.hypot(*b.half_m) for b in blocks):
                continue
            height = float(rng.uniform(0.3, 1.0)) * tallest
            faces, turn = self._block_faces(rng, half, height), float(rng.uniform(0.0, math.pi))
            blocks.append(_Block(centre, (float(half[0]), float(half[1])), turn, height, faces))
        return blocks

    def _apart(self, a: Array, b: Array) -> float:
        difference = np.abs(a - b)
        return float(np.hypot(*np.minimum(difference, self._period_m - difference)))

    def _block_faces(self, rng: np.random.Generator, half: Array, height: float) -> tuple[NDArray[np.uint8], ...]:
        level = float(rng.uniform(50.0, 190.0))
        kind = int(rng.integers(0, 3))
        shades = (1.0, 0.45, 0.75, 0.55, 0.9)
        x, y, z = float(half[0]), float(half[1]), 0.5 * height
        sizes = ((x, y), (x, z), (y, z), (x, z), (y, z))
        faces = []
        for shade, (a, b) in zip(shades, sizes, strict=True):
            w, h = max(int(2 * a * self._px_per_m), 8), max(int(2 * b * self._px_per_m), 8)
            if kind == 0:
                surface = textures.printed(rng, h, w, self._px_per_m)
            elif kind == 1:
                surface = textures.metal(rng, h, w, self._px_per_m, 0.35)
            else:
                square = _SQUARE_M * self._px_per_m
                squares = (np.arange(h)[:, None] // square + np.arange(w) // square) % 2
                surface = (0.45 + 1.0 * squares).astype(np.float32)
            faces.append(np.clip(surface * level * shade, 0, 255).astype(np.uint8))
        return tuple(faces)

    def _cast_shadow(self, block: _Block) -> None:
        """Darken the table beside a box, for a lamp at 45 degrees."""
        base = _outline(block)
        hull = cv2.convexHull(np.concatenate([base, base + 0.6 * block.height_m]).astype(np.float32))[:, 0]
        size = _TILE_PX
        mask = np.zeros((size, size), np.uint8)
        for dx in (-size, 0, size):
            for dy in (-size, 0, size):
                corners = np.round((hull * self._px_per_m + (dx, dy)) * 16).astype(np.int32)
                cv2.fillPoly(mask, [corners], 255, cv2.LINE_AA, 4)
        u, v, w, h = cv2.boundingRect(mask)
        window = self._tile[v : v + h, u : u + w]
        shade = 1.0 - 0.5 * cv2.GaussianBlur(mask[v : v + h, u : u + w], (0, 0), 1.5).astype(np.float32) / 255.0
        window[:] = (window * shade).astype(np.uint8)


@functools.lru_cache(maxsize=4)
def _drawn(settings: Background, seed: int, px_per_m: float) -> _Table:
    """Drawing one takes as long as dozens of frames, and many sequences are above the same one."""
    return _Table(settings, seed, px_per_m)


class TableView:
    """Renders the background, uint8, for any pose of the gripper over the table."""

    def __init__(
        self, camera: Camera, rays: RayGrid, settings: Background, nominal_cam_T_grip: Array, seed: int, psf_px: float
    ) -> None:
        self._camera, self._rays = camera, rays
        self._blur_px = math.hypot(psf_px, settings.defocus_px)
        depth_m = nominal_cam_T_grip[2, 3] + settings.distance_m * abs(nominal_cam_T_grip[2, 2])
        self._px_per_m = float(camera.fx_px / depth_m)
        self._period_m = _TILE_PX / self._px_per_m
        # How the robot moves above it, and the focus, don't change the table.
        still = msgspec.structs.replace(settings, motion="still", speed_m_per_s=0.0, defocus_px=0.0)
        table = _drawn(still, seed, self._px_per_m)
        self._tile, self._blocks = table.tile, table.blocks
        self._centres_m = np.array([block.centre_m for block in table.blocks]).reshape(-1, 2)
        self._outlines_m = np.array([_outline(block) for block in table.blocks]).reshape(-1, 4, 2)
        self._tops_m = np.array([-block.height_m for block in table.blocks])
        self._path = _Path(copy.deepcopy(table.rng), settings)

    def cam_T_table(self, cam_T_grip: Array, t_s: float) -> Array:
        """Pose (4, 4) of the table in the camera frame while the robot follows its path."""
        x, y, turn, height_m = self._path.at(t_s)
        c, s = math.cos(turn), math.sin(turn)
        table_R_grip = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return cam_T_grip @ invert(make_transform(table_R_grip, np.array([x, y, -height_m])))

    def render(self, cam_T_grip: Array, t_s: float, exposure_s: float) -> NDArray[np.uint8]:
        """Image of the table at the middle of the exposure, blurred by the motion during it."""
        cam_T_table = self.cam_T_table(cam_T_grip, t_s)
        image = self._floor(cam_T_table)
        self._draw_blocks(image, cam_T_table)
        if exposure_s > 0.0:
            image = self._smear(image, cam_T_grip, t_s, exposure_s)
        return np.asarray(cv2.GaussianBlur(image, (0, 0), self._blur_px), dtype=np.uint8)

    def _floor(self, cam_T_table: Array) -> NDArray[np.uint8]:
        x, y = self._rays.plane_coordinates(cam_T_table, self._px_per_m)
        centre = x.shape[0] // 2, x.shape[1] // 2
        half = 0.5 * _TILE_PX
        maps = [self._rays.enlarge(m - _TILE_PX * math.floor(m[centre] / _TILE_PX) + half) for m in (x, y)]
        image = cv2.remap(self._tile, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(image, dtype=np.uint8)

    def _smear(self, image: NDArray[np.uint8], cam_T_grip: Array, t_s: float, exposure_s: float) -> NDArray[np.uint8]:
        """Blur by a uniform motion over the exposure, with a small kernel."""
        x, y, _, height_m = self._path.at(t_s)
        below = np.array([x, y, 0.0])  # the table point below the TCP at the middle of the exposure
        ends = []
        for share in (-0.5, 0.5):
            cam_T_table = self.cam_T_table(cam_T_grip, t_s + share * exposure_s)
            point = cam_T_table[:3, :3] @ below + cam_T_table[:3, 3]
            ends.append(np.array([self._camera.fx_px, self._camera.fy_px]) * point[:2] / max(point[2], height_m))
        step = ends[1] - ends[0]
        if not float(np.hypot(*step)) > _SMEAR_FROM_PX:
            return image
        smeared = cv2.filter2D(image, -1, _smear_kernel(step), borderType=cv2.BORDER_REPLICATE)
        return np.asarray(smeared, dtype=np.uint8)

    def _draw_blocks(self, image: NDArray[np.uint8], cam_T_table: Array) -> None:
        """Paint the boxes in view from far to near."""
        if not self._blocks:
            return
        eye = invert(cam_T_table)[:3, 3]
        look = self._rays.view_centre @ cam_T_table[:3, :3]
        middle = (eye - eye[2] / max(look[2], 0.1) * look)[:2]
        periods_m = self._period_m * np.round((middle - self._centres_m) / self._period_m)
        bases_m = self._outlines_m + periods_m[:, None]
        corners_m = np.zeros((len(self._blocks), 2, 4, 3))  # of the base, and of the top
        corners_m[..., :2] = bases_m[:, None]
        corners_m[:, 1, :, 2] = self._tops_m[:, None]
        corners_cam_m = corners_m.reshape(-1, 3) @ cam_T_table[:3, :3].T + cam_T_table[:3, 3]
        uv = self._camera.project(corners_cam_m).reshape(-1, 8, 2)
        size = np.array([self._camera.width_px, self._camera.height_px])
        in_view = np.isfinite(uv).all(axis=(1, 2)) & ((uv.max(axis=1) >= 0) & (uv.min(axis=1) <= size)).all(axis=1)
        away_m = np.linalg.norm(self._centres_m + periods_m - eye[:2], axis=1)
        for k in filter(in_view.__getitem__, np.argsort(-away_m, kind="stable").tolist()):
            _draw_block(image, eye, self._blocks[k], bases_m[k], uv[k])


def _draw_block(image: NDArray[np.uint8], eye: Array, block: _Block, base: Array, uv: Array) -> None:
    """A box with the ``base`` (4, 2) on the table, m, and corners ``uv`` (8, 2), px, the base's first."""
    for k in range(4):
        j = (k + 1) % 4
        along = base[j] - base[k]
        if along[1] * (eye[0] - base[k, 0]) - along[0] * (eye[1] - base[k, 1]) > 0.0:
            _paint_quad(image, uv[[k, j, j + 4, k + 4]], block.faces[1 + k])
    if eye[2] < -block.height_m:
        _paint_quad(image, uv[4:], block.faces[0])


class _Path:
    """The gripper's path over the table: x, y (m), rotation about its z axis (rad), height (m)."""

    def __init__(self, rng: np.random.Generator, settings: Background) -> None:
        self._settings = settings
        self._start = rng.uniform(0.0, 0.5, 2)
        self._turn = float(rng.uniform(0.0, 2.0 * math.pi))
        self._periods_s = rng.uniform(6.0, 14.0, (3, 2))
        self._phases = rng.uniform(0.0, 2.0 * math.pi, (3, 2))
        self._direction = float(rng.uniform(0.0, 2.0 * math.pi))
        self._leg_turns = rng.uniform(0.0, 2.0 * math.pi, 64)

    def at(self, t_s: float) -> tuple[float, float, float, float]:
        speed, height = self._settings.speed_m_per_s, self._settings.distance_m
        x, y = float(self._start[0]), float(self._start[1])
        match self._settings.motion:
            case "still":
                return x, y, self._turn, height
            case "linear":
                way = speed * t_s
                return x + way * math.cos(self._direction), y + way * math.sin(self._direction), self._turn, height
            case "stop_and_go":
                dx, dy = self._legs(t_s)
                return x + speed * dx, y + speed * dy, self._turn, height
            case "wander":
                waves = np.sin(2.0 * math.pi * t_s / self._periods_s + self._phases)
                reach = speed * self._periods_s / (2.0 * math.pi)
                dx, dy, _ = (0.7 * waves * reach).sum(axis=1).tolist()
                lively = min(speed / _LIVELY_M_PER_S, 1.0)
                turn, height = (
                    self._turn + 0.3 * lively * float(waves[2, 0]),
                    height * (1.0 + 0.1 * lively * float(waves[2, 1])),
                )
                return x + dx, y + dy, turn, height

    def _legs(self, t_s: float) -> tuple[float, float]:
        """Seconds of travel along x and y: each leg moves during its first half, then rests; the legs repeat."""
        legs = np.stack([np.cos(self._leg_turns), np.sin(self._leg_turns)], axis=1) * _LEG_S
        whole, rest = divmod(t_s / _LEG_S, 1.0)
        done, part = divmod(int(whole), len(legs))
        share = 0.5 - 0.5 * math.cos(math.pi * min(2.0 * rest, 1.0))
        total = done * legs.sum(axis=0) + legs[:part].sum(axis=0) + share * legs[part]
        return float(total[0]), float(total[1])


def _smear_kernel(step_px: Array) -> NDArray[np.float32]:
    """Kernel of a straight motion (2,): many points on it, each distributed over its four pixels."""
    half = math.ceil(0.5 * float(np.abs(step_px).max()) + 0.5)
    points = half + (np.linspace(-0.5, 0.5, 8 * half + 1)[:, None] * step_px)
    kernel = np.zeros((2 * half + 2, 2 * half + 2), np.float32)
    whole = np.floor(points).astype(np.intp)
    rest = points - whole
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - du - rest[:, 0]) * np.abs(1 - dv - rest[:, 1])
        np.add.at(kernel, (whole[:, 1] + dv, whole[:, 0] + du), share)
    return kernel[:-1, :-1] / kernel.sum()


def _outline(block: _Block) -> Array:
    """Base corners (4, 2) in the table frame."""
    c, s = math.cos(block.turn_rad), math.sin(block.turn_rad)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * block.half_m
    return corners @ np.array([[c, s], [-s, c]]) + block.centre_m


def _paint_quad(image: NDArray[np.uint8], corners_px: Array, texture: NDArray[np.uint8]) -> None:
    """Paint a textured quadrilateral (4, 2), with its texture mapped by the homography of its corners."""
    height, width = image.shape
    low = np.maximum(np.floor(corners_px.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners_px.max(axis=0)).astype(int) + 2, (width, height))
    size = high - low
    if (size <= 0).any():
        return
    window = image[low[1] : high[1], low[0] : high[0]]
    local = corners_px - low
    fixed = [np.round(local * 16).astype(np.int32)]
    if size.min() < _LEAST_TEXTURED_PX:
        cv2.fillPoly(window, fixed, float(texture.mean()), cv2.LINE_AA, 4)
        return
    h, w = texture.shape
    source = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], np.float32)
    homography = cv2.getPerspectiveTransform(source, local.astype(np.float32))
    warped = cv2.warpPerspective(
        texture, homography, (int(size[0]), int(size[1])), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    mask = np.zeros((int(size[1]), int(size[0])), np.uint8)
    cv2.fillPoly(mask, fixed, 255, cv2.LINE_AA, 4)
    cv2.copyTo(warped, mask, window)
