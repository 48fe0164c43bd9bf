"""Camera files of ROS, Kalibr and mrcal, read and written; and YAML as their readers accept it.

A wrong value raises an :class:`InterchangeError`; cameras to write must have a lens that the format supports.
"""

from __future__ import annotations

import ast
import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, make_camera
from gripmon.model.errors import InputError
from gripmon.model.yaml_text import YamlFault, parse_yaml

Pinhole = tuple[float, float, float, float]
"""Focal lengths and principal point: fx, fy, cx, cy (px)."""


class InterchangeError(InputError):
    """``str()`` is one line ``file: key: what is wrong; what would be right``."""

    def __init__(self, file: str, key: str, wrong: str, right: str = ""):
        parts = [file, key, f"{wrong}; {right}" if right else wrong]
        super().__init__(" ".join(": ".join(part for part in parts if part).split()))


@dataclass(frozen=True, slots=True)
class FileValues:
    """The ``content`` of a file, or of a section of it; ``right`` says what should be there."""

    file: str
    content: Mapping[str, Any]
    right: str
    path: str = ""

    def fault(self, key: str, wrong: str, right: str = "") -> InterchangeError:
        return InterchangeError(self.file, self.path + key, wrong, right or self.right)

    def value(self, key: str, right: str = "") -> Any:
        if key not in self.content:
            raise self.fault(key, "is missing", right)
        return self.content[key]

    def below(self, key: str, right: str = "") -> FileValues:
        """The section under a key."""
        value = self.value(key, right)
        if not isinstance(value, Mapping):
            raise self.fault(key, f"is {_shown(value)}", right)
        return FileValues(self.file, value, right or self.right, f"{self.path}{key}.")

    def number(self, key: str, value: Any) -> float:
        number = as_number(value)
        if number is None:
            raise self.fault(key, f"{_shown(value)} is not a number", "an ordinary number")
        return number

    def pixels(self, key: str, value: Any) -> int:
        number = self.number(key, value)
        if number != int(number):
            raise self.fault(key, f"{_shown(value)} is not a whole number", "a number of pixels")
        return int(number)

    def numbers(self, key: str, counts: tuple[int, ...], right: str) -> tuple[float, ...]:
        """A flat list whose length is one of ``counts``."""
        value = self.value(key, right)
        if not isinstance(value, list | tuple):
            raise self.fault(key, f"is {_shown(value)}", right)
        if len(value) not in counts:
            raise self.fault(key, f"holds {len(value)} values", right)
        return tuple(self.number(f"{key}[{i}]", v) for i, v in enumerate(value))

    def pair(self, key: str, right: str) -> tuple[int, int]:
        """Width and height."""
        width, height = self.numbers(key, (2,), right)
        return self.pixels(key, width), self.pixels(key, height)

    def choice(self, key: str, value: Any, names: Mapping[str, Any], right: str) -> Any:
        """The meaning of one of several names."""
        if value not in names:
            raise self.fault(key, f"{_shown(value)} is not a model of gripmon's", right)
        return names[value]

    def pinhole(self, key: str) -> Pinhole:
        """From a camera matrix, 9 numbers row by row."""
        matrix = self.numbers(key, (9,), "3 x 3 numbers")
        if not any(matrix):
            raise self.fault(key, "is all zeros: an uncalibrated camera", "a calibrated one")
        fx, skew, cx, below, fy, cy, *last = matrix
        if skew or below or last != [0.0, 0.0, 1.0]:
            raise self.fault(key, f"{_shown(list(matrix))} has a skew or is none", "[fx, 0, cx, 0, fy, cy, 0, 0, 1]")
        return fx, fy, cx, cy

    def camera(
        self, size_px: tuple[int, int], pinhole: Pinhole, coefficients: tuple[float, ...], *, fisheye: bool
    ) -> LensSettings:
        """OpenCV's standard lens or its fisheye, if a monitor can use it; 14 coefficients are accepted if the sensor
        isn't tilted, and none means no distortion.
        """
        if len(coefficients) == 14:
            if any(coefficients[12:]):
                wrong = f"the lens has a tilted sensor (tau {coefficients[12:]}), which gripmon has no model of"
                raise InterchangeError(self.file, "", wrong, "4, 5, 8 or 12 coefficients")
            coefficients = coefficients[:12]
        camera = (FisheyeLens if fisheye else BrownConradyLens)(
            width_px=size_px[0], height_px=size_px[1],
            **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), pinhole, strict=True)),
            coefficients=coefficients or (0.0, 0.0, 0.0, 0.0),
        )  # fmt: skip
        try:
            make_camera(camera)
        except ValueError as error:
            raise InterchangeError(self.file, "", f"no camera that can be used: {error}") from None
        return camera


def as_number(value: Any) -> float | None:
    """A finite number, or text that reads as one, because YAML 1.1 takes ``1e-05`` for text; None for anything else."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    with contextlib.suppress(OverflowError):  # an integer beyond the range of floats
        return float(value) if math.isfinite(value) else None
    return None


def _shown(value: Any) -> str:
    """A value for a message, shortened if it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def number_text(value: float) -> str:
    """The shortest text that reads back as the same number, also in YAML 1.1: ``1.0e-05``."""
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}" if e else text


def _list_text(values: Sequence[float]) -> str:
    return "[" + ", ".join(map(number_text, values)) + "]"


def read_mapping(file: str, data: bytes, right: str) -> dict[str, Any]:
    """The mapping in a file's bytes; ``right`` says what kind of file it should be."""
    try:
        value = parse_yaml(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InterchangeError(file, "", f"is not text (byte {error.start} is not UTF-8)", right) from None
    except YamlFault as fault:
        raise InterchangeError(file, fault.where, fault.wrong, fault.right or right) from None
    if not isinstance(value, dict):
        raise InterchangeError(file, "", "is empty" if value is None else "holds no keys", right)
    return value


_ROS = "a camera_info file of ROS: image_width, camera_matrix, distortion_model, …"
# OpenCV, which ROS passes them to, distinguishes models only by this count; REP 104 gives plumb_bob 5 and the other 8,
# and drivers fill up with zeros.
_ROS_COUNTS = {
    "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 4, 5, 8, 12, 14), "equidistant": (4,), "fisheye": (4,),
}  # fmt: skip


def read_ros(data: bytes, file: str) -> LensSettings:
    """Read the YAML of ``camera_calibration_parsers``, as used by ``camera_info_manager`` and ``cameracalibrator``.
    ``rectification_matrix`` and ``projection_matrix`` define ROS's rectification; they aren't read.
    """
    content = read_mapping(file, data, _ROS)
    values = FileValues(file, content, _ROS)
    width, height = (values.pixels(k, values.value(k)) for k in ("image_width", "image_height"))
    matrices = {
        f"{key}.data": values.below(key, "rows, cols and data").value("data", "a flat list of numbers")
        for key in ("camera_matrix", "distortion_coefficients")
    }
    flat = FileValues(file, {key.removesuffix(".data"): value for key, value in matrices.items()}, _ROS)
    pinhole = flat.pinhole("camera_matrix")
    # Older files name no model; they mean the only one that existed then.
    model = content.get("distortion_model", content.get("camera_model", "plumb_bob"))
    right = "plumb_bob, rational_polynomial or equidistant"
    counts = values.choice("distortion_model", model, _ROS_COUNTS, right)
    right = f"of {model} {' or '.join(str(n) for n in counts if n)} values"
    held = flat.numbers("distortion_coefficients", tuple(range(15)), right)
    coefficients = _without_zeros(held, counts)
    if model == "plumb_bob" and len(coefficients) not in counts:  # as image_geometry reads it: by the count
        counts = _ROS_COUNTS["rational_polynomial"]
        coefficients = _without_zeros(held, counts)
    if len(coefficients) not in counts:
        raise flat.fault("distortion_coefficients", f"holds {len(held)} values", right)
    return values.camera((width, height), pinhole, coefficients, fisheye=model in ("equidistant", "fisheye"))


def _without_zeros(coefficients: tuple[float, ...], counts: tuple[int, ...]) -> tuple[float, ...]:
    """Without trailing zeros, if they are more than a model can have."""
    while len(coefficients) not in counts and coefficients and not coefficients[-1]:
        coefficients = coefficients[:-1]
    return coefficients


def write_ros(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """Write rectification and projection for a monocular camera."""
    coefficients = list(camera.coefficients)  # type: ignore[union-attr]
    if camera.__struct_config__.tag == "fisheye":
        model = "equidistant"
    elif len(coefficients) <= 5:
        model = "plumb_bob"
        coefficients += [0.0] * (5 - len(coefficients))
    else:
        model = "rational_polynomial"
    fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px

    def matrix(key: str, rows: int, columns: int, data: list[float]) -> list[str]:
        return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {_list_text(data)}"]

    lines = [
        *(f"# {note}" for note in notes),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        f"camera_name: {name}",
        *matrix("camera_matrix", 3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        f"distortion_model: {model}",
        *matrix("distortion_coefficients", 1, len(coefficients), coefficients),
        *matrix("rectification_matrix", 3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        *matrix("projection_matrix", 3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    ]
    return ("\n".join(lines) + "\n").encode()


_KALIBR = "a camchain of Kalibr: cam0: {camera_model, intrinsics, distortion_model, …}"
_KALIBR_COUNTS = {"radtan": 4, "equidistant": 4, "none": 0}


def read_kalibr(data: bytes, file: str, which: str | None = None) -> LensSettings:
    """The camera ``which`` (``cam0``) of a ``camchain.yaml``, pinhole with ``radtan`` (Brown-Conrady, 4 coefficients)
    or ``equidistant``; None: the only one.
    """
    values = FileValues(file, read_mapping(file, data, _KALIBR), _KALIBR)
    cameras = [key for key in values.content if key.startswith("cam") and key[3:].isdecimal()]
    if not cameras:
        raise values.fault("cam0", "is missing")
    if which is None and len(cameras) > 1:
        raise values.fault("", f"holds {len(cameras)} cameras", f"--camera {' or '.join(cameras)}")
    key = which or cameras[0]
    if key not in cameras:
        raise values.fault(key, "is not a camera of this file", " or ".join(cameras))
    camera = values.below(key)
    camera.choice("camera_model", camera.value("camera_model", "pinhole"), {"pinhole": None}, "pinhole")
    models = "radtan, equidistant or none"
    model = camera.value("distortion_model", models)
    count = camera.choice("distortion_model", model, _KALIBR_COUNTS, models)
    size = camera.pair("resolution", "[width, height]")
    fx, fy, cx, cy = camera.numbers("intrinsics", (4,), "[fu, fv, pu, pv]")
    coefficients = camera.numbers("distortion_coeffs", (count,), f"{count} numbers for {model}")
    return values.camera(size, (fx, fy, cx, cy), coefficients, fisheye=model == "equidistant")


def write_kalibr(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """One camera, ``cam0``."""
    model = "equidistant" if camera.__struct_config__.tag == "fisheye" else "radtan"
    coefficients = camera.coefficients[:4]  # type: ignore[union-attr]  # a fifth is zero
    lines = [
        *(f"# {note}" for note in notes),
        "cam0:",
        "  cam_overlaps: []",
        "  camera_model: pinhole",
        f"  distortion_coeffs: {_list_text(coefficients)}",
        f"  distortion_model: {model}",
        f"  intrinsics: {_list_text((camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))}",
        f"  resolution: [{camera.width_px}, {camera.height_px}]",
        f"  rostopic: /{name}/image_raw",
    ]
    return ("\n".join(lines) + "\n").encode()


_MRCAL = "a .cameramodel of mrcal: { 'lensmodel': 'LENSMODEL_OPENCV8', 'intrinsics': […], … }"
_MRCAL_COUNTS = {"LENSMODEL_PINHOLE": 0, **{f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}}


def read_mrcal(data: bytes, file: str) -> LensSettings:
    """Read a ``.cameramodel``, a Python literal; ``extrinsics``, the camera's pose, aren't read."""
    try:
        content = ast.literal_eval(data.decode("utf-8-sig").strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        raise InterchangeError(file, "", "is not a Python literal", _MRCAL) from None
    if not isinstance(content, dict):
        raise InterchangeError(file, "", f"holds {_shown(content)}", _MRCAL)
    values = FileValues(file, content, _MRCAL)
    key, models = "lens_model" if "lens_model" in content else "lensmodel", " or ".join(_MRCAL_COUNTS)  # before 2020
    model = values.value(key, models)
    count = 4 + values.choice(key, model, _MRCAL_COUNTS, f"{models} (mrcal-convert-lensmodel)")
    right = f"{count} numbers for {model}: fx, fy, cx, cy and the lens's"
    fx, fy, cx, cy, *lens = values.numbers("intrinsics", (count,), right)
    size = values.pair("imagersize", "[width, height]")
    return values.camera(size, (fx, fy, cx, cy), tuple(lens), fisheye=False)


def write_mrcal(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """Keys are in the order that mrcal's own reader expects; ``extrinsics`` are zeros."""
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
