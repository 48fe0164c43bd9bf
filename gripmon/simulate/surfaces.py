"""What the bodies look like: one shade a face by the lamp's direction, times a texture that sticks to the face."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.simulate import patterns, textures
from gripmon.simulate.scenario import Cover, FingerLook, ObjectLook
from gripmon.simulate.solids import Solid
from gripmon.simulate.textures import Factor

_LARGEST_TEXTURE_PX = 1200
_SKIN_LEVEL_DN = 150.0
_SHEET_LEVEL_DN = 205.0
_MOST_COMPRESSED = 12.0


@dataclass(frozen=True)
class Surface:
    """A face's brightness, texture (DN; None: even), and the frame of its plane in the body's frame."""

    level_dn: float
    texture: NDArray[np.float32] | None
    px_per_m: float
    body_T_plane: Array


class Painter:
    """Makes the surfaces of bodies: shades by the lamp's direction at the nominal pose, textures from one seed."""

    def __init__(self, rng: np.random.Generator, look: FingerLook, cam_T_grip: Array, focal_px: float) -> None:
        self._rng, self._look, self._cam_T_grip, self._focal_px = rng, look, cam_T_grip, focal_px
        self._px_per_m = focal_px / float(cam_T_grip[2, 3])
        self._lamp_cam = np.array(look.lamp_cam) / np.linalg.norm(look.lamp_cam)

    def metal(self, solid: Solid, gain: float, *, marked: bool = False) -> tuple[Surface, ...]:
        """Surfaces of a metal body, one a face; ``marked``: a finger, with the look's marks."""
        look, surfaces = self._look, []
        for face, bevel in enumerate(solid.bevel):
            level = gain * look.level_dn * self._shade(solid, face) * (look.bevel_gain if bevel else 1.0)
            body_T_plane, rows, columns, px_per_m = self._sheet(solid, face)
            texture = None
            if look.texture > 0.0:
                texture = textures.metal(self._rng, rows, columns, px_per_m, look.texture)
                texture = level * self._foreshortened(texture, body_T_plane, px_per_m)
            if look.highlights > 0.0:
                matt = np.full((rows, columns), level, np.float32) if texture is None else texture
                texture = matt * textures.streak(self._rng, columns, look.highlights)
            marks = [] if bevel or not marked else [m for m in look.marks if m.finger in ("", solid.name)]
            if marks:
                plain = np.full((rows, columns), level, np.float32) if texture is None else texture
                grid = patterns.grid_m(rows, columns, px_per_m, body_T_plane)
                texture = plain * patterns.marks(marks, solid, face, grid, px_per_m)
            surfaces.append(Surface(level, texture, px_per_m, body_T_plane))
        return tuple(surfaces)

    def object(self, solid: Solid, look: ObjectLook) -> tuple[Surface, ...]:
        """Surfaces of a box, one a face."""
        surfaces = []
        for face in range(len(solid.loops)):
            level = look.level_dn * self._shade(solid, face)
            body_T_plane, rows, columns, px_per_m = self._sheet(solid, face)
            if look.pattern == "printed":
                texture = textures.printed(self._rng, rows, columns, px_per_m)
            else:
                grid = patterns.grid_m(rows, columns, px_per_m, body_T_plane)
                texture = patterns.lines(self._rng, look, solid, grid, px_per_m)
            texture = level * self._foreshortened(texture, body_T_plane, px_per_m)
            surfaces.append(Surface(level, texture, px_per_m, body_T_plane))
        return tuple(surfaces)

    def copy(self, surfaces: tuple[Surface, ...], mirrored: bool) -> tuple[Surface, ...]:
        """Surfaces of a copy of a body, or of its mirror image across z = 0."""
        mirror = np.diag([1.0, 1.0, -1.0 if mirrored else 1.0, 1.0])
        return tuple(dataclasses.replace(s, body_T_plane=mirror @ s.body_T_plane) for s in surfaces)

    def cover(self, cover: Cover, outline: Array) -> Surface:
        """Skin, or a printed sheet; beyond its texture the border's grey goes on."""
        low, high = outline.min(axis=0), outline.max(axis=0)
        length = float(high[0] - low[0])
        px_per_m = min(self._focal_px / cover.distance_m * 0.5, _LARGEST_TEXTURE_PX / length)
        columns, rows = math.ceil(length * px_per_m), math.ceil(float(high[1] - low[1]) * px_per_m)
        if cover.kind == "sheet":
            texture = _SHEET_LEVEL_DN * (0.9 + 0.1 * textures.printed(self._rng, rows, columns, px_per_m))
        else:
            texture = _SKIN_LEVEL_DN * textures.skin(self._rng, rows, columns, px_per_m)
        body_T_plane = np.eye(4)
        body_T_plane[:3, 3] = low
        return Surface(0.0, np.ascontiguousarray(texture, dtype=np.float32), px_per_m, body_T_plane)

    def _shade(self, solid: Solid, face: int) -> float:
        towards = float(self._cam_T_grip[:3, :3] @ solid.normals[face] @ self._lamp_cam)
        return self._look.ambient + (1.0 - self._look.ambient) * max(towards, 0.0)

    def _sheet(self, solid: Solid, face: int) -> tuple[Array, int, int, float]:
        """Frame of a face, and rows, columns and pixels a metre of its texture."""
        body_T_plane, extent_m = _plane_frame(solid, face)
        px_per_m = min(self._px_per_m, _LARGEST_TEXTURE_PX / float(extent_m.max()))
        columns, rows = (max(math.ceil(float(e) * px_per_m), 4) for e in extent_m)
        return body_T_plane, rows, columns, px_per_m

    def _foreshortened(self, texture: Factor, body_T_plane: Array, px_per_m: float) -> Factor:
        """Smooth a texture along the axes in which it will appear compressed, so that it doesn't alias."""
        cam_T_plane = self._cam_T_grip @ body_T_plane
        size_m = np.array([texture.shape[1], texture.shape[0]]) / px_per_m
        x, y, z = cam_T_plane[:3, :2] @ (0.5 * size_m) + cam_T_plane[:3, 3]
        if z <= 0.0:
            return texture
        along = cam_T_plane[:2, :2] - np.outer((x / z, y / z), cam_T_plane[2, :2])
        image_px_per_m = np.linalg.norm(along, axis=0) * self._focal_px / z
        ratio = np.clip(px_per_m / image_px_per_m, 1.0, _MOST_COMPRESSED)
        sigma_u, sigma_v = (0.5 * np.sqrt(ratio**2 - 1.0) + 0.01).tolist()
        return np.asarray(cv2.GaussianBlur(texture, (0, 0), sigma_u, sigmaY=sigma_v), dtype=np.float32)


def _plane_frame(solid: Solid, face: int) -> tuple[Array, Array]:
    """Frame of a face in the body's frame, x along its longest side, and the face's extent (2,) along x and y."""
    corners = solid.vertices_m[solid.loops[face]]
    sides = np.roll(corners, -1, axis=0) - corners
    longest = int(np.linalg.norm(sides, axis=1).argmax())
    x = sides[longest] / np.linalg.norm(sides[longest])
    y = np.cross(x, solid.normals[face])  # down for somebody who looks at the face with x to the right
    along, across = corners @ x, corners @ y
    body_T_plane = np.eye(4)
    body_T_plane[:3, :3] = np.column_stack([x, y, -solid.normals[face]])
    body_T_plane[:3, 3] = along.min() * x + across.min() * y + solid.offsets_m[face] * solid.normals[face]
    return body_T_plane, np.array([np.ptp(along), np.ptp(across)])
