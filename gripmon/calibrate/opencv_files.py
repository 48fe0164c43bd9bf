"""OpenCV: files that its calibration programs write with ``cv2.FileStorage``, as YAML, XML or JSON."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from gripmon.calibrate.formats import FileValues, InterchangeError
from gripmon.model.camera import LensSettings

_OPENCV = "a file that cv2.FileStorage wrote: camera_matrix, distortion_coefficients, image_width, image_height"
# The names in OpenCV's samples, its interactive calibration, and older programs.
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix")
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")
_SIZE = ("cameraResolution", "image_size", "imageSize")
DEEPEST = 64
"""Levels of nesting: OpenCV writes at most four, and its reader overflows the stack at some 10,000."""
_TAG = re.compile(rb"</|/>|<(?=[A-Za-z_])")
_BRACKET = re.compile(rb"[][{}]")
_TEXT = re.compile(rb'"[^"\n]*"|<!--.*?-->', re.DOTALL)
_INTRODUCER = re.compile(rb"(?:^|(?<=\s))-(?=\s)|:(?=\s|$)")
_WIDEST_INDENT = 16  # blanks that OpenCV writes to indent one level, at most
SYNTAXES = {
    ".yaml": cv2.FileStorage_FORMAT_YAML, ".yml": cv2.FileStorage_FORMAT_YAML,
    ".xml": cv2.FileStorage_FORMAT_XML, ".json": cv2.FileStorage_FORMAT_JSON,
}  # fmt: skip


def read_opencv(
    data: bytes, file: str, size_px: tuple[int, int] | None = None, is_fisheye: bool | None = None
) -> LensSettings:
    """Read a file that ``cv2.FileStorage`` wrote as YAML, XML or JSON; ``size_px`` and ``is_fisheye`` for files that
    omit them: ``fisheye_model: 1`` marks a fisheye, but four coefficients don't.
    """
    if nesting(data) > DEEPEST:
        raise InterchangeError(file, "", f"is nested more than {DEEPEST} levels deep", _OPENCV)
    try:
        storage = cv2.FileStorage(data.decode("utf-8-sig"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        opened = storage.isOpened()
        nodes = {key: storage.getNode(key) for key in storage.root().keys()} if opened else {}  # noqa: SIM118  a function
    except (cv2.error, SystemError, UnicodeDecodeError):
        opened = False
    if not opened:
        raise InterchangeError(file, "", "OpenCV can't read it", _OPENCV)
    values = FileValues(file, {key: _plain(node) for key, node in nodes.items()}, _OPENCV)
    pinhole = values.pinhole(_first(values, _MATRIX))
    key = _first(values, _COEFFICIENTS)
    if "fisheye_model" in nodes:
        said = values.pixels("fisheye_model", values.content["fisheye_model"])
        if is_fisheye is not None and bool(said) is not is_fisheye:
            raise values.fault("fisheye_model", f"is {said}", "no option that says otherwise")
        is_fisheye = bool(said)
    size = _size(values, size_px)
    counts, right = ((4,), "4 values for a fisheye") if is_fisheye else ((0, 4, 5, 8, 12, 14), "4, 5, 8 or 12 values")
    return values.camera(size, pinhole, values.numbers(key, counts, right), fisheye=bool(is_fisheye))


def nesting(data: bytes) -> int:
    """An upper bound of the nesting levels that OpenCV will find: it recurses at each, until the stack overflows."""
    xml = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    signs, opening = (_TAG, (b"<",)) if xml else (_BRACKET, (b"[", b"{"))
    # Closing signs in texts and comments must not cancel opening ones.
    deepest = max(_depth(signs.findall(each), opening) for each in (data, _TEXT.sub(b"", data)))
    return deepest if xml else deepest + max((_introducers(line) for line in data.splitlines()), default=0)


def _depth(signs: list[bytes], opening: tuple[bytes, ...]) -> int:
    """The largest number that is open at a time."""
    deepest = depth = 0
    for sign in signs:
        depth = depth + 1 if sign.startswith(opening) and sign != b"</" else max(depth - 1, 0)
        deepest = max(deepest, depth)
    return deepest


def _introducers(line: bytes) -> int:
    """The possible nesting on one line of YAML without brackets, ``- - a: b:``, plus its indentation in levels."""
    block = _BRACKET.split(line, maxsplit=1)[0]
    return len(_INTRODUCER.findall(block)) + (len(line) - len(line.lstrip(b" "))) // _WIDEST_INDENT


def _first(values: FileValues, keys: tuple[str, ...]) -> str:
    """The first of several names that the file uses."""
    key = next((k for k in keys if k in values.content), None)
    if key is None:
        raise values.fault(keys[0], "is missing")
    return key


def _size(values: FileValues, given: tuple[int, int] | None) -> tuple[int, int]:
    size: list[int] = []
    for keys in (_WIDTH, _HEIGHT):
        size += [values.pixels(k, values.content[k]) for k in keys if k in values.content][:1]
    key = next((k for k in _SIZE if k in values.content), None)
    if len(size) < 2 and key is not None:
        size = list(values.pair(key, "width and height"))
    if len(size) < 2:
        if given is None:
            raise values.fault("image_width", "is missing", "--size WIDTHxHEIGHT says it")
        return given
    if given not in (None, (size[0], size[1])):
        raise values.fault("image_width", f"the file says {size[0]} x {size[1]}", "no --size, or that one")
    return size[0], size[1]


def _plain(node: cv2.FileNode) -> Any:
    """A number, a text, or the numbers of a matrix or a list in order; empty for anything else."""
    if node.isMap():
        try:
            matrix = node.mat()
        except (cv2.error, SystemError):
            return []
        return [] if matrix is None else np.asarray(matrix, dtype=np.float64).ravel().tolist()
    if node.isSeq():
        return [node.at(i).real() for i in range(node.size())]
    return node.real() if node.isInt() or node.isReal() else node.string() if node.isString() else None


def write_opencv(camera: LensSettings, notes: Sequence[str], name: str, suffix: str = ".yaml") -> bytes:
    """Write in the syntax that belongs to ``suffix``."""
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | SYNTAXES[suffix])
    if suffix == ".json":
        # JSON has no comments, but OpenCV writes some, which other readers reject.  They also reject \'.
        storage.write("notes", " | ".join(notes).replace("'", ""))
    else:
        for note in notes:
            storage.writeComment(note.replace("--", "- -") if suffix == ".xml" else note)
    storage.write("camera_name", name)
    storage.write("image_width", camera.width_px)
    storage.write("image_height", camera.height_px)
    storage.write("fisheye_model", int(camera.__struct_config__.tag == "fisheye"))
    storage.write(
        "camera_matrix",
        np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]]),
    )
    storage.write("distortion_coefficients", np.array([camera.coefficients]).T)  # type: ignore[union-attr]
    return storage.releaseAndGetString().encode()
