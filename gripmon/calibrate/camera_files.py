"""Cameras in other programs' files, recognised by their content.

All lenses here are OpenCV's standard one or its fisheye, in the words of the program that wrote the file.  What a file
doesn't say is asked for, never guessed: which of several cameras, the image's size, and the model behind four numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from gripmon.calibrate.camera_formats import ROS_MESSAGE, FileLens, cameras_in, of_message
from gripmon.calibrate.foreign import Document, FileValues, InterchangeError
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, make_camera

LensModel = Literal["brown_conrady", "fisheye"]
LARGEST_TANGENTIAL = 0.01
"""Tangential coefficient above which a lens is more likely a fisheye, whose third and fourth coefficient stand there: a
lens that is tilted by a whole degree has less.
"""
FARTHEST_CENTRE = 0.25
"""Distance of the principal point from the image's middle, over its width or height, beyond which it is doubted."""
_MOST_NAMED = 6
_ASKED = "gripmon calibrate import with --model fisheye, or with --model brown_conrady if it is really one"


@dataclass(frozen=True, slots=True)
class ForeignCamera:
    """The ``camera`` in a file of the format ``kind``; ``warnings``: what the file leaves in doubt."""

    kind: str
    camera: LensSettings
    warnings: tuple[str, ...] = ()


def read_camera(
    document: Document,
    *,
    which: str | None = None,
    size_px: tuple[int, int] | None = None,
    model: LensModel | None = None,
) -> ForeignCamera:
    """The camera in a file.  Options for what a file may leave open: ``which`` of several cameras, the image's
    size, and the lens's model, which also overrules a file that calls a fisheye ``plumb_bob``.
    :class:`InterchangeError` for a file that holds none, for one that no monitor can use, and for one that leaves open
    what no option says.
    """
    file = document.file
    kind, cameras = cameras_in(document)
    if which is None and len(cameras) > 1:
        right = f"gripmon calibrate import with --camera {_named(cameras)}"
        raise InterchangeError(file, "", f"holds {len(cameras)} cameras", right)
    if which not in (None, *cameras):
        raise InterchangeError(file, str(which), "is not a camera of this file", _named(cameras))
    lens = cameras[which or next(iter(cameras))]()
    return ForeignCamera(kind, *_checked(file, lens, size_px, model))


def _named(cameras: Iterable[str]) -> str:
    """The names, of many only some: of a RealSense's streams and sizes those in colour first."""
    names = list(cameras)
    if len(names) > _MOST_NAMED:
        names = [*sorted(names, key=lambda name: not name.startswith("Color"))[:_MOST_NAMED], "…"]
    return " or ".join(names)


def _checked(
    file: str, lens: FileLens, size_px: tuple[int, int] | None, model: LensModel | None
) -> tuple[LensSettings, tuple[str, ...]]:
    """The camera, and a warning if nobody says which model its coefficients belong to."""
    size = _size(file, lens, size_px)
    if lens.fisheye and model == "brown_conrady":
        raise InterchangeError(file, "", "says that its lens is a fisheye", "without --model brown_conrady")
    coefficients, fisheye = lens.coefficients, bool(lens.fisheye)
    warnings: tuple[str, ...] = ()
    if model == "fisheye":
        fisheye = True
        if len(coefficients) < 4 or any(coefficients[4:]):
            raise InterchangeError(file, "", f"holds {len(coefficients)} coefficients", "a fisheye has 4")
        coefficients = coefficients[:4]
    elif not fisheye:
        if model is None:
            warnings = _doubts(file, lens)
        coefficients = _shortest(coefficients)
        if len(coefficients) > 12:
            wrong = f"the lens has a tilted sensor (tau {coefficients[12:]}), which gripmon has no model of"
            raise InterchangeError(file, "", wrong, "4, 5, 8 or 12 coefficients")
    camera = (FisheyeLens if fisheye else BrownConradyLens)(
        width_px=size[0], height_px=size[1],
        **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), lens.pinhole, strict=True)),
        coefficients=coefficients or (0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    try:
        make_camera(camera)
    except ValueError as error:
        raise InterchangeError(file, "", f"no camera that can be used: {error}") from None
    off = [abs(at - 0.5 * (n - 1)) / n for at, n in zip(lens.pinhole[2:], size, strict=True)]
    if max(off) > FARTHEST_CENTRE:
        where = f"({camera.cx_px:g}, {camera.cy_px:g}) px of {size[0]} x {size[1]}"
        warnings += (f"the principal point is at {where}, far from the middle: width and height swapped, or a region?",)
    return camera, warnings


def _size(file: str, lens: FileLens, size_px: tuple[int, int] | None) -> tuple[int, int]:
    """The image's size; a list of both may have the height first, where the principal point is nearer to the middle."""
    size, right = lens.size_px or size_px, "gripmon calibrate import with --size WIDTHxHEIGHT"
    if size is None:
        raise InterchangeError(file, "", "doesn't say the image's size", right)
    if lens.as_list and size_px is not None and size_px in (size, size[::-1]):
        return size_px
    if size_px not in (None, size):
        raise InterchangeError(file, "", f"says that images are {size[0]} x {size[1]} px", "no --size, or that one")
    as_it_is, swapped = (math.dist(lens.pinhole[2:], (0.5 * (w - 1), 0.5 * (h - 1))) for w, h in (size, size[::-1]))
    if lens.as_list and swapped < as_it_is:
        wrong = f"has the size [{size[0]}, {size[1]}], but the principal point is nearer to the middle of"
        raise InterchangeError(file, "", f"{wrong} {size[1]} x {size[0]} px", right)
    return size


def _doubts(file: str, lens: FileLens) -> tuple[str, ...]:
    if lens.doubt:
        raise InterchangeError(file, "", lens.doubt, _ASKED)
    tangential = lens.coefficients[2:4]
    only_four = not any(lens.coefficients[4:])  # a fisheye has no more
    if only_four and max(map(abs, tangential), default=0.0) > LARGEST_TANGENTIAL:
        wrong = "p1 = {:g}, p2 = {:g}: more than {:g}; the third and fourth coefficient of a fisheye?"
        raise InterchangeError(file, "", wrong.format(*tangential, LARGEST_TANGENTIAL), _ASKED)
    if lens.fisheye is None and len(lens.coefficients) == 4 and any(lens.coefficients):
        return ("four coefficients are read as k1 k2 p1 p2, but the file doesn't say so: cv2.fisheye also writes four",)
    return ()


def _shortest(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Without zeros that a shorter model does without; five are as usual as four."""
    return next((coefficients[:n] for n in (5, 8, 12) if not any(coefficients[n:])), coefficients)


def camera_of_message(message: Mapping[str, Any], name: str) -> LensSettings:
    """The camera of a ``sensor_msgs/CameraInfo``, as a mapping.  :class:`InterchangeError`."""
    return _checked(name, of_message(FileValues(name, message, ROS_MESSAGE)), None, None)[0]
