"""The image before the sensor: background, fingers, object and covers with exact sub-pixel outlines.

The background and the faces' textures already have the lens's blur; the masks of :mod:`gripmon.simulate.coverage` have
the same blur, so that an outline is at its true position whatever lies beside it.  Bodies have one shade per face from
the lamp's direction, times a texture fixed to the face.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.simulate import disturbance, textures
from gripmon.simulate.background import TableView
from gripmon.simulate.bodies import Bodies
from gripmon.simulate.coverage import Coverage, CoverageRaster, RayGrid, enlarge_cells
from gripmon.simulate.scenario import Cover, FingerLook, ObjectLook, Scenario
from gripmon.simulate.scene import Scene, SceneState
from gripmon.simulate.solids import Solid
from gripmon.simulate.textures import Factor

_CARRIER_GAIN = 0.9
_COVER_BLUR_PX = 1.0
_SMEAR_FROM_PX = 0.25
_SMEAR_STEP_PX = 1.0
_MOST_SUB_EXPOSURES = 8


@dataclass(frozen=True)
class _Layer:
    """A body in its window: the transmission for the light behind it, and its own light."""

    window: tuple[slice, slice]
    passes: NDArray[np.float32]
    light: NDArray[np.float32]


class Backdrop(Protocol):
    """What is visible behind the gripper: light (height, width) in DN, with the lens's blur."""

    def render(self, cam_T_grip: Array, t_s: float, exposure_s: float) -> NDArray[Any]: ...


class Renderer:
    """Renders scene states of one scenario; caches the latest gripper layers, because often nothing moves.

    ``backdrop`` replaces the scenario's table.
    """

    def __init__(
        self,
        camera: Camera,
        bodies: Bodies,
        scene: Scene,
        scenario: Scenario,
        nominal_cam_T_grip: Array,
        seed: int,
        backdrop: Backdrop | None = None,
    ) -> None:
        self._camera, self._bodies, self._scene, self._scenario = camera, bodies, scene, scenario
        self.rays = RayGrid(camera)
        psf_px = scenario.sensor.psf_sigma_px
        self._raster = CoverageRaster(camera, psf_px)
        self._cover_raster = CoverageRaster(camera, _COVER_BLUR_PX)
        self._table: Backdrop = backdrop or TableView(
            camera, self.rays, scenario.background, nominal_cam_T_grip, seed, psf_px
        )
        rng = np.random.default_rng([seed, 5])
        painter = self._painter = Painter(rng, scenario.fingers, nominal_cam_T_grip, camera.fx_px)
        self._surfaces = {solid.name: painter.metal(solid, 1.0, marked=True) for solid in bodies.fingers}
        self._surfaces |= {solid.name: painter.metal(solid, _CARRIER_GAIN) for solid in bodies.carriers}
        if bodies.grasped is not None and scenario.grasped is not None:
            self._surfaces[bodies.grasped.name] = painter.object(bodies.grasped, scenario.grasped.look)
        outlines = zip(scenario.covers, bodies.cover_outlines, strict=True)
        self._cover_surfaces = [painter.cover(cover, outline) for cover, outline in outlines]
        for prop, solids in zip(scenario.props, bodies.props, strict=True):
            for k, solid in enumerate(solids):
                if prop.shape == "box":
                    self._surfaces[solid.name] = painter.object(solid, prop.look)
                else:
                    own = self._surfaces[bodies.fingers[k].name]
                    self._surfaces[solid.name] = painter.copy(own, prop.shape == "mirrored_fingers")
        self._cache: tuple[bytes, list[_Layer]] = (b"", [])

    def render(self, time_s: float) -> NDArray[np.float32]:
        """Light on the sensor (height, width), DN at exposure 1, averaged over the exposure around a time."""
        exposure_s = self._scenario.sensor.exposure_time_s
        middle = self._scene.at(time_s)
        background = self._table.render(middle.cam_T_grip, time_s, exposure_s).astype(np.float32)
        states = self._sub_exposures(middle, exposure_s)
        if len(states) == 1:
            return self._compose(background, middle)
        total = np.zeros_like(background)
        for state, share in states:
            cv2.scaleAdd(self._compose(background.copy(), state), share, total, total)
        return total

    def _sub_exposures(self, middle: SceneState, exposure_s: float) -> list[tuple[SceneState, float]]:
        """States within the exposure and their Gauss weights: several only if the gripper moves in the image."""
        if exposure_s == 0.0 or self._scenario.pairs is not None:
            return [(middle, 1.0)]
        ends = [self._scene.at(max(middle.time_s + k * exposure_s, 0.0)) for k in (-0.5, 0.5)]
        way = np.abs(self._tip_pixels(ends[1]) - self._tip_pixels(ends[0]))
        longest = float(np.nanmax(way, initial=0.0))
        if longest < _SMEAR_FROM_PX:
            return [(middle, 1.0)]
        count = min(math.ceil(longest / _SMEAR_STEP_PX) + 1, _MOST_SUB_EXPOSURES)
        nodes, weights = np.polynomial.legendre.leggauss(count)
        times = np.maximum(middle.time_s + 0.5 * exposure_s * nodes, 0.0)
        return [(self._scene.at(t), 0.5 * w) for t, w in zip(times.tolist(), weights.tolist(), strict=True)]

    def _tip_pixels(self, state: SceneState) -> Array:
        points = state.points_grip_m @ state.cam_T_grip[:3, :3].T + state.cam_T_grip[:3, 3]
        return self._camera.project(points[self._bodies.gripper.corner_points])

    def _compose(self, canvas: NDArray[np.float32], state: SceneState) -> NDArray[np.float32]:
        """Draw all bodies over the background, in place."""
        for layer in self._body_layers(state):
            window = canvas[layer.window]
            cv2.multiply(window, layer.passes, window)
            cv2.add(window, layer.light, window)
        for (index, outline), (_, cam_T_cover) in zip(self._bodies.placed_covers(state), state.covers, strict=True):
            mask = self._cover_raster.masks([outline])[0]
            if mask is not None:
                layer = self._layer([(mask, self._cover_surfaces[index])], cam_T_cover, None)
                canvas[layer.window] = canvas[layer.window] * layer.passes + layer.light
        return canvas

    def _body_layers(self, state: SceneState) -> list[_Layer]:
        poses = [state.cam_T_grip, state.grip_T_finger] + ([] if state.cam_T_object is None else [state.cam_T_object])
        poses += [pose for _, pose in state.props]
        lamp_cam = disturbance.lamp_direction(self._scenario.fingers, state.time_s)
        poses.append(lamp_cam)
        key = b"".join(pose.tobytes() for pose in poses)
        cached_key, layers = self._cache
        if cached_key == key:
            return layers
        bodies = self._bodies.placed(state)
        faces = [(body, k) for body in bodies for k in np.flatnonzero(body.facing).tolist()]
        masks = self._raster.masks([body.vertices_cam_m[body.solid.loops[k]] for body, k in faces])
        layers = []
        for body in bodies:
            parts = [
                (mask, self._surfaces[body.solid.name][k])
                for (owner, k), mask in zip(faces, masks, strict=True)
                if owner is body and mask is not None
            ]
            if parts:
                layers.append(self._layer(parts, body.cam_T_body, lamp_cam))
        self._cache = (key, layers)
        return layers

    def _layer(self, parts: list[tuple[Coverage, Surface]], cam_T_body: Array, lamp_cam: Array | None) -> _Layer:
        """Sum of a body's faces: inner borders are shared, so the faces' masks add up to the body's.  What is nearer
        than the lamp (None) is lit evenly.
        """
        left, top = min(m.left for m, _ in parts), min(m.top for m, _ in parts)
        right = max(m.left + m.mask.shape[1] for m, _ in parts)
        bottom = max(m.top + m.mask.shape[0] for m, _ in parts)
        passes = np.ones((bottom - top, right - left), np.float32)
        light = np.zeros_like(passes)
        for cover, surface in parts:
            height, width = cover.mask.shape
            u, v = cover.left - left, cover.top - top
            part = slice(v, v + height), slice(u, u + width)
            passes[part] -= cover.mask
            gain = 1.0 if lamp_cam is None else self._painter.relit(surface, lamp_cam)
            if surface.texture is None:
                cv2.scaleAdd(cover.mask, gain * surface.level_dn, light[part], light[part])
            else:
                shade = self._shade(cover, surface, cam_T_body)
                cv2.accumulateProduct(shade if gain == 1.0 else shade * np.float32(gain), cover.mask, light[part])
        return _Layer((slice(top, bottom), slice(left, right)), passes, light)

    def _shade(self, cover: Coverage, surface: Surface, cam_T_body: Array) -> NDArray[np.float32]:
        """A face's texture as it appears in the mask's window."""
        assert surface.texture is not None
        height, width = cover.mask.shape
        cells, inner = self.rays.window(cover.left, cover.top, width, height)
        maps = self.rays.plane_coordinates(cam_T_body @ surface.body_T_plane, surface.px_per_m, cells)
        large = [enlarge_cells(m)[inner] for m in maps]
        shade = cv2.remap(surface.texture, large[0], large[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shade, dtype=np.float32)


_LARGEST_TEXTURE_PX = 1200
_SKIN_LEVEL_DN = 150.0
_SHEET_LEVEL_DN = 205.0
_MOST_COMPRESSED = 12.0


@dataclass(frozen=True)
class Surface:
    """A face's brightness with the first lamp, texture (DN; None: uniform), and its plane's frame in the body's."""

    level_dn: float
    texture: NDArray[np.float32] | None
    px_per_m: float
    body_T_plane: Array
    normal_cam: Array | None = None
    """Outwards (3,), at the nominal pose; None: lit the same wherever the lamp is."""


class Painter:
    """Makes the surfaces of bodies: shades from the lamp's direction at the nominal pose, textures from one seed."""

    def __init__(self, rng: np.random.Generator, look: FingerLook, cam_T_grip: Array, focal_px: float) -> None:
        self._rng, self._look, self._cam_T_grip, self._focal_px = rng, look, cam_T_grip, focal_px
        self._px_per_m = focal_px / float(cam_T_grip[2, 3])
        if look.lamp_changes and not look.ambient > 0.0:
            raise ValueError("fingers.lamp_changes: a lamp alone leaves faces black for good; ambient above 0")
        self._lamp_cam = disturbance.lamp_direction(look, 0.0)

    def metal(self, solid: Solid, gain: float, *, marked: bool = False) -> tuple[Surface, ...]:
        """Surfaces of a metal body, one per face; ``marked``: a finger, with the look's marks."""
        look, surfaces = self._look, []
        own = [mark for mark in look.marks if marked and mark.finger in ("", solid.name)]
        gain *= math.prod(mark.gain for mark in own if mark.shape == "whole")
        for face, bevel in enumerate(solid.bevel):
            level = gain * look.level_dn * self._shade(solid, face) * (look.bevel_gain if bevel else 1.0)
            body_T_plane, rows, columns, px_per_m = self._sheet(solid, face)
            factors = []
            if look.texture > 0.0:
                brushed = textures.metal(self._rng, rows, columns, px_per_m, look.texture)
                factors.append(self._foreshortened(brushed, body_T_plane, px_per_m))
            if look.highlights > 0.0:
                factors.append(textures.streak(self._rng, columns, look.highlights))
            marks = [] if bevel else [mark for mark in own if mark.shape != "whole"]
            if marks:
                grid = textures.grid_m(rows, columns, px_per_m, body_T_plane)
                factors.append(textures.marks(marks, solid, face, grid, px_per_m))
            even = np.full((rows, columns), level, np.float32)
            texture = functools.reduce(np.multiply, factors, even) if factors else None
            surfaces.append(Surface(level, texture, px_per_m, body_T_plane, self._normal_cam(solid, face)))
        return tuple(surfaces)

    def object(self, solid: Solid, look: ObjectLook) -> tuple[Surface, ...]:
        """Surfaces of a box, one per face."""
        surfaces = []
        for face in range(len(solid.loops)):
            level = look.level_dn * self._shade(solid, face)
            body_T_plane, rows, columns, px_per_m = self._sheet(solid, face)
            if look.pattern == "printed":
                texture = textures.printed(self._rng, rows, columns, px_per_m)
            else:
                grid = textures.grid_m(rows, columns, px_per_m, body_T_plane)
                texture = textures.lines(self._rng, look, solid, grid, px_per_m)
            texture = level * self._foreshortened(texture, body_T_plane, px_per_m)
            surfaces.append(Surface(level, texture, px_per_m, body_T_plane, self._normal_cam(solid, face)))
        return tuple(surfaces)

    def copy(self, surfaces: tuple[Surface, ...], mirrored: bool) -> tuple[Surface, ...]:
        """Surfaces of a copy of a body, or of its mirror image across z = 0."""
        mirror = np.diag([1.0, 1.0, -1.0 if mirrored else 1.0, 1.0])
        return tuple(dataclasses.replace(s, body_T_plane=mirror @ s.body_T_plane) for s in surfaces)

    def cover(self, cover: Cover, outline: Array) -> Surface:
        """Skin, or a printed sheet; beyond its texture the border's grey continues."""
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

    def relit(self, surface: Surface, lamp_cam: Array) -> float:
        """A face's brightness with a lamp in a direction (3,), over that with the first lamp."""
        if surface.normal_cam is None or not self._look.lamp_changes:
            return 1.0
        return self._lambert(surface.normal_cam, lamp_cam) / self._lambert(surface.normal_cam, self._lamp_cam)

    def _shade(self, solid: Solid, face: int) -> float:
        return self._lambert(self._normal_cam(solid, face), self._lamp_cam)

    def _normal_cam(self, solid: Solid, face: int) -> Array:
        return np.asarray(self._cam_T_grip[:3, :3] @ solid.normals[face])

    def _lambert(self, normal_cam: Array, lamp_cam: Array) -> float:
        return self._look.ambient + (1.0 - self._look.ambient) * max(float(normal_cam @ lamp_cam), 0.0)

    def _sheet(self, solid: Solid, face: int) -> tuple[Array, int, int, float]:
        """Frame of a face, and rows, columns and pixels per metre of its texture."""
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
    y = np.cross(x, solid.normals[face])  # down, seen from in front of the face with x to the right
    along, across = corners @ x, corners @ y
    body_T_plane = np.eye(4)
    body_T_plane[:3, :3] = np.column_stack([x, y, -solid.normals[face]])
    body_T_plane[:3, 3] = along.min() * x + across.min() * y + solid.offsets_m[face] * solid.normals[face]
    return body_T_plane, np.array([np.ptp(along), np.ptp(across)])
