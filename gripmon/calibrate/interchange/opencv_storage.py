"""OpenCV: what its calibration programs write with ``cv2.FileStorage``, as YAML, XML or JSON.

Its samples write ``camera_matrix`` and ``distortion_coefficients``, the interactive calibration ``cameraMatrix`` and
``dist_coeffs``; both are read.  A fisheye is one by ``fisheye_model: 1``, and a count of four tells nothing of it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import cv2
import numpy as np

from gripmon.calibrate.interchange.fault import (
    InterchangeError,
    brown_conrady,
    fisheye,
    focal_and_centre,
    number_of,
    numbers_of,
    whole_number_of,
)
from gripmon.model.camera import LensSettings

_RIGHT = "a file that cv2.FileStorage wrote: camera_matrix, distortion_coefficients, image_width, image_height"
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix")
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients")
_WIDTH = ("image_width", "image_Width")
_HEIGHT = ("image_height", "image_Height")
_SIZE = ("cameraResolution", "image_size", "imageSize")
_COUNTS = (0, 4, 5, 8, 12, 14)
DEEPEST = 64
"""Levels of nesting: what OpenCV writes has four at most, and its reader's stack is full after some 10,000."""

_TAG = re.compile(rb"</|/>|<(?=[A-Za-z_])")
_BRACKET = re.compile(rb"[][{}]")
_TEXT = re.compile(rb'"[^"\n]*"|<!--.*?-->', re.DOTALL)
_BLOCK_END = re.compile(rb"[][{}]")
_INTRODUCER = re.compile(rb"(?:^|(?<=\s))-(?=\s)|:(?=\s|$)")
_WIDEST_INDENT = 16  # blanks that one level is indented by at most in what OpenCV writes
SYNTAXES = {
    ".yaml": cv2.FileStorage_FORMAT_YAML,
    ".yml": cv2.FileStorage_FORMAT_YAML,
    ".xml": cv2.FileStorage_FORMAT_XML,
    ".json": cv2.FileStorage_FORMAT_JSON,
}


def read(
    data: bytes, file: str, size_px: tuple[int, int] | None = None, is_fisheye: bool | None = None
) -> LensSettings:
    """The camera in a file's bytes; ``size_px`` and ``is_fisheye`` where the file doesn't tell.

    Raises :class:`InterchangeError`.
    """
    if nesting(data) > DEEPEST:
        raise InterchangeError(file, "", f"is nested more than {DEEPEST} levels deep", _RIGHT)
    try:
        storage = cv2.FileStorage(data.decode("utf-8-sig"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        opened = storage.isOpened()
        nodes = {key: storage.getNode(key) for key in storage.root().keys()} if opened else {}  # noqa: SIM118  a function
    except (cv2.error, SystemError, UnicodeDecodeError):
        opened = False
    if not opened:
        raise InterchangeError(file, "", "OpenCV can't read it", _RIGHT)
    matrix_key, matrix = _numbers(file, nodes, _MATRIX)
    pinhole = focal_and_centre(file, matrix_key, numbers_of(file, matrix_key, matrix, (9,), "3 x 3 numbers"))
    key, coefficients = _numbers(file, nodes, _COEFFICIENTS)
    told = _whole(file, nodes, ("fisheye_model",))
    if told is not None and is_fisheye is not None and bool(told) is not is_fisheye:
        raise InterchangeError(file, "fisheye_model", f"is {told}", "no option that says otherwise")
    size = _size(file, nodes, size_px)
    if told or is_fisheye:
        return fisheye(file, size, pinhole, numbers_of(file, key, coefficients, (4,), "4 values for a fisheye"))
    return brown_conrady(file, size, pinhole, numbers_of(file, key, coefficients, _COUNTS, "4, 5, 8 or 12 values"))


def nesting(data: bytes) -> int:
    """No fewer levels than OpenCV will find, whatever the bytes are: it recurses at each, until the stack is full."""
    xml = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    signs, opening = (_TAG, (b"<",)) if xml else (_BRACKET, (b"[", b"{"))
    # Closing signs in texts and comments must not make up for those that open.
    deepest = max(_depth(signs.findall(each), opening) for each in (data, _TEXT.sub(b"", data)))
    return deepest if xml else deepest + max((_introducers(line) for line in data.splitlines()), default=0)


def _depth(signs: list[bytes], opening: tuple[bytes, ...]) -> int:
    """The most that are open at a time."""
    deepest = depth = 0
    for sign in signs:
        depth = depth + 1 if sign.startswith(opening) and sign != b"</" else max(depth - 1, 0)
        deepest = max(deepest, depth)
    return deepest


def _introducers(line: bytes) -> int:
    """What may nest on one line of YAML without brackets, ``- - a: b:``, and its indentation in levels."""
    block = _BLOCK_END.split(line, maxsplit=1)[0]
    return len(_INTRODUCER.findall(block)) + (len(line) - len(line.lstrip(b" "))) // _WIDEST_INDENT


def _size(file: str, nodes: dict[str, cv2.FileNode], given: tuple[int, int] | None) -> tuple[int, int]:
    width, height = _whole(file, nodes, _WIDTH), _whole(file, nodes, _HEIGHT)
    if width is None or height is None:
        present = next((key for key in _SIZE if key in nodes), None)
        if present is not None:
            pair = numbers_of(file, present, _flat(nodes[present]), (2,), "width and height")
            width, height = whole_number_of(file, present, pair[0]), whole_number_of(file, present, pair[1])
    if width is None or height is None:
        if given is None:
            raise InterchangeError(file, "image_width", "is missing", "--size WIDTHxHEIGHT says it")
        return given
    if given not in (None, (width, height)):
        raise InterchangeError(file, "image_width", f"the file says {width} x {height}", "no --size, or that one")
    return width, height


def _numbers(file: str, nodes: dict[str, cv2.FileNode], keys: tuple[str, ...]) -> tuple[str, list[float]]:
    key = next((k for k in keys if k in nodes), None)
    if key is None:
        raise InterchangeError(file, keys[0], "is missing", _RIGHT)
    return key, _flat(nodes[key])


def _flat(node: cv2.FileNode) -> list[float]:
    """The numbers of a matrix or a list, in order; empty if it is something else."""
    if node.isMap():
        try:
            matrix = node.mat()
        except (cv2.error, SystemError):
            return []
        return [] if matrix is None else np.asarray(matrix, dtype=np.float64).ravel().tolist()
    return [node.at(i).real() for i in range(node.size())] if node.isSeq() else []


def _whole(file: str, nodes: dict[str, cv2.FileNode], keys: tuple[str, ...]) -> int | None:
    key = next((k for k in keys if k in nodes), None)
    if key is None:
        return None
    node = nodes[key]
    value = node.real() if node.isInt() or node.isReal() else node.string() if node.isString() else None
    return whole_number_of(file, key, number_of(file, key, value))


def write(camera: LensSettings, notes: Sequence[str], name: str, suffix: str = ".yaml") -> bytes:
    """A file's bytes in the syntax that ``suffix`` is of; ``camera`` has a lens that the format has."""
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | SYNTAXES[suffix])
    if suffix == ".json":
        # JSON knows no comments, and OpenCV writes some: other readers would stumble.  So they do over \'.
        storage.write("notes", " | ".join(notes).replace("'", ""))
    else:
        for note in notes:
            storage.writeComment(note.replace("--", "- -") if suffix == ".xml" else note)
    is_fisheye = camera.__struct_config__.tag == "fisheye"
    storage.write("camera_name", name)
    storage.write("image_width", camera.width_px)
    storage.write("image_height", camera.height_px)
    storage.write("fisheye_model", int(is_fisheye))
    storage.write(
        "camera_matrix",
        np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]]),
    )
    storage.write("distortion_coefficients", np.array([camera.coefficients]).T)  # type: ignore[union-attr]
    return storage.releaseAndGetString().encode()
