"""ROS: the YAML of ``camera_calibration_parsers``, which ``camera_info_manager`` and ``cameracalibrator`` use.

``rectification_matrix`` and ``projection_matrix`` say how ROS rectifies; they are written for a camera that stands
alone and not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gripmon.calibrate.interchange.fault import (
    InterchangeError,
    brown_conrady,
    fisheye,
    focal_and_centre,
    list_text,
    mapping_at,
    numbers_of,
    read_mapping,
    shown,
    value_at,
    whole_number_of,
)
from gripmon.model.camera import LensSettings

_RIGHT = "a camera_info file of ROS: image_width, camera_matrix, distortion_model, …"
_MODELS = "plumb_bob, rational_polynomial or equidistant"
# OpenCV, which ROS hands them to, tells its models by the count alone; REP 104 gives plumb_bob 5 and the other 8.
_COUNTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 4, 5, 8, 12, 14), "equidistant": (4,), "fisheye": (4,)}


def read(data: bytes, file: str) -> LensSettings:
    """The camera in a file's bytes.  :class:`InterchangeError`."""
    content = read_mapping(file, data, _RIGHT)
    size = tuple(whole_number_of(file, k, value_at(file, content, k, _RIGHT)) for k in ("image_width", "image_height"))
    matrix = numbers_of(file, "camera_matrix", _data(file, content, "camera_matrix"), (9,), "3 x 3 numbers")
    if not any(matrix):
        raise InterchangeError(file, "camera_matrix", "is all zeros: an uncalibrated camera", "a calibrated one")
    pinhole = focal_and_centre(file, "camera_matrix", matrix)
    # Older files have no model; the only one that there was then is meant.
    model = content.get("distortion_model", content.get("camera_model", "plumb_bob"))
    if model not in _COUNTS:
        raise InterchangeError(file, "distortion_model", f"{shown(model)} is no model of gripmon's", _MODELS)
    key = "distortion_coefficients"
    right = f"of {model} {' or '.join(str(n) for n in _COUNTS[model] if n)} values"
    coefficients = numbers_of(file, key, _data(file, content, key), _COUNTS[model], right)
    build = fisheye if model in ("equidistant", "fisheye") else brown_conrady
    return build(file, (size[0], size[1]), pinhole, coefficients)


def _data(file: str, content: dict[str, Any], key: str) -> Any:
    matrix = mapping_at(file, content, key, "rows, cols and data")
    return value_at(file, {f"{key}.{k}": v for k, v in matrix.items()}, f"{key}.data", "a flat list of numbers")


def write(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """A file's bytes; ``camera`` has a lens that the format has."""
    coefficients = list(camera.coefficients)  # type: ignore[union-attr]
    if camera.__struct_config__.tag == "fisheye":
        model = "equidistant"
    elif len(coefficients) <= 5:
        model = "plumb_bob"
        coefficients += [0.0] * (5 - len(coefficients))
    else:
        model = "rational_polynomial"
    fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
    lines = [
        *(f"# {note}" for note in notes),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        f"camera_name: {name}",
        *_matrix("camera_matrix", 3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", 1, len(coefficients), coefficients),
        *_matrix("rectification_matrix", 3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        *_matrix("projection_matrix", 3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    ]
    return ("\n".join(lines) + "\n").encode()


def _matrix(key: str, rows: int, columns: int, data: list[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {list_text(data)}"]
