"""A laser calibration for a person to look at: spots with their residuals in the image, and the scene from the side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.picture import disc, line, write
from gripmon.laser.pointer.calibrating import LaserResult
from gripmon.laser.pointer.setup import laser_lines, spots_on_plane
from gripmon.model.geometry import invert
from gripmon.model.records import Array, Image

_WIDTH, _HEIGHT, _MARGIN = 800, 640, 50
_PAPER, _INK, _FAINT = (255, 255, 255), (40, 40, 40), (205, 205, 205)
_GOOD, _WRONG, _PLANE, _BEAM = (170, 110, 20), (40, 40, 220), (120, 180, 90), (90, 90, 235)
_SUBPIXEL_BITS = 4


def draw(result: LaserResult, base_T_ee: Array) -> Image:
    """Residuals on the left (arrows many times as long), the scene on the right; BGR."""
    return np.concatenate([_residuals(result), _scene(result, base_T_ee)], axis=1)


def _canvas(title: str) -> NDArray[np.uint8]:
    out = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    write(out, title, (_MARGIN, 30), 0.55)
    return out


def _residuals(result: LaserResult) -> Image:
    refined = result.refined
    used = refined.used
    largest = max(float(np.linalg.norm(refined.residuals_px[used], axis=1).max()), 1e-9)
    camera = refined.camera
    most = 0.06 * camera.width_px / largest
    stretch = max(step * 10.0 ** np.floor(np.log10(most / step)) for step in (1.0, 2.0, 5.0))
    image = _canvas(f"residuals x {stretch:g}: RMS {refined.rms_px:.3f} px, {used.sum()} of {len(used)} spots used")
    scale = min((_WIDTH - 2 * _MARGIN) / camera.width_px, (_HEIGHT - 2 * _MARGIN - 20) / camera.height_px)

    def place(uv: Array) -> Array:
        return np.array([_MARGIN, _MARGIN]) + scale * (uv + 0.5)

    corners = place(np.array([[-0.5, -0.5], [camera.width_px - 0.5, camera.height_px - 0.5]]))
    (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
    cv2.rectangle(image, (left, top), (right, bottom), _FAINT, 1)
    for uv, residual, good in zip(result.uv_px, refined.residuals_px, used, strict=True):
        at = place(uv)
        if good:
            line(image, at, place(uv + stretch * residual), _GOOD)
            disc(image, at, 2.5, _GOOD)
            continue
        for turn in (1.0, -1.0):
            line(image, at - 4.0 * np.array([1.0, turn]), at + 4.0 * np.array([1.0, turn]), _WRONG)
    write(image, f"{camera.width_px} x {camera.height_px} px; crosses: left out", (_MARGIN, _HEIGHT - 14))
    return image


def _scene(result: LaserResult, base_T_ee: Array) -> Image:
    """Base frame, seen from a corner, without perspective."""
    setup = result.refined.setup
    base_T_cam = invert(setup.cam_T_base)
    to_base = base_T_cam[:3, :3]
    spots = spots_on_plane(setup, base_T_ee)[0] @ to_base.T + base_T_cam[:3, 3]
    origins = laser_lines(setup, base_T_ee)[0] @ to_base.T + base_T_cam[:3, 3]
    camera, sheet = base_T_cam[:3, 3], _sheet(result, to_base, base_T_cam[:3, 3])
    everything = np.concatenate([spots, origins, camera[None], sheet, np.zeros((1, 3))])
    view = np.array([[-0.64, 0.77, 0.0], [0.35, 0.29, -0.89]])
    flat = everything @ view.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = float(((np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN - 20) / np.maximum(high - low, 1e-9)).min())

    def place(points: Array) -> Array:
        return (points @ view.T - low) * scale + np.array([_MARGIN, _MARGIN + 10])

    image = _canvas("scene in the base frame: camera, plane, beams")
    fill = np.rint(place(sheet) * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.polylines(image, [fill], True, _PLANE, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
    for spot, origin, good in zip(spots, origins, result.refined.used, strict=True):
        if np.isfinite(spot).all():
            line(image, place(origin), place(spot), _BEAM if good else _FAINT)
            disc(image, place(spot), 2.5, _GOOD if good else _WRONG)
    for name, at, axes in (("base", np.zeros(3), np.eye(3)), ("camera", camera, to_base)):
        for axis, colour in zip(axes.T, ((40, 40, 220), (60, 160, 60), (220, 90, 40)), strict=True):
            line(image, place(at), place(at + 0.08 * float(np.ptp(everything, axis=0).max()) * axis), colour, 2)
        x, y = (round(v) for v in place(at).tolist())
        write(image, name, (x + 6, y - 6))
    return image


def _sheet(result: LaserResult, to_base: Array, centre: Array) -> Array:
    """Corners (4, 3) of the image on the plane, base frame; those that don't reach it are left out."""
    camera, setup = result.refined.camera, result.refined.setup
    width, height = camera.width_px, camera.height_px
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    rays = np.concatenate([(corners - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px], np.ones((4, 1))], 1)
    depth = setup.distance_m / (rays @ setup.normal_cam)
    rays, depth = rays[depth > 0.0], depth[depth > 0.0]
    return (rays * np.minimum(depth, 5.0 * setup.distance_m)[:, None]) @ to_base.T + centre
