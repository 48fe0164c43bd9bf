"""A sweep of camera mounts as one picture: heat maps over distance and tilt, and what the camera would see.

Drawn with OpenCV and Pillow: plotly, which draws the report's plots, can write a PNG or JPEG only with a browser.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from io import BytesIO
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont

from gripmon.model.pixels import BLUE, GREEN, RED
from gripmon.model.records import Array, Image
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerLook, JawScript
from gripmon.simulate.solids import finger_solids
from gripmon.teach.mounts import Grid, Trial
from gripmon.teach.visibility import Rig

_WIDTH, _EDGE, _GAP, _TOP = 1500, 30, 36, 112  # px: the picture, its margin, between columns, above the maps
_COLUMN = (_WIDTH - 2 * _EDGE - 2 * _GAP) // 3
_LABELS, _ROW, _BELOW = 50, 46, 46  # px, of a map: left of it, a row, below it
_INK, _FAINT, _PAPER, _MARK, _NOTHING = (20, 20, 20), (95, 95, 95), (255, 255, 255), (226, 32, 38), (206, 206, 206)


class _Map(NamedTuple):
    """A heat map: ``values`` for each trial (r, c), NaN for none, ``digits`` to write them with, and ``goodness``,
    which is coloured: more is better.
    """

    title: str
    values: Array
    digits: int
    goodness: Array


def draw_sweep(
    rig: Rig, grid: Grid, present: Trial, trials: Sequence[Trial], jaw_opening_m: float | None
) -> Pictures.Image:
    """The picture of a sweep; its heat maps show the lens, side and roll of the best mount."""
    best = min(trials, key=lambda trial: trial.rank)
    shown = {
        (t.mount.tilt_rad, t.mount.distance_m): t
        for t in trials
        if (t.lens, t.mount.side_rad, t.mount.roll_rad) == (best.lens, best.mount.side_rad, best.mount.roll_rad)
    }
    rows = [[shown[tilt, d] for d in grid.distances_m] for tilt in sorted(grid.tilts_rad, reverse=True)]
    worst = max(shown.values(), key=lambda trial: trial.rank)
    best_rig = grid.rigs[best.lens]
    other_lens = "" if best_rig.camera is rig.camera else f", f = {rig.camera.fx_px:.0f} px"
    thumbs = [
        ("best" if best.works else "best, but it would not work", best, best_rig, ""),
        ("present", present, rig, other_lens),
        ("worst of the map", worst, best_rig, ""),
    ]
    pictures = [_seen(seeing, trial, jaw_opening_m) for _, trial, seeing, _ in thumbs]
    below = _TOP + 34 + _ROW * len(rows) + _BELOW + 14
    canvas = Pictures.new("RGB", (_WIDTH, below + 34 + max(p.height for p in pictures) + 92), _PAPER)
    draw = ImageDraw.Draw(canvas)
    _header(draw, rig, grid, best, trials)
    columns = [_EDGE + k * (_COLUMN + _GAP) for k in range(3)]
    for left, heat in zip(columns, _maps(rows), strict=True):
        _draw_map(draw, heat, rows, left)
        _mark(draw, best, rows, left, star=True)
        _mark(draw, present, rows, left, star=False)
    for left, (what, trial, _, lens), picture in zip(columns, thumbs, pictures, strict=True):
        name = f"{what}: {1e3 * trial.mount.distance_m:.0f} mm, tilt {_degrees(trial.mount.tilt_rad)}{lens}"
        draw.text((left, below), name, _INK, _font(19))
        canvas.paste(picture, (left, below + 30))
        for k, (line, ink) in enumerate(_caption(trial)):
            draw.text((left, below + 38 + picture.height + 20 * k), line, ink, _font(15))
    return canvas


def encoded(picture: Pictures.Image, suffix: str) -> bytes:
    """The picture in the format given by a file's ending, ``.png``, ``.jpg`` or ``.jpeg``."""
    out = BytesIO()
    picture.save(out, "PNG" if suffix.lower() == ".png" else "JPEG", quality=82)
    return out.getvalue()


def _header(draw: ImageDraw.ImageDraw, rig: Rig, grid: Grid, best: Trial, trials: Sequence[Trial]) -> None:
    camera, mount = grid.rigs[best.lens].camera, best.mount
    view = f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:.0f} px"
    sides = f"side {_degrees(mount.side_rad)}, roll {_degrees(mount.roll_rad)}"
    count = f"{sum(t.works for t in trials)} of {len(trials)} mounts tried would work"
    others = len(grid.rigs) * len(grid.sides_rad) * len(grid.rolls_rad) > 1
    rest = "; maps: the best one's lens, side and roll" if others else ""
    key = "Red corner: would not work.  Star: the best.  Ring: the present mount.  Grey: nothing can be measured."
    draw.text((_EDGE, 18), f"Camera mounts for {rig.gripper.name}", _INK, _font(28))
    draw.text((_EDGE, 58), f"{view}; {sides}; {count}{rest}.", _FAINT, _font(18))
    draw.text((_EDGE, 82), key, _FAINT, _font(16))


def _maps(rows: list[list[Trial]]) -> list[_Map]:
    noticed = np.array([[1e3 * t.noticed_m for t in row] for row in rows])
    noticed[np.isinf(noticed)] = np.nan
    travel = np.array([[100.0 * t.share for t in row] for row in rows])
    shift = np.array([[1e3 * t.measurable.shift_m if t.measurable else np.nan for t in row] for row in rows])
    shift[np.isinf(shift)] = np.nan
    return [
        _Map("smallest step noticed along every axis (mm)", noticed, 3, -np.log(noticed)),
        _Map("jaw travel with enough in view (%)", travel, 0, travel),
        _Map("the camera may shift sideways by (mm)", shift, 0, shift),
    ]


def _draw_map(draw: ImageDraw.ImageDraw, heat: _Map, rows: list[list[Trial]], left: int) -> None:
    x0, y0, cell = _geometry(rows, left)
    draw.text((left, _TOP), heat.title, _INK, _font(18))
    known = heat.goodness[np.isfinite(heat.goodness)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    share = (heat.goodness - low) / (high - low) if high > low else np.ones_like(heat.goodness)
    bgr = cv2.applyColorMap(np.nan_to_num(255.0 * share).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    for i, row in enumerate(rows):
        y = y0 + i * _ROW
        draw.text((x0 - 8, y + _ROW / 2), f"{math.degrees(row[0].mount.tilt_rad):.0f}°", _INK, _font(15), anchor="rm")
        for j, trial in enumerate(row):
            x, right, value = x0 + j * cell, x0 + (j + 1) * cell, float(heat.values[i, j])
            blue, green, red = bgr[i, j].tolist() if math.isfinite(value) else _NOTHING
            draw.rectangle((x, y, right, y + _ROW), fill=(red, green, blue), outline=_PAPER)
            if not trial.works:
                draw.polygon([(right - 15, y), (right, y), (right, y + 15)], fill=_MARK, outline=_PAPER)
            if math.isfinite(value):
                ink = _INK if RED * red + GREEN * green + BLUE * blue > 130 else _PAPER
                place = ((x + right) / 2, y + 0.72 * _ROW)
                draw.text(place, f"{value:.{heat.digits}f}", ink, _font(14), anchor="mm")
    bottom = y0 + len(rows) * _ROW
    for j, trial in enumerate(rows[0]):
        draw.text((x0 + (j + 0.5) * cell, bottom + 5), f"{1e3 * trial.mount.distance_m:.0f}", _INK, _font(15), "ma")
    draw.text((x0 + len(rows[0]) * cell / 2, bottom + 25), "distance to the TCP (mm)", _FAINT, _font(15), "ma")
    draw.text((left, bottom + 25), "tilt", _FAINT, _font(15), "la")


def _geometry(rows: list[list[Trial]], left: int) -> tuple[int, int, float]:
    """Left and upper end of a map's cells, and their width, px."""
    return left + _LABELS, _TOP + 34, (_COLUMN - _LABELS) / len(rows[0])


def _mark(draw: ImageDraw.ImageDraw, trial: Trial, rows: list[list[Trial]], left: int, star: bool) -> None:
    """Draw a star or a ring where a mount lies in the map, also between cells; nothing outside of the map."""
    along = _index(np.array([t.mount.distance_m for t in rows[0]]), trial.mount.distance_m)
    up = _index(np.array([row[0].mount.tilt_rad for row in rows[::-1]]), trial.mount.tilt_rad)
    if along is None or up is None:
        return
    x0, y0, cell = _geometry(rows, left)
    x, y = x0 + (along + 0.5) * cell, y0 + (len(rows) - 0.5 - up) * _ROW
    if star:
        radius, angle = np.tile([10.0, 4.2], 5), np.arange(10) * math.pi / 5.0
        points = np.column_stack([x + radius * np.sin(angle), y - 8 - radius * np.cos(angle)])
        draw.polygon(points.ravel().tolist(), fill=_MARK, outline=_PAPER)
    else:
        draw.circle((x, y), 9, outline=_PAPER, width=5)
        draw.circle((x, y), 8, outline=_MARK, width=3)


def _index(ascending: Array, value: float) -> float | None:
    """Position among ascending values, interpolated; None beyond them by more than a quarter of a step."""
    if len(ascending) == 1:
        return 0.0 if math.isclose(value, ascending[0], rel_tol=1e-6) else None
    slack = 0.25 * min(ascending[1] - ascending[0], ascending[-1] - ascending[-2])
    if not ascending[0] - slack <= value <= ascending[-1] + slack:
        return None
    return float(np.interp(value, ascending, np.arange(len(ascending))))


def _seen(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Pictures.Image:
    """A simulated image with the corners marked: visible ones green, others red."""
    try:
        finger_solids(rig.gripper)
    except ValueError:  # a gripper inferred from images has only edges
        grey = _edges(rig, trial, jaw_opening_m)
    else:
        grey = _simulated(rig, trial, jaw_opening_m)
    picture = Pictures.fromarray(grey).convert("RGB")
    scale = _COLUMN / picture.width
    picture = picture.resize((_COLUMN, round(picture.height * scale)), Pictures.Resampling.LANCZOS)
    draw = ImageDraw.Draw(picture)
    for uv, visible in zip(trial.sight.uv_px, trial.sight.visible, strict=True):
        if np.isfinite(uv).all():
            x, y = (uv + 0.5) * scale - 0.5
            draw.circle((x, y), 5, outline=(0, 190, 60) if visible else _MARK, width=2)
    return picture


def _simulated(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Image:
    has_jaw = rig.gripper.has_jaw
    scenario = Scenario(
        background=Background(kind="plain", motion="still", boxes=0, cables=0),
        fingers=FingerLook(carriers=False),  # nothing but what the gripper file describes
        jaw=JawScript(knots=((0.0, jaw_opening_m),)) if has_jaw and jaw_opening_m is not None else JawScript(),
    )
    image = Simulator(rig.camera, rig.gripper, trial.cam_T_grip, scenario, 1).render(0)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _edges(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Image:
    """The edges of the model as dark lines."""
    camera, gripper = rig.camera, rig.gripper
    image = np.full((camera.height_px, camera.width_px), 170, dtype=np.uint8)
    points_m = gripper.points_grip_m(jaw_opening_m) @ trial.cam_T_grip[:3, :3].T + trial.cam_T_grip[:3, 3]
    thickness = max(round(camera.width_px / 250), 1)
    for outline_m in gripper.outlines_m(points_m, np.arange(len(gripper.edge_ids)), 50, trial.cam_T_grip[:3, :3]):
        uv = camera.project(outline_m)
        # Points far outside of the image overflow OpenCV's integers.
        seen = np.all(np.isfinite(uv) & (np.abs(uv) < 1e5), axis=1)
        whole = np.rint(np.where(seen[:, None], uv, 0.0)).astype(int).tolist()
        for k in np.flatnonzero(seen[:-1] & seen[1:]):
            cv2.line(image, whole[k], whole[k + 1], 40, thickness, cv2.LINE_AA)
    return image


def _caption(trial: Trial) -> list[tuple[str, tuple[int, int, int]]]:
    """At most four lines, with their colours."""
    sight, travel = trial.sight, f"{100.0 * trial.share:.0f} % of the jaw's travel"
    lines = [(f"{sight.corners} corners, {sight.edges} edges; {travel}", _FAINT)]
    if trial.measurable is not None:
        x, y, z = (1e3 * trial.measurable.frame.sigma[:3]).tolist()
        noticed = f"steps of {1e3 * trial.noticed_m:.3f} mm" if math.isfinite(trial.noticed_m) else "no steps"
        lines.append((f"TCP to x {x:.3f}, y {y:.3f}, z {z:.3f} mm; notices {noticed}", _FAINT))
    reason = trial.faults[0].text if trial.faults else ""
    return [*lines, *((line, _MARK) for line in textwrap.wrap(reason, 62))][:4]


def _degrees(angle_rad: float) -> str:
    """In whole degrees, without a minus sign before zero."""
    return f"{round(math.degrees(angle_rad)) + 0}°"


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
