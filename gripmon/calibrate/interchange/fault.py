"""The one exception of this room, how values of foreign files are taken, and YAML as others' own readers take it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any

import yaml

from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, make_camera
from gripmon.model.errors import InputError


class InterchangeError(InputError):
    """``str()`` is one line ``file: key: what is wrong; what would be right``."""

    def __init__(self, file: str, key: str, wrong: str, right: str = ""):
        parts = [file, key, f"{wrong}; {right}" if right else wrong]
        super().__init__(" ".join(": ".join(part for part in parts if part).split()))


def mapping_at(file: str, content: Mapping[str, Any], key: str, right: str) -> Mapping[str, Any]:
    """What stands under a key, which has keys itself."""
    value = value_at(file, content, key, right)
    if not isinstance(value, Mapping):
        raise InterchangeError(file, key, f"is {shown(value)}", right)
    return value


def value_at(file: str, content: Mapping[str, Any], key: str, right: str) -> Any:
    """What stands under a key that has to be there."""
    if key not in content:
        raise InterchangeError(file, key, "is missing", right)
    return content[key]


def number_of(file: str, key: str, value: Any) -> float:
    """A finite number; text that reads as one is one, as YAML 1.1 takes ``1e-05`` for text."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise InterchangeError(file, key, f"{shown(value)} is no number", "an ordinary number")
    return float(value)


def whole_number_of(file: str, key: str, value: Any) -> int:
    number = number_of(file, key, value)
    if number != int(number):
        raise InterchangeError(file, key, f"{shown(value)} is no whole number", "a number of pixels")
    return int(number)


def numbers_of(file: str, key: str, value: Any, counts: tuple[int, ...], right: str) -> tuple[float, ...]:
    """A flat list of as many numbers as one of ``counts``."""
    if not isinstance(value, list | tuple):
        raise InterchangeError(file, key, f"is {shown(value)}", right)
    if len(value) not in counts:
        raise InterchangeError(file, key, f"holds {len(value)} values", right)
    return tuple(number_of(file, f"{key}[{i}]", v) for i, v in enumerate(value))


def focal_and_centre(file: str, key: str, matrix: tuple[float, ...]) -> tuple[float, float, float, float]:
    """``fx fy cx cy`` of a camera matrix, 9 numbers row by row."""
    fx, skew, cx, below, fy, cy, *last = matrix
    if skew or below or last != [0.0, 0.0, 1.0]:
        raise InterchangeError(
            file, key, f"{shown(list(matrix))} has a skew or is none", "[fx, 0, cx, 0, fy, cy, 0, 0, 1]"
        )
    return fx, fy, cx, cy


def brown_conrady(
    file: str, size_px: tuple[int, int], pinhole: tuple[float, float, float, float], coefficients: tuple[float, ...]
) -> LensSettings:
    """A camera with OpenCV's standard lens, checked; 14 coefficients if the sensor isn't tilted, none for no lens."""
    if len(coefficients) == 14 and not any(coefficients[12:]):
        coefficients = coefficients[:12]
    if len(coefficients) == 14:
        raise InterchangeError(
            file, "", f"the lens has a tilted sensor (tau {coefficients[12:]}), which gripmon has no model of",
            "4, 5, 8 or 12 coefficients",
        )  # fmt: skip
    fx, fy, cx, cy = pinhole
    return checked(
        file,
        BrownConradyLens(
            width_px=size_px[0], height_px=size_px[1], fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy,
            coefficients=coefficients or (0.0, 0.0, 0.0, 0.0),
        ),
    )  # fmt: skip


def fisheye(
    file: str, size_px: tuple[int, int], pinhole: tuple[float, float, float, float], coefficients: tuple[float, ...]
) -> LensSettings:
    """A camera with OpenCV's fisheye lens, checked."""
    fx, fy, cx, cy = pinhole
    return checked(
        file,
        FisheyeLens(
            width_px=size_px[0], height_px=size_px[1], fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=coefficients
        ),
    )


def checked(file: str, camera: LensSettings) -> LensSettings:
    """The camera, if a monitor can use it."""
    try:
        make_camera(camera)
    except ValueError as error:
        raise InterchangeError(file, "", f"no camera that can be used: {error}") from None
    return camera


def shown(value: Any) -> str:
    """A value for a message: not all of a long one."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def number_text(value: float) -> str:
    """The shortest text that reads back as the same number, for YAML 1.1, too: ``1.0e-05``."""
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}" if e else text


def list_text(values: tuple[float, ...] | list[float]) -> str:
    return "[" + ", ".join(map(number_text, values)) + "]"


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    pass


class _Twice(Exception):
    def __init__(self, key: str, line: int):
        super().__init__(key)
        self.key, self.line = key, line


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[str, Any]:
    keys = [str(key.value) for key, _ in node.value]
    for i, (key, _) in enumerate(node.value):
        if keys[i] in keys[:i]:
            raise _Twice(keys[i], key.start_mark.line + 1)
    return {str(k): v for k, v in loader.construct_pairs(node, deep=True)}


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def read_mapping(file: str, data: bytes, right: str) -> dict[str, Any]:
    """The mapping in a file's bytes; ``right`` says what kind of file it should be."""
    try:
        value = yaml.load(data.decode("utf-8-sig"), _Loader)
    except UnicodeDecodeError as error:
        raise InterchangeError(file, "", f"is not text (byte {error.start} is not UTF-8)", right) from None
    except _Twice as error:
        raise InterchangeError(file, f"line {error.line}", f"the key '{error.key}' is there twice", "once") from None
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InterchangeError(
            file, line, f"not YAML: {error.problem or error.context or 'malformed'}", right
        ) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InterchangeError(file, "", f"not YAML: {error}", right) from None
    if not isinstance(value, dict):
        raise InterchangeError(file, "", "is empty" if value is None else "holds no keys", right)
    return value
