"""The picture before the sensor: background, fingers, object and covers with exact sub-pixel outlines.

The background and the faces' textures are already as blurred as the lens makes them; the masks of
:mod:`gripmon.simulate.coverage` carry the same blur, so that an outline is at its true place whatever lies beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.simulate.background import TableView
from gripmon.simulate.bodies import Bodies
from gripmon.simulate.coverage import Coverage, CoverageRaster
from gripmon.simulate.scenario import Scenario
from gripmon.simulate.scene import Scene, SceneState
from gripmon.simulate.surfaces import Painter, Surface
from gripmon.simulate.viewing import RayGrid, enlarge_cells

_CARRIER_GAIN = 0.9
_COVER_BLUR_PX = 1.0
_SMEAR_FROM_PX = 0.25
_SMEAR_STEP_PX = 1.0
_MOST_SUB_EXPOSURES = 8


@dataclass(frozen=True)
class _Layer:
    """A body in its window: what remains of the light behind it, and its own light."""

    window: tuple[slice, slice]
    passes: NDArray[np.float32]
    light: NDArray[np.float32]


class Backdrop(Protocol):
    """What is seen behind the gripper: light (height, width) in DN, as blurred as the lens makes it."""

    def render(self, cam_T_grip: Array, t_s: float, exposure_s: float) -> NDArray[Any]: ...


class Renderer:
    """Renders scene states of one scenario; keeps the latest gripper layers, because often nothing moves.

    ``backdrop`` stands in for the scenario's table.
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
        painter = Painter(rng, scenario.fingers, nominal_cam_T_grip, camera.fx_px)
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
        """States within the exposure and their shares: several (Gauss's) only if the gripper moves in the image."""
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
        """Lay all bodies over the background, in place."""
        for layer in self._body_layers(state):
            window = canvas[layer.window]
            cv2.multiply(window, layer.passes, window)
            cv2.add(window, layer.light, window)
        for (index, outline), (_, cam_T_cover) in zip(self._bodies.placed_covers(state), state.covers, strict=True):
            mask = self._cover_raster.masks([outline])[0]
            if mask is not None:
                layer = self._layer([(mask, self._cover_surfaces[index])], cam_T_cover)
                canvas[layer.window] = canvas[layer.window] * layer.passes + layer.light
        return canvas

    def _body_layers(self, state: SceneState) -> list[_Layer]:
        poses = [state.cam_T_grip, state.grip_T_finger] + ([] if state.cam_T_object is None else [state.cam_T_object])
        poses += [pose for _, pose in state.props]
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
                layers.append(self._layer(parts, body.cam_T_body))
        self._cache = (key, layers)
        return layers

    def _layer(self, parts: list[tuple[Coverage, Surface]], cam_T_body: Array) -> _Layer:
        """Sum of a body's faces: they share their inner borders, so their masks add up to that of the body."""
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
            if surface.texture is None:
                cv2.scaleAdd(cover.mask, surface.level_dn, light[part], light[part])
            else:
                cv2.accumulateProduct(self._shade(cover, surface, cam_T_body), cover.mask, light[part])
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
