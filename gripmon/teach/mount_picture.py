"""A sweep of camera mounts as one picture: heat maps over distance and tilt, and what the camera would see.

Drawn with OpenCV and Pillow: plotly, which draws the report's plots, can write a PNG or JPEG only with a browser.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from io import BytesIO
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerLook, JawScript
from gripmon.simulate.solids import finger_solids
from gripmon.teach.mounts import Grid, Trial
from gripmon.teach.visibility import Rig

_WIDTH, _EDGE, _GAP = 1500, 30, 36
_INK, _FAINT, _PAPER, _MARK = (20, 20, 20), (95, 95, 95), (255, 255, 255), (226, 32, 38)
_NOTHING = (206, 206, 206)
_BLANK = 170
_LEFT, _ROW, _BELOW = 50, 46, 46
_CUT = 15
_THUMB = 460
_JPEG_QUALITY = 82
_STILL = Background(kind="plain", motion="still", boxes=0, cables=0)
_FINGERS = FingerLook(carriers=False)  # nothing but what the gripper file describes

Colour = tuple[int, int, int]


class _Map(NamedTuple):
    """A heat map: its title, a value for each trial (NaN for none), whether more is better, and how to write it."""

    title: str
    values: Array
    more_is_better: bool
    logarithmic: bool
    digits: int


class _Slice(NamedTuple):
    """The trials of one lens, side and roll, by tilt and distance; rows from the largest tilt down."""

    trials: list[list[Trial]]
    distances_m: tuple[float, ...]
    tilts_rad: tuple[float, ...]


def draw_sweep(
    rig: Rig, grid: Grid, present: Trial, trials: list[Trial], jaw_opening_m: float | None
) -> Pictures.Image:
    """The picture of a sweep; its heat maps show the lens, side and roll of the best mount."""
    best = min(trials, key=lambda trial: trial.rank)
    shown = _slice_of(grid, trials, best)
    worst = max((trial for row in shown.trials for trial in row), key=lambda trial: trial.rank)
    maps_height = 34 + _ROW * len(shown.tilts_rad) + _BELOW
    thumbs = [
        (_name(best, "best" if best.works else "best, but it would not work"), best, grid.rigs[best.lens]),
        (_name(present, "present") + _other_lens(rig, grid, best), present, rig),
        (_name(worst, "worst of the map"), worst, grid.rigs[worst.lens]),
    ]
    pictures = [_look(r, trial, jaw_opening_m) for _, trial, r in thumbs]
    top = 112
    below = top + maps_height + 14
    height = below + 34 + max(p.height for p in pictures) + 92
    canvas = Pictures.new("RGB", (_WIDTH, height), _PAPER)
    draw = ImageDraw.Draw(canvas)
    _header(draw, rig, grid, best, trials)
    width = (_WIDTH - 2 * _EDGE - 2 * _GAP) // 3
    for k, heat in enumerate(_maps(shown)):
        _draw_map(draw, heat, shown, (best, present), (_EDGE + k * (width + _GAP), top, width))
    for k, ((name, trial, _), picture) in enumerate(zip(thumbs, pictures, strict=True)):
        left = _EDGE + k * (width + _GAP)
        draw.text((left, below), name, _INK, _font(19))
        canvas.paste(picture, (left, below + 30))
        _caption(draw, trial, (left, below + 38 + picture.height), width)
    return canvas


def encoded(picture: Pictures.Image, suffix: str) -> bytes:
    """The picture in the format that a file's ending says, ``.png``, ``.jpg`` or ``.jpeg``."""
    out = BytesIO()
    picture.save(out, "PNG" if suffix.lower() == ".png" else "JPEG", quality=_JPEG_QUALITY)
    return out.getvalue()


def _slice_of(grid: Grid, trials: list[Trial], best: Trial) -> _Slice:
    mount = best.mount
    chosen = {
        (t.mount.tilt_rad, t.mount.distance_m): t
        for t in trials
        if (t.lens, t.mount.side_rad, t.mount.roll_rad) == (best.lens, mount.side_rad, mount.roll_rad)
    }
    tilts = tuple(sorted(grid.tilts_rad, reverse=True))
    return _Slice([[chosen[tilt, d] for d in grid.distances_m] for tilt in tilts], grid.distances_m, tilts)


def _maps(shown: _Slice) -> list[_Map]:
    def of(value: Callable[[Trial], float]) -> Array:
        return np.array([[value(trial) for trial in row] for row in shown.trials], dtype=np.float64)

    noticed = of(lambda t: 1e3 * t.noticed_m if math.isfinite(t.noticed_m) else math.nan)
    shift = of(lambda t: math.nan if t.shift_m is None or math.isinf(t.shift_m) else 1e3 * t.shift_m)
    return [
        _Map("smallest step noticed along every axis (mm)", noticed, False, True, 3),
        _Map("jaw travel with enough in view (%)", of(lambda t: 100.0 * t.share), True, False, 0),
        _Map("the camera may shift sideways by (mm)", shift, True, False, 0),
    ]


def _header(draw: ImageDraw.ImageDraw, rig: Rig, grid: Grid, best: Trial, trials: list[Trial]) -> None:
    camera, mount = grid.rigs[best.lens].camera, best.mount
    draw.text((_EDGE, 18), f"Camera mounts for {rig.gripper.name}", _INK, _font(28))
    view = f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:.0f} px"
    sides = f"side {_degrees(mount.side_rad)}, roll {_degrees(mount.roll_rad)}"
    count = f"{sum(t.works for t in trials)} of {len(trials)} mounts tried would work"
    others = len(grid.rigs) * len(grid.sides_rad) * len(grid.rolls_rad) > 1
    rest = "; maps: the best one's lens, side and roll" if others else ""
    draw.text((_EDGE, 58), f"{view}; {sides}; {count}{rest}.", _FAINT, _font(18))
    key = "Red corner: would not work.  Star: the best.  Ring: the present mount.  Grey: nothing can be measured."
    draw.text((_EDGE, 82), key, _FAINT, _font(16))


def _draw_map(
    draw: ImageDraw.ImageDraw,
    heat: _Map,
    shown: _Slice,
    marked: tuple[Trial, Trial],
    place: tuple[int, int, int],
) -> None:
    """``place``: left, top, width."""
    left, top, width = place
    draw.text((left, top), heat.title, _INK, _font(18))
    x0, y0 = left + _LEFT, top + 34
    columns, rows = len(shown.distances_m), len(shown.tilts_rad)
    cell = (width - _LEFT) / columns
    colours = _colours(heat)
    for i in range(rows):
        y = y0 + i * _ROW
        draw.text((x0 - 8, y + _ROW / 2), f"{math.degrees(shown.tilts_rad[i]):.0f}°", _INK, _font(15), anchor="rm")
        for j in range(columns):
            box = (x0 + j * cell, y, x0 + (j + 1) * cell, y + _ROW)
            _draw_cell(draw, box, colours[i][j], heat, float(heat.values[i, j]), shown.trials[i][j])
    for j, distance_m in enumerate(shown.distances_m):
        x = x0 + (j + 0.5) * cell
        draw.text((x, y0 + rows * _ROW + 5), f"{1e3 * distance_m:.0f}", _INK, _font(15), anchor="ma")
    draw.text((x0 + columns * cell / 2, y0 + rows * _ROW + 25), "distance to the TCP (mm)", _FAINT, _font(15), "ma")
    draw.text((left, y0 + rows * _ROW + 25), "tilt", _FAINT, _font(15), "la")
    best, present = marked
    _star(draw, _position(best, shown, (x0, y0, cell)))
    _ring(draw, _position(present, shown, (x0, y0, cell)))


def _draw_cell(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    colour: Colour,
    heat: _Map,
    value: float,
    trial: Trial,
) -> None:
    draw.rectangle(box, fill=colour, outline=_PAPER)
    light = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    ink = _INK if light > 130 else _PAPER
    if not trial.works:
        draw.polygon([(box[2] - _CUT, box[1]), (box[2], box[1]), (box[2], box[1] + _CUT)], fill=_MARK, outline=_PAPER)
    if math.isfinite(value):
        text = f"{value:.{heat.digits}f}"
        draw.text(((box[0] + box[2]) / 2, box[1] + 0.72 * _ROW), text, ink, _font(14), anchor="mm")


def _colours(heat: _Map) -> list[list[Colour]]:
    """Yellow is good."""
    values = np.log(heat.values) if heat.logarithmic else heat.values
    known = values[np.isfinite(values)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    share = (values - low) / (high - low) if high > low else np.ones_like(values)
    share = share if heat.more_is_better or not high > low else 1.0 - share
    grey = np.nan_to_num(255.0 * share).round().astype(np.uint8)
    bgr = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    return [
        [(int(b[2]), int(b[1]), int(b[0])) if math.isfinite(v) else _NOTHING for b, v in zip(bgr_row, row, strict=True)]
        for bgr_row, row in zip(bgr.reshape(*values.shape, 3), values, strict=True)
    ]


def _position(trial: Trial, shown: _Slice, origin: tuple[float, float, float]) -> tuple[float, float] | None:
    """Where a mount lies in the map, between cells if need be; None beyond the map."""
    x0, y0, cell = origin
    along = _index(np.array(shown.distances_m), trial.mount.distance_m)
    down = _index(np.array(shown.tilts_rad[::-1]), trial.mount.tilt_rad)
    if along is None or down is None:
        return None
    return x0 + (along + 0.5) * cell, y0 + (len(shown.tilts_rad) - 1 - down + 0.5) * _ROW


def _index(ascending: Array, value: float) -> float | None:
    """Position between ascending values, half a step beyond them at most."""
    if len(ascending) == 1:
        return 0.0 if math.isclose(value, ascending[0], rel_tol=1e-6) else None
    where = float(np.interp(value, ascending, np.arange(len(ascending))))
    first, last = ascending[0], ascending[-1]
    slack = 0.25 * min(ascending[1] - first, last - ascending[-2])
    return where if first - slack <= value <= last + slack else None


def _star(draw: ImageDraw.ImageDraw, at: tuple[float, float] | None) -> None:
    if at is None:
        return
    x, y = at[0], at[1] - 8
    points = []
    for k in range(10):
        radius, angle = (10.0, 4.2)[k % 2], -0.5 * math.pi + k * math.pi / 5.0
        points.append((x + radius * math.cos(angle), y + radius * math.sin(angle)))
    draw.polygon(points, fill=_MARK, outline=_PAPER)


def _ring(draw: ImageDraw.ImageDraw, at: tuple[float, float] | None) -> None:
    if at is None:
        return
    x, y = at
    draw.ellipse((x - 9, y - 9, x + 9, y + 9), outline=_PAPER, width=5)
    draw.ellipse((x - 8, y - 8, x + 8, y + 8), outline=_MARK, width=3)


# --- what the camera would see ---


def _look(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Pictures.Image:
    """A simulated image with the corners marked: visible ones green, others red."""
    grey = _simulated(rig, trial, jaw_opening_m) if _is_solid(rig.gripper) else _edges(rig, trial, jaw_opening_m)
    picture = Pictures.fromarray(grey).convert("RGB")
    scale = _THUMB / picture.width
    picture = picture.resize((_THUMB, round(picture.height * scale)), Pictures.Resampling.LANCZOS)
    draw = ImageDraw.Draw(picture)
    for uv, visible in zip(trial.sight.uv_px, trial.sight.visible, strict=True):
        if np.isfinite(uv).all():
            x, y = (uv + 0.5) * scale - 0.5
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), outline=(0, 190, 60) if visible else _MARK, width=2)
    return picture


def _is_solid(gripper: Gripper) -> bool:
    """Whether its file says all faces; one that was inferred from images has edges alone."""
    try:
        finger_solids(gripper)
    except ValueError:
        return False
    return True


def _simulated(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Image:
    has_jaw = rig.gripper.has_jaw
    jaw = JawScript(knots=((0.0, jaw_opening_m),)) if has_jaw and jaw_opening_m is not None else JawScript()
    scenario = Scenario(background=_STILL, fingers=_FINGERS, jaw=jaw)
    image = Simulator(rig.camera, rig.gripper, trial.cam_T_grip, scenario, 1).render(0)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _edges(rig: Rig, trial: Trial, jaw_opening_m: float | None) -> Image:
    """The edges of the model as dark lines."""
    camera, gripper = rig.camera, rig.gripper
    image = np.full((camera.height_px, camera.width_px), _BLANK, dtype=np.uint8)
    points_m = gripper.points_grip_m(jaw_opening_m) @ trial.cam_T_grip[:3, :3].T + trial.cam_T_grip[:3, 3]
    way = np.linspace(0.0, 1.0, 50)[:, None]
    thickness = max(round(camera.width_px / 250), 1)
    for first, last in gripper.edge_points:
        uv = camera.project(points_m[first] + way * (points_m[last] - points_m[first]))
        # What lies far outside of the image overflows OpenCV's integers.
        seen = np.all(np.isfinite(uv) & (np.abs(uv) < 1e5), axis=1)
        whole = np.rint(np.where(seen[:, None], uv, 0.0)).astype(int).tolist()
        for k in np.flatnonzero(seen[:-1] & seen[1:]):
            cv2.line(image, whole[k], whole[k + 1], 40, thickness, cv2.LINE_AA)
    return image


def _name(trial: Trial, what: str) -> str:
    mount = trial.mount
    return f"{what}: {1e3 * mount.distance_m:.0f} mm, tilt {_degrees(mount.tilt_rad)}"


def _other_lens(rig: Rig, grid: Grid, best: Trial) -> str:
    """The focal length of the present lens, if it isn't that of the maps."""
    return "" if grid.rigs[best.lens].camera is rig.camera else f", f = {rig.camera.fx_px:.0f} px"


def _degrees(angle_rad: float) -> str:
    """Without a minus before nought."""
    return f"{round(math.degrees(angle_rad)) + 0}°"


def _caption(draw: ImageDraw.ImageDraw, trial: Trial, at: tuple[int, int], width: int) -> None:
    lines = [
        f"{trial.sight.corners} corners, {trial.sight.edges} edges; {100.0 * trial.share:.0f} % of the jaw's travel"
    ]
    if trial.covariance is not None:
        x, y, z = (1e3 * math.sqrt(v) for v in trial.covariance.diagonal()[:3].tolist())
        noticed = f"steps of {1e3 * trial.noticed_m:.3f} mm" if math.isfinite(trial.noticed_m) else "no steps"
        lines.append(f"TCP to x {x:.3f}, y {y:.3f}, z {z:.3f} mm; notices {noticed}")
    if trial.reasons:
        lines += _wrapped(trial.reasons[0], width)
    for k, line in enumerate(lines[:4]):
        draw.text((at[0], at[1] + 20 * k), line, _FAINT if k < 2 else _MARK, _font(15))


def _wrapped(text: str, width: int) -> list[str]:
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if _font(15).getlength(longer) > width and lines[-1]:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
