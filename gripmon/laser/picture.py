"""A laser calibration as a picture: residuals on the left (as enlarged arrows), the scene on the right."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gripmon.laser.calibrating import LaserResult
from gripmon.laser.setup import beams, spots_on_plane, spots_on_rays
from gripmon.model.canvas import Canvas, Colour
from gripmon.model.records import Array, Image

_WIDTH, _HEIGHT, _MARGIN = 800, 640, 50
_INK, _FAINT, _GOOD, _WRONG = (40, 40, 40), (205, 205, 205), (170, 110, 20), (40, 40, 220)
_PLANE, _BEAM, _AXES = (120, 180, 90), (90, 90, 235), ((40, 40, 220), (60, 160, 60), (220, 90, 40))
_FROM_A_CORNER = np.array([[-0.64, 0.77, 0.0], [0.35, 0.29, -0.89]])


class _Panel:
    """A white panel; points are placed in the square that ``corners`` (n, 2) span."""

    def __init__(self, title: str, corners: Array):
        self._canvas = Canvas(np.full((_HEIGHT, _WIDTH), 255, np.uint8), 1.0)
        self.image = self._canvas.picture
        self._low = corners.min(axis=0)
        size = np.maximum(corners.max(axis=0) - self._low, 1e-9)
        self.scale = float(((np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN - 20) / size).min())
        self._put(title, (_MARGIN, 30))

    def _at(self, points: Array) -> Array:
        return (points - self._low) * self.scale + [_MARGIN, _MARGIN + 10]

    def lines(self, points: Sequence[Array], colour: Colour, *, closed: bool = False) -> None:
        """A line each through points (k, 2)."""
        for line in points:
            self._canvas.line(self._at(np.concatenate([line, line[:1]]) if closed else line), colour)

    def discs(self, points: Array, colour: Colour) -> None:
        self._canvas.circle(self._at(points), 3.0, colour, -1)

    def text(self, text: str, point: Array) -> None:
        x, y = self._canvas.pixel(self._at(point))
        self._put(text, (x + 6, y - 6))

    def _put(self, text: str, at: tuple[int, int]) -> None:
        cv2.putText(self.image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)


def draw(result: LaserResult, base_T_ee: Array) -> Image:
    """Residuals and scene (640, 1600, 3), BGR."""
    return np.concatenate([_residuals(result), _scene(result, base_T_ee)], axis=1)


def _residuals(result: LaserResult) -> Image:
    refined, used = result.refined, result.refined.used
    width, height = refined.camera.width_px, refined.camera.height_px
    most = 0.06 * width / max(float(np.linalg.norm(refined.residuals_px[used], axis=1).max()), 1e-9)
    stretch = max(step * 10.0 ** np.floor(np.log10(most / step)) for step in (1.0, 2.0, 5.0))
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    title = f"residuals x {stretch:g}: RMS {refined.rms_px:.3f} px, {used.sum()} of {len(used)} spots used (blue)"
    panel = _Panel(title, corners)
    panel.lines([corners], _FAINT, closed=True)
    ends = result.uv_px + stretch * refined.residuals_px
    panel.lines(list(np.stack([result.uv_px, ends], axis=1)[used]), _GOOD)
    panel.discs(result.uv_px[used], _GOOD)
    panel.discs(result.uv_px[~used], _WRONG)
    return panel.image


def _scene(result: LaserResult, base_T_ee: Array) -> Image:
    """The base frame from a corner, in parallel projection."""
    setup, camera, used = result.refined.setup, result.refined.camera, result.refined.used
    spots, origins = spots_on_plane(setup, base_T_ee), beams(setup, base_T_ee)[0]
    seen = np.isfinite(spots).all(axis=1)
    pinhole = (np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * [camera.width_px, camera.height_px]
               - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]  # fmt: skip
    sheet = spots_on_rays(setup, pinhole)
    sheet = sheet[np.isfinite(sheet).all(axis=1)]
    frames = [("base", np.eye(4)), ("camera", setup.base_T_cam)]
    everything = np.concatenate([spots[seen], origins, sheet, *(frame[None, :3, 3] for _, frame in frames)])
    panel = _Panel("scene in the base frame: camera, plane, beams", everything @ _FROM_A_CORNER.T)
    panel.lines([sheet @ _FROM_A_CORNER.T], _PLANE, closed=True)
    for part, beam, spot in ((seen & used, _BEAM, _GOOD), (seen & ~used, _FAINT, _WRONG)):
        panel.lines(list(np.stack([origins, spots], axis=1)[part] @ _FROM_A_CORNER.T), beam)
        panel.discs(spots[part] @ _FROM_A_CORNER.T, spot)
    length = 0.08 * float(np.ptp(everything, axis=0).max())
    for name, frame in frames:
        for axis, colour in zip(frame[:3, :3].T, _AXES, strict=True):
            panel.lines([np.stack([frame[:3, 3], frame[:3, 3] + length * axis]) @ _FROM_A_CORNER.T], colour)
        panel.text(name, frame[:3, 3] @ _FROM_A_CORNER.T)
    return panel.image
