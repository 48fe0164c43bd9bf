"""Files of other programs as values, by their content: YAML, JSON, XML and what ROS prints; faults are one line."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gripmon.model.errors import InputError
from gripmon.model.geometry import UNIT_TOLERANCE, make_transform, rotation_from_xyzw
from gripmon.model.records import Array
from gripmon.model.yaml_text import YamlFault, parse_yaml

Pinhole = tuple[float, float, float, float]
"""Focal lengths and principal point: fx, fy, cx, cy (px)."""


class InterchangeError(InputError):
    """``str()`` is one line ``file: key: what is wrong; what would be right``."""

    def __init__(self, file: str, key: str, wrong: str, right: str = ""):
        parts = [file, key, f"{wrong}; {right}" if right else wrong]
        super().__init__(" ".join(": ".join(part for part in parts if part).split()))


class UnknownFormatError(InterchangeError):
    """A file of no format that is read here."""


@dataclass(frozen=True, slots=True)
class FileValues:
    """The ``content`` of a file, or of a section of it; ``right`` says what should be there."""

    file: str
    content: Mapping[str, Any]
    right: str
    path: str = ""

    def fault(self, key: str, wrong: str, right: str = "") -> InterchangeError:
        return InterchangeError(self.file, (self.path + key).rstrip(":. "), wrong, right or self.right)

    def value(self, key: str, right: str = "") -> Any:
        if key not in self.content:
            raise self.fault(key, "is missing", right)
        return self.content[key]

    def below(self, key: str, right: str = "") -> FileValues:
        """The section under a key."""
        value = self.value(key, right)
        if not isinstance(value, Mapping):
            raise self.fault(key, f"is {shown(value)}", right)
        return FileValues(self.file, value, right or self.right, f"{self.path}{key}.")

    def number(self, key: str, otherwise: float | None = None) -> float:
        """A finite number; ``otherwise`` if there is none."""
        if otherwise is not None and key not in self.content:
            return otherwise
        return self._number(key, self.value(key))

    def _number(self, key: str, value: Any) -> float:
        number = as_number(value)
        if number is None:
            raise self.fault(key, f"{shown(value)} is not a number", "an ordinary number")
        return number

    def numbers(self, key: str, counts: tuple[int, ...], right: str) -> tuple[float, ...]:
        """Of a list, also one of rows, or a matrix with its ``data``, in order; as many as one of ``counts``."""
        value = self.value(key, right)
        if isinstance(value, Mapping):
            value = self.below(key).value("data", "a flat list of numbers")
        if not isinstance(value, list | tuple):
            raise self.fault(key, f"is {shown(value)}", right)
        flat = [one for each in value for one in (each if isinstance(each, list | tuple) else [each])]
        if len(flat) not in counts:
            raise self.fault(key, f"holds {len(flat)} values", right)
        return tuple(self._number(f"{key}[{i}]", one) for i, one in enumerate(flat))

    def size(self, *keys: str) -> tuple[int, int]:
        """Width and height (px), under two keys or one."""
        found = self.numbers(keys[0], (2,), "[width, height]") if len(keys) == 1 else tuple(map(self.number, keys))
        for key, number in zip(keys, found, strict=False):
            if number != int(number):
                raise self.fault(key, f"{shown(number)} is not a whole number", "a number of pixels")
        return int(found[0]), int(found[1])

    def pose(self, shift: Sequence[float], quaternion: Sequence[float]) -> Array:
        """A transform (4, 4); the quaternion x, y, z, w has to be of unit length."""
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > UNIT_TOLERANCE:
            hint = " (degrees?)" if max(map(abs, quaternion)) > 1.5 else ""
            raise self.fault("", f"its quaternion has length {length:.4g}{hint}", "a unit quaternion x y z w")
        x, y, z, w = quaternion
        return make_transform(rotation_from_xyzw((x, y, z, w)), np.array(shift))

    def flag(self, key: str, otherwise: bool) -> bool:
        """True or false, also in quotes, as some programs write it; ``otherwise`` if there is none."""
        value = self.content.get(key, otherwise)
        found = {"true": True, "false": False}.get(str(value).strip().lower())
        if found is None:
            raise self.fault(key, f"is {shown(value)}", "true or false")
        return found

    def choice(self, key: str, value: Any, known: Mapping[str, Any]) -> Any:
        """The meaning of one of several names."""
        if not isinstance(value, str) or value not in known:
            raise self.fault(key, f"{shown(value)} is not a model of gripmon's", " or ".join(known))
        return known[value]

    def pinhole(self, key: str) -> Pinhole:
        """From a camera matrix, 9 numbers row by row."""
        matrix = self.numbers(key, (9,), "3 x 3 numbers")
        if not any(matrix):
            raise self.fault(key, "is all zeros: an uncalibrated camera", "a calibrated one")
        fx, skew, cx, below, fy, cy, *last = matrix
        if skew or below or last != [0.0, 0.0, 1.0]:
            raise self.fault(key, f"{shown(list(matrix))} has a skew or is none", "[fx, 0, cx, 0, fy, cy, 0, 0, 1]")
        return fx, fy, cx, cy

    def coefficients(self, key: str, *, fisheye: bool, right: str) -> tuple[float, ...]:
        """Of OpenCV's lenses, without zeros that are more than any of them has."""
        held = self.numbers(key, tuple(range(15)), right)
        counts, short = ((4,) if fisheye else (0, 4, 5, 8, 12, 14)), held
        while len(short) not in counts and short and not short[-1]:
            short = short[:-1]
        if len(short) not in counts:
            raise self.fault(key, f"holds {len(held)} values", right)
        return short


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


def shown(value: Any) -> str:
    """A value for a message, shortened if it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_mapping(file: str, text: str, right: str) -> dict[str, Any]:
    """The mapping in a file's text, as YAML; ``right`` says what kind of file it should be."""
    value = _as_yaml(file, text, right)
    if not isinstance(value, dict):
        raise InterchangeError(file, "", "is empty" if value is None else "holds no keys", right)
    return value


_RIGHT = "YAML, JSON, XML or what ROS prints, as UTF-8"


class Document:
    """A file's content for every reader, decoded and parsed once, whichever of them asks."""

    def __init__(self, file: str, data: bytes) -> None:
        self.file = file
        try:
            self.text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError as error:
            raise InterchangeError(file, "", f"is not text (byte {error.start} is not UTF-8)", _RIGHT) from None

    @functools.cached_property
    def content(self) -> dict[str, Any]:
        """What is in the first document of YAML, in JSON or in OpenCV's XML; empty if that isn't a mapping."""
        text = self.text.lstrip()
        found: Any = None
        if text.startswith("<"):
            found = _as_xml(self.file, text)
        elif text.startswith("{"):
            try:
                found = json.loads(text)
            except json.JSONDecodeError as error:
                found = {} if error.msg == "Extra data" else None  # JSON lines; else YAML in one line
            except (RecursionError, ValueError):  # ValueError: an integer of thousands of digits
                found = None
        if found is None:
            found = _as_yaml(self.file, _first_document(self.text), _RIGHT)
        return found if isinstance(found, dict) else {}

    def values(self, right: str) -> FileValues:
        """The content, with what should be there."""
        return FileValues(self.file, self.content, right)


def _first_document(text: str) -> str:
    """Up to the second one, without OpenCV's first line (``%YAML:1.0`` isn't YAML) and its tags, and with blanks where
    it takes text without; lines keep their numbers.
    """
    lines: list[str] = []
    for line in text.splitlines(keepends=True):
        if line.startswith(("%YAML", "---", "...")):
            if any(one.strip() and not one.lstrip().startswith("#") for one in lines):
                break
            line = "\n"
        line = re.sub(r"^(\s*[A-Za-z_][\w.]*):\[", r"\1: [", line)
        lines.append(re.sub(r"!!opencv-[\w-]+", "", line))
    return "".join(lines)


def _as_yaml(file: str, text: str, right: str) -> Any:
    try:
        return parse_yaml(text)
    except YamlFault as fault:
        raise InterchangeError(file, fault.where, fault.wrong, fault.right or right) from None


def _as_xml(file: str, text: str) -> dict[str, Any] | None:
    """The children of ``<opencv_storage>``: text, several words, or more of the same; other XML is none."""
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InterchangeError(file, "", f"not XML: {error}", _RIGHT) from None
    if root.tag != "opencv_storage":
        return {}
    try:
        return {child.tag: _plain(child) for child in root}
    except RecursionError:
        raise InterchangeError(file, "", "is nested too deeply", _RIGHT) from None


def _plain(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _plain(child) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 else words
