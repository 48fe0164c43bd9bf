"""mrcal: ``.cameramodel``, a Python literal; pinhole and OpenCV's lenses.

``extrinsics``, where the camera stands, are written as zeros and not read.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence

from gripmon.calibrate.interchange.fault import (
    InterchangeError,
    brown_conrady,
    numbers_of,
    shown,
    value_at,
    whole_number_of,
)
from gripmon.model.camera import LensSettings

_RIGHT = "a .cameramodel of mrcal: { 'lensmodel': 'LENSMODEL_OPENCV8', 'intrinsics': […], … }"
_COUNTS = {"LENSMODEL_PINHOLE": 0, **{f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}}


def read(data: bytes, file: str) -> LensSettings:
    """The camera in a file's bytes.  :class:`InterchangeError`."""
    try:
        content = ast.literal_eval(data.decode("utf-8-sig").strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        raise InterchangeError(file, "", "is no Python literal", _RIGHT) from None
    if not isinstance(content, dict):
        raise InterchangeError(file, "", f"holds {shown(content)}", _RIGHT)
    key = "lens_model" if "lens_model" in content else "lensmodel"  # before 2020
    model = value_at(file, content, key, " or ".join(_COUNTS))
    if model not in _COUNTS:
        raise InterchangeError(
            file, key, f"{shown(model)} is no model of gripmon's", " or ".join(_COUNTS) + " (mrcal-convert-lensmodel)"
        )
    count = 4 + _COUNTS[model]
    right = f"{count} numbers for {model}: fx, fy, cx, cy and the lens's"
    fx, fy, cx, cy, *lens = numbers_of(
        file, "intrinsics", value_at(file, content, "intrinsics", right), (count,), right
    )
    width, height = numbers_of(
        file, "imagersize", value_at(file, content, "imagersize", "[width, height]"), (2,), "[width, height]"
    )
    size = whole_number_of(file, "imagersize", width), whole_number_of(file, "imagersize", height)
    return brown_conrady(file, size, (fx, fy, cx, cy), tuple(lens))


def write(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """A file's bytes; ``camera`` has a lens that the format has.  Keys in the order that mrcal's own reader wants."""
    coefficients = camera.coefficients  # type: ignore[union-attr]
    pinhole = not any(coefficients) and len(coefficients) == 4
    intrinsics = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *(() if pinhole else coefficients)]
    model = "LENSMODEL_PINHOLE" if pinhole else f"LENSMODEL_OPENCV{len(coefficients)}"
    lines = [
        *(f"# {note}" for note in (*notes, f"camera {name}")),
        "{",
        f"    'lensmodel':  '{model}',",
        "",
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....",
        f"    'intrinsics': [ {', '.join(repr(float(v)) for v in intrinsics)},],",
        "",
        "    # extrinsics are rt_fromref",
        "    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],",
        "",
        f"    'imagersize': [ {camera.width_px}, {camera.height_px},]",
        "}",
    ]
    return ("\n".join(lines) + "\n").encode()
