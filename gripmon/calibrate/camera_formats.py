"""The layouts of camera files: ROS, Kalibr, OpenCV, mrcal, COLMAP, RealSense, ORB-SLAM, VINS, OpenICC; each read into
OpenCV's terms, as the program that writes it defines them.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gripmon.calibrate.foreign import Document, FileValues, InterchangeError, Pinhole, UnknownFormatError, shown
from gripmon.model.records import Array

READ = "a camera of ROS, Kalibr, OpenCV, mrcal, COLMAP, RealSense, ORB-SLAM, VINS or OpenICC (GoPro)"


@dataclass(frozen=True, slots=True)
class FileLens:
    """A camera in OpenCV's terms.  ``size_px`` and ``fisheye`` are None if the file doesn't say it; ``doubt``: why its
    coefficients may mean something else; ``as_list``: the size is a list, where others put the height first.
    """

    pinhole: Pinhole
    coefficients: tuple[float, ...]
    size_px: tuple[int, int] | None
    fisheye: bool | None = False
    doubt: str = ""
    as_list: bool = False


Cameras = Mapping[str, Callable[[], FileLens]]
"""By name; each is read when it is asked for."""


def cameras_in(document: Document) -> tuple[str, Cameras]:
    """The format, and the cameras by name."""
    text = document.text
    if "LENSMODEL_" in text:
        return "mrcal", {"camera": partial(_mrcal, document)}
    if re.search(r"^[ \t]*camera matrix[ \t]*$", text, re.MULTILINE):
        return "ost", _ost(document)
    if lines := _COLMAP_LINE.findall(text):
        return "colmap", {line.split()[0]: partial(_colmap, document.file, line) for line in lines}
    if streams := _STREAM.findall(text):
        return "realsense", _streams(document.file, streams)
    content = document.content
    if any(_CAM.fullmatch(key) and isinstance(value, Mapping) for key, value in content.items()):
        return "kalibr", _kalibr(document.values(_KALIBR))
    if "model_type" in content:
        return "vins", {"camera": partial(_vins, document.values(_VINS))}
    if "intrinsic_type" in content:
        return "openicc", {"camera": partial(_openicc, document.values(_OPENICC))}
    matrix = content.get("camera_matrix")
    ros = {"image_width", "distortion_model"} & content.keys()
    if ros and isinstance(matrix, Mapping) and "dt" not in matrix:
        return "ros", {"camera": partial(_ros, document.values(_ROS_FILE))}
    if "distortion_model" in content and ("k" in content or "K" in content):
        return "ros", {"camera": partial(of_message, document.values(ROS_MESSAGE))}
    if found := _realsense(document.values(_REALSENSE)):
        return "realsense", found
    values = document.values(_OPENCV)
    if found := {**_orb(values), **_opencv(values)}:
        return "orb-slam" if any(key.startswith("Camera.") for key in content) else "opencv", found
    raise UnknownFormatError(document.file, "", "is in no format that is recognised", READ)


_ROS_FILE = "a camera_info file of ROS: image_width, camera_matrix, distortion_model, …"
ROS_MESSAGE = "a CameraInfo of ROS: width, height, distortion_model, d, k, binning_x, roi, …"
# OpenCV, which ROS passes them to, distinguishes models only by this count; REP 104 gives plumb_bob 5 and the other 8,
# and drivers fill up with zeros.
_ROS_MODELS = {
    "plumb_bob": "4 or 5", "rational_polynomial": "4 or 5 or 8 or 12 or 14", "equidistant": "4", "fisheye": "4",
}  # fmt: skip


def _ros(values: FileValues) -> FileLens:
    """The YAML of ``camera_calibration_parsers``, as used by ``camera_info_manager`` and ``cameracalibrator``.
    ``rectification_matrix`` and ``projection_matrix`` define ROS's rectification; they aren't read.
    """
    size = values.size("image_width", "image_height")
    # Older files name no model; they mean the only one that existed then.
    model = values.content.get("distortion_model", values.content.get("camera_model", "plumb_bob"))
    return _ros_lens(values, size, values.pinhole("camera_matrix"), model, "distortion_coefficients")


def of_message(values: FileValues) -> FileLens:
    """``sensor_msgs/CameraInfo``: width, height and K are of the whole sensor; the image is the region of interest in
    it, then binned.
    """
    d, k = ("d", "k") if "k" in values.content else ("D", "K")
    size, pinhole = _of_the_image(values, values.size("width", "height"), values.pinhole(k))
    return _ros_lens(values, size, pinhole, values.value("distortion_model") or "plumb_bob", d)


def _ros_lens(values: FileValues, size: tuple[int, int], pinhole: Pinhole, model: Any, key: str) -> FileLens:
    counts, fisheye = values.choice("distortion_model", model, _ROS_MODELS), model in ("equidistant", "fisheye")
    found = values.coefficients(key, fisheye=fisheye, right=f"of {model} {counts} values")
    return FileLens(pinhole, found, size, fisheye)


def _of_the_image(values: FileValues, whole: tuple[int, int], pinhole: Pinhole) -> tuple[tuple[int, int], Pinhole]:
    """Size (px) and pinhole of the images, from those of the whole sensor."""
    roi = values.below("roi") if values.content.get("roi") else FileValues(values.file, {}, values.right)
    x_px, y_px, *size_px = (int(roi.number(field, 0.0)) for field in ("x_offset", "y_offset", "width", "height"))
    offset, size = np.array([x_px, y_px]), np.array(size_px)
    if not (offset.any() or size.any()):  # by its definition the same as the whole
        size = np.array(whole)
    if (size <= 0).any() or (offset + size > whole).any():
        region, of = f"{size[0]} x {size[1]} px at {x_px}, {y_px}", f"{whole[0]} x {whole[1]} px"
        right = "width and height of the whole sensor"
        raise values.fault("roi", f"{region} isn't part of the {of} that K is of", right)
    binning = np.array([max(int(values.number(f"binning_{axis}", 1.0)), 1) for axis in "xy"])
    # A binned pixel's centre is the middle of its block.
    centre: Array = (np.array(pinhole[2:]) - offset - 0.5 * (binning - 1)) / binning
    width, height = (size // binning).tolist()
    return (width, height), (*(np.array(pinhole[:2]) / binning).tolist(), *centre.tolist())


_OST_SECTION = re.compile(r"^[ \t]*\[([^\]\n]+)\][ \t]*\n(.*?)(?=^[ \t]*\[|\Z)", re.MULTILINE | re.DOTALL)


def _ost(document: Document) -> Cameras:
    """``ost.txt`` and ``.ini`` of ROS: sections of headings, each with its numbers on the lines below."""
    right = "ost.txt of ROS: [image] with width and height, camera matrix, distortion"
    size: tuple[int, int] | None = None
    sections: dict[str, FileValues] = {}
    for title, body in _OST_SECTION.findall(document.text):
        content: dict[str, list[str]] = {}
        for words in (line.split() for line in body.splitlines() if line.strip() and not line.lstrip().startswith("#")):
            if re.match(r"[A-Za-z]", words[0]) and words[0].lower() not in ("nan", "inf"):
                numbers = content[" ".join(words)] = []
            elif content:
                numbers += words
        values = FileValues(document.file, content, right, f"[{title}] ")
        if title == "image":
            single = {key: numbers[0] if len(numbers) == 1 else numbers for key, numbers in content.items()}
            size = FileValues(document.file, single, right, values.path).size("width", "height")
        elif "camera matrix" in content:
            sections[title] = values
    if not sections:
        raise InterchangeError(document.file, "", "holds no camera in a section of its own", right)
    return {title: partial(_ost_camera, values, size) for title, values in sections.items()}


def _ost_camera(values: FileValues, size: tuple[int, int] | None) -> FileLens:
    lens = values.coefficients("distortion", fisheye=False, right="4, 5 or 8 values")
    return FileLens(values.pinhole("camera matrix"), lens, size, None)


_CAM = re.compile(r"cam\d+")
_KALIBR = "a camchain of Kalibr: cam0: {camera_model, intrinsics, distortion_model, …}"
_KALIBR_COUNTS = {"radtan": 4, "equidistant": 4, "none": 0}


def _kalibr(values: FileValues) -> Cameras:
    names = (key for key, value in values.content.items() if _CAM.fullmatch(key) and isinstance(value, Mapping))
    return {name: partial(_kalibr_camera, values.below(name)) for name in names}


def _kalibr_camera(camera: FileValues) -> FileLens:
    """Pinhole with ``radtan`` (Brown-Conrady, 4 coefficients) or ``equidistant``."""
    camera.choice("camera_model", camera.value("camera_model", "pinhole"), {"pinhole": None})
    model = camera.value("distortion_model", "radtan, equidistant or none")
    count = camera.choice("distortion_model", model, _KALIBR_COUNTS)
    fx, fy, cx, cy = camera.numbers("intrinsics", (4,), "[fu, fv, pu, pv]")
    coefficients = camera.numbers("distortion_coeffs", (count,), f"{count} numbers for {model}")
    return FileLens((fx, fy, cx, cy), coefficients, camera.size("resolution"), model == "equidistant")


_MRCAL = "a .cameramodel of mrcal: { 'lensmodel': 'LENSMODEL_OPENCV8', 'intrinsics': […], … }"
_MRCAL_COUNTS = {"LENSMODEL_PINHOLE": 0, **{f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}}


def _mrcal(document: Document) -> FileLens:
    """A Python literal; ``extrinsics``, the camera's pose, aren't read."""
    try:
        content = ast.literal_eval(document.text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        raise InterchangeError(document.file, "", "is not a Python literal", _MRCAL) from None
    if not isinstance(content, dict):
        raise InterchangeError(document.file, "", f"holds {shown(content)}", _MRCAL)
    values = FileValues(document.file, content, _MRCAL)
    key = "lens_model" if "lens_model" in content else "lensmodel"  # before 2020
    model = values.value(key, " or ".join(_MRCAL_COUNTS))
    count = 4 + values.choice(key, model, _MRCAL_COUNTS)
    right = f"{count} numbers for {model}: fx, fy, cx, cy and the lens's"
    fx, fy, cx, cy, *lens = values.numbers("intrinsics", (count,), right)
    return FileLens((fx, fy, cx, cy), tuple(lens), values.size("imagersize"))


_COLMAP_LINE = re.compile(r"^\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d+[ \t]+\d+(?:[ \t]+[-+.\deE]+)+[ \t]*$", re.MULTILINE)
# Focal lengths (one: of both axes), then the centre, then these coefficients, by OpenCV's places; whether a fisheye.
_COLMAP: dict[str, tuple[int, int, bool]] = {
    "SIMPLE_PINHOLE": (1, 0, False), "PINHOLE": (2, 0, False), "SIMPLE_RADIAL": (1, 1, False), "RADIAL": (1, 2, False),
    "OPENCV": (2, 4, False), "FULL_OPENCV": (2, 8, False), "OPENCV_FISHEYE": (2, 4, True),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, True), "RADIAL_FISHEYE": (1, 2, True),
}  # fmt: skip


def _colmap(file: str, line: str) -> FileLens:
    """A line of ``cameras.txt``: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]; its first pixel's centre is at 0.5."""
    number, model, width, height, *parameters = line.split()
    content = {"parameters": parameters, "width": width, "height": height}
    values = FileValues(file, content, "cameras.txt of COLMAP", f"camera {number}: ")
    focals, count, fisheye = values.choice("model", model, _COLMAP)
    right = f"{focals + 2 + count} numbers for {model}"
    found = values.numbers("parameters", (focals + 2 + count,), right)
    centre, lens = found[focals : focals + 2], found[focals + 2 :]
    pinhole = found[0], found[focals - 1], centre[0] - 0.5, centre[1] - 0.5
    return FileLens(pinhole, lens + (0.0,) * (4 - len(lens)), values.size("width", "height"), fisheye)


_REALSENSE = "intrinsics of librealsense: width, height, fx, fy, ppx, ppy, model, coeffs"
_REALSENSE_MODELS = {
    "none": False, "brown_conrady": False, "modified_brown_conrady": False, "inverse_brown_conrady": False,
    "plumb_bob": False, "kannala_brandt4": True,
}  # fmt: skip


def _realsense(values: FileValues, name: str = "") -> Cameras:
    """Every section with focal lengths and centre under librealsense's names, by its path."""
    if {"fx", "fy", "ppx", "ppy"} <= values.content.keys():
        return {name or "camera": partial(_realsense_camera, values)}
    found: dict[str, Callable[[], FileLens]] = {}
    for key, value in values.content.items():
        if isinstance(value, Mapping) and isinstance(key, str) and name.count(".") < 3:
            found.update(_realsense(values.below(key), f"{name}.{key}".strip(".")))
    return found


_STREAM = re.compile(
    r'^[ \t]*Intrinsic of "([^"\n]+)" / (\d+x\d+) / \{([^}\n]*)\}[ \t]*\n((?:[ \t]+\w.*:.*\n?)+)', re.MULTILINE
)


def _streams(file: str, streams: list[tuple[str, str, str, str]]) -> Cameras:
    """What ``rs-enumerate-devices -c`` prints: a section for each stream and size, alike for most pixel formats."""
    sections: dict[str, dict[str, Any]] = {}
    for stream, size, formats, body in streams:
        lines = (line.partition(":") for line in body.splitlines())
        content: dict[str, Any] = {key.strip().lower(): value.strip() for key, _, value in lines}
        content["coeffs"], content["model"] = content.get("coeffs", "").split(), content.pop("distortion", "")
        name = f"{stream}/{size}".replace(" ", "_")
        sections[name if sections.get(name, content) == content else f"{name}/{formats}"] = content
    return {
        name: partial(_realsense_camera, FileValues(file, content, _REALSENSE, f"{name}: "))
        for name, content in sections.items()
    }


def _realsense_camera(values: FileValues) -> FileLens:
    """What librealsense calls inverse and modified has had another meaning in its versions, and none in ROS's driver,
    unless its coefficients are zero.
    """
    which = next((key for key in ("model", "distortion_model") if key in values.content), "model")
    lens = next((key for key in ("coeffs", "distortion", "distortion_coeffs") if key in values.content), "coeffs")
    said = re.sub(r"[ -]", "_", str(values.value(which, " or ".join(_REALSENSE_MODELS))).lower())
    model = said.removeprefix("distortion.").removeprefix("rs2_distortion_")
    fisheye = values.choice(which, model, _REALSENSE_MODELS)
    right = "4 or 5 values; zeros if the lens is known to have no distortion"
    found = values.coefficients(lens, fisheye=fisheye, right=right)
    doubtful = {"none": found, "inverse_brown_conrady": found, "modified_brown_conrady": found[2:4]}.get(model, ())
    doubt = f"{values.path}{which}: {model} isn't OpenCV's lens" if any(doubtful) else ""
    size = values.size("width", "height") if "width" in values.content else None
    fx, fy, cx, cy = map(values.number, ("fx", "fy", "ppx", "ppy"))
    return FileLens((fx, fy, cx, cy), found, size, fisheye, doubt)


_ORB_MODELS = {"pinhole": False, "rectified": False, "kannalabrandt8": True}


def _orb(values: FileValues) -> Cameras:
    """ORB-SLAM 2 and 3: ``Camera.fx``, of stereo ``Camera1.fx`` and ``Camera2.fx``."""
    keys = [key for key in values.content if re.fullmatch(r"Camera\d*\.fx", str(key))]
    return {name: partial(_orb_camera, values, name) for name in (key.partition(".")[0] for key in keys)}


def _orb_camera(values: FileValues, name: str) -> FileLens:
    said = str(values.content.get("Camera.type", "PinHole")).lower()
    fisheye = values.choice("Camera.type", said, _ORB_MODELS)
    fx, fy, cx, cy = (values.number(f"{name}.{key}") for key in ("fx", "fy", "cx", "cy"))
    pinhole = fx, fy, cx, cy
    size = values.size("Camera.width", "Camera.height") if "Camera.width" in values.content else None
    if fisheye:
        return FileLens(pinhole, tuple(values.number(f"{name}.k{n}") for n in (1, 2, 3, 4)), size, True)
    keys = () if said == "rectified" else ("k1", "k2", "p1", "p2", "k3")
    lens = tuple(values.number(f"{name}.{key}", 0.0) for key in keys)
    return FileLens(pinhole, lens if any(lens[4:]) else lens[:4], size)


_VINS = "a camera of VINS (camodocal): model_type, image_width, distortion_parameters, projection_parameters"
_VINS_MODELS = {
    "PINHOLE": ("fx fy cx cy", "k1 k2 p1 p2"),
    "PINHOLE_FULL": ("fx fy cx cy", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "KANNALA_BRANDT": ("mu mv u0 v0", "k2 k3 k4 k5"),
}


def _vins(values: FileValues) -> FileLens:
    """The coefficients of KANNALA_BRANDT count from 2, and may stand among the projection's."""
    model = str(values.value("model_type")).upper()
    pinhole, lens = values.choice("model_type", model, _VINS_MODELS)
    parts = [values.content.get(f"{part}_parameters") for part in ("distortion", "projection")]
    merged = {key: value for part in parts if isinstance(part, Mapping) for key, value in part.items()}
    both = FileValues(values.file, merged, _VINS)
    size = values.size("image_width", "image_height")
    fx, fy, cx, cy = map(both.number, pinhole.split())
    return FileLens((fx, fy, cx, cy), tuple(map(both.number, lens.split())), size, model == "KANNALA_BRANDT")


_OPENICC = "intrinsics of OpenICC (GoPro): image_width, intrinsic_type, intrinsics: {focal_length, aspect_ratio, …}"
_OPENICC_MODELS = {"FISHEYE": "1 2 3 4", "PINHOLE": "1 2", "PINHOLE_RADIAL_TANGENTIAL": "1 2 3"}


def _openicc(values: FileValues) -> FileLens:
    """As Theia defines them: ``fy`` is the focal length times ``aspect_ratio``."""
    model = values.value("intrinsic_type")
    terms = values.choice("intrinsic_type", model, _OPENICC_MODELS)
    lens, size = values.below("intrinsics"), values.size("image_width", "image_height")
    if lens.number("skew", 0.0):
        raise lens.fault("skew", f"is {shown(lens.content['skew'])}", "0: gripmon has no model of it")
    fx = lens.number("focal_length")
    pinhole = fx, fx * lens.number("aspect_ratio"), lens.number("principal_pt_x"), lens.number("principal_pt_y")
    k = [lens.number(f"radial_distortion_{n}") for n in terms.split()]
    if model == "FISHEYE":
        return FileLens(pinhole, tuple(k), size, True)
    p = [lens.number(f"tangential_distortion_{n}") if len(k) == 3 else 0.0 for n in (1, 2)]
    return FileLens(pinhole, (*k[:2], *p, *k[2:]), size)


_OPENCV = "a file that cv2.FileStorage wrote: camera_matrix, distortion_coefficients, image_width, image_height"
# The names in OpenCV's samples, its interactive calibration, and older programs; M1 D1 M2 D2 of stereo.
_MATRIX = re.compile(r"((?:\w+[._])??)(camera_?matrix|intrinsics?(?:_?matrix)?|[mk])(_?(?:\d|l|r|left|right)?)", re.I)
_WIDTH_HEIGHT = ("image_width", "image_height"), ("image_Width", "image_Height")
_DISTORTION = r"(?:distortion(?:_?coeff(?:icient)?s?)?|dist(?:_?coeffs?)?|d)"


def _opencv(values: FileValues) -> Cameras:
    """What ``cv2.FileStorage`` wrote as YAML, XML or JSON, or others as lists: 3 x 3 matrices with a camera's name."""
    found: dict[str, Callable[[], FileLens]] = {}
    for key, value in values.content.items():
        named = _MATRIX.fullmatch(str(key))
        data = value.get("data") if isinstance(value, Mapping) else value
        if named is not None and isinstance(data, list) and len(data) in (3, 9):
            found[key] = partial(_opencv_camera, values, key, named[1], named[3])
    return found


def _opencv_camera(values: FileValues, key: str, before: str, after: str) -> FileLens:
    pattern = re.compile(re.escape(before) + _DISTORTION + re.escape(after), re.I)
    name = next((k for k in values.content if pattern.fullmatch(str(k))), f"{before}distortion_coefficients{after}")
    marked = values.number("fisheye_model", -1.0)
    fisheye = None if marked < 0.0 else bool(marked)
    right = "4 values for a fisheye" if fisheye else "4, 5, 8 or 12 values"
    lens = values.coefficients(name, fisheye=bool(fisheye), right=right)
    said = " ".join(value for value in values.content.values() if isinstance(value, str))
    other = re.search(r"fisheye|equidist|kannala|omni", said, re.I) if fisheye is None else None
    doubt = "" if other is None else f"mentions {other[0]}"
    size, as_list = _opencv_size(values, before)
    return FileLens(values.pinhole(key), lens, size, fisheye, doubt, as_list)


def _opencv_size(values: FileValues, before: str) -> tuple[tuple[int, int] | None, bool]:
    """And whether it is a list."""
    for width, height in ((f"{before}width", f"{before}height"), *_WIDTH_HEIGHT):
        if width in values.content:
            return values.size(width, height), False
    key = next((k for k in ("cameraResolution", "image_size", "imageSize") if k in values.content), None)
    return None if key is None else values.size(key), key is not None
