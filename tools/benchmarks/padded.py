"""Tapered fingers with rubber pads, as many real ones are: what is shown, and the file that its user would write.

Each finger is 60 mm long, 6 mm wide and 12 mm thick at the tip, 14 mm and 16 mm at the root, its edges chamfered by
0.1 mm; a black pad of 2 x 10 x 24 mm on its inner side is flush with the tip.  Frame: the TCP amid the pads' tips.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import BrownConradyLens
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.simulate.scenario import FingerMark

LENS = BrownConradyLens(
    width_px=1280,
    height_px=720,
    fx_px=905.3,
    fy_px=905.3,
    cx_px=643.2,
    cy_px=355.7,
    coefficients=(-0.115, 0.062, 4e-4, -3e-4),
)
"""A colour camera's usual lens: 10 px/mm at 90 mm."""

NOMINAL_M, LENGTH_M, PAD_M, CHAMFER_M = 0.040, 0.060, (0.002, 0.010, 0.024), 1e-4
_WIDTHS_M, _THICK_M = (0.006, 0.014), (0.012, 0.016)
_JAW = {"nominal_m": NOMINAL_M, "min_m": 0.0, "max_m": 0.06}
_BLACK = 0.12

_SIDES = {"left": -1.0, "right": 1.0}
PADS = tuple(FingerMark(shape="whole", gain=_BLACK, finger=f"{side} pad") for side in _SIDES)
"""What makes the pads black."""

# Corners of a body by bits: 1 the finger's outer side, 2 the side away from the camera, 4 the tip.
_OUT, _FAR, _TIP = 1, 2, 4
_LOOPS = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
"""Faces of the right finger, counter-clockwise seen from outside."""


@cache
def padded_solids() -> Gripper:
    """For the simulator: a finger and its pad are two bodies that move alike."""
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    faces: list[dict[str, Any]] = []
    for side, sign in _SIDES.items():
        for part, corners in ((side, _body_m(sign)), (f"{side} pad", _pad_m(sign))):
            names = [f"{part} {k}" for k in range(8)]
            for name, xyz in zip(names, corners, strict=True):
                points[name] = {"finger": part, "xyz_m": xyz.tolist(), "corner": bool(xyz[2] == 0.0)}
            for a, b in ((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit):
                edges[f"{names[a]}-{b}"] = {"from": names[a], "to": names[b], "bevel_m": CHAMFER_M}
            faces += [{"finger": part, "points": [names[k] for k in loop]} for loop in _loops(sign)]
    fingers = {part: _motion(sign) for side, sign in _SIDES.items() for part in (side, f"{side} pad")}
    value = {"name": "padded_solids", "jaw": _JAW, "fingers": fingers, "points": points, "edges": edges, "faces": faces}
    return Gripper(msgspec.convert(value, GripperModel))


@cache
def padded_model() -> Gripper:
    """For the monitor: of each finger what the camera sees of its outline, and where metal meets the pad."""
    points: dict[str, Any] = {}
    edges: dict[str, Any] = {}
    for side, sign in _SIDES.items():
        body, pad = _body_m(sign), _pad_m(sign)
        beside_pad = PAD_M[2] / LENGTH_M
        at_pad_near, at_pad_far = (body[_TIP | far] + beside_pad * (body[far] - body[_TIP | far]) for far in (0, _FAR))
        for name, xyz_m, corner in (
            ("out_back", body[_OUT], False),
            ("out", body[_OUT | _TIP], True),
            ("in", body[_TIP], True),
            ("in_at_pad", at_pad_near, False),
            ("far_at_pad", at_pad_far, False),
            ("far_back", body[_FAR], False),
            ("pad_out", pad[_OUT | _TIP], False),
            ("pad_near", pad[_TIP], True),
            ("pad_far", pad[_FAR | _TIP], True),
            ("pad_far_back", pad[_FAR], False),
        ):
            points[f"{side}_{name}"] = {"finger": side, "xyz_m": xyz_m.tolist(), "corner": corner}
        for start, end in (
            ("out_back", "out"),
            ("out", "in"),
            ("in", "in_at_pad"),
            ("far_at_pad", "far_back"),
            ("pad_out", "pad_near"),
            ("pad_near", "pad_far"),
            ("pad_far", "pad_far_back"),
        ):
            ends = {"from": f"{side}_{start}", "to": f"{side}_{end}", "bevel_m": CHAMFER_M}
            edges[f"{side}_{start}-{end}"] = ends
    fingers = {side: _motion(sign) for side, sign in _SIDES.items()}
    value = {"name": "padded_fingers", "jaw": _JAW, "fingers": fingers, "points": points, "edges": edges}
    return Gripper(msgspec.convert(value, GripperModel))


def _body_m(sign: float) -> NDArray[np.float64]:
    """Corners (8, 3) of a finger without its pad."""
    inner_m = 0.5 * NOMINAL_M + PAD_M[0]
    return np.array([_corner_m(k, sign, inner_m, _WIDTHS_M, _THICK_M, LENGTH_M) for k in range(8)])


def _pad_m(sign: float) -> NDArray[np.float64]:
    width_m, thick_m, long_m = PAD_M
    return np.array([_corner_m(k, sign, 0.5 * NOMINAL_M, (width_m,) * 2, (thick_m,) * 2, long_m) for k in range(8)])


def _corner_m(
    bits: int, sign: float, inner_m: float, widths_m: tuple[float, ...], thick_m: tuple[float, ...], long_m: float
) -> list[float]:
    """A body's corner; widths and thicknesses at the tip and at its other end."""
    end = 0 if bits & _TIP else 1
    x_m = inner_m + (widths_m[end] if bits & _OUT else 0.0)
    return [sign * x_m, (0.5 if bits & _FAR else -0.5) * thick_m[end], -long_m if end else 0.0]


def _loops(sign: float) -> list[tuple[int, ...]]:
    return [loop if sign > 0.0 else loop[::-1] for loop in _LOOPS]


def _motion(sign: float) -> dict[str, Any]:
    return {"motion": {"axis": [0.5 * sign, 0.0, 0.0]}}
