"""Kalibr: ``camchain.yaml``, pinhole cameras with ``radtan`` (Brown-Conrady, 4 coefficients) or ``equidistant``."""

from __future__ import annotations

from collections.abc import Sequence

from gripmon.calibrate.interchange.fault import (
    InterchangeError,
    brown_conrady,
    fisheye,
    list_text,
    mapping_at,
    numbers_of,
    read_mapping,
    shown,
    value_at,
    whole_number_of,
)
from gripmon.model.camera import LensSettings

_RIGHT = "a camchain of Kalibr: cam0: {camera_model, intrinsics, distortion_model, …}"
_COUNTS = {"radtan": (4,), "equidistant": (4,), "none": (0,)}


def read(data: bytes, file: str, which: str | None = None) -> LensSettings:
    """The camera ``which`` (``cam0``) in a file's bytes; None: the only one.  :class:`InterchangeError`."""
    content = read_mapping(file, data, _RIGHT)
    cameras = [key for key in content if key.startswith("cam") and key[3:].isdecimal()]
    if not cameras:
        raise InterchangeError(file, "cam0", "is missing", _RIGHT)
    if which is None and len(cameras) > 1:
        raise InterchangeError(file, "", f"holds {len(cameras)} cameras", f"--camera {' or '.join(cameras)}")
    key = which or cameras[0]
    if key not in cameras:
        raise InterchangeError(file, key, "is no camera of this file", " or ".join(cameras))
    camera = mapping_at(file, content, key, _RIGHT)

    def numbers(name: str, counts: tuple[int, ...], right: str) -> tuple[float, ...]:
        return numbers_of(file, f"{key}.{name}", value_at(file, camera, name, right), counts, right)

    kind = value_at(file, camera, "camera_model", "pinhole")
    if kind != "pinhole":
        raise InterchangeError(file, f"{key}.camera_model", f"{shown(kind)} is no model of gripmon's", "pinhole")
    model = value_at(file, camera, "distortion_model", "radtan, equidistant or none")
    if model not in _COUNTS:
        raise InterchangeError(
            file, f"{key}.distortion_model", f"{shown(model)} is no model of gripmon's", "radtan, equidistant or none"
        )
    width, height = numbers("resolution", (2,), "[width, height]")
    size = whole_number_of(file, f"{key}.resolution", width), whole_number_of(file, f"{key}.resolution", height)
    fx, fy, cx, cy = numbers("intrinsics", (4,), "[fu, fv, pu, pv]")
    coefficients = numbers("distortion_coeffs", _COUNTS[model], f"{_COUNTS[model][0]} numbers for {model}")
    return (fisheye if model == "equidistant" else brown_conrady)(file, size, (fx, fy, cx, cy), coefficients)


def write(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """A file's bytes with one camera, ``cam0``; ``camera`` has a lens that the format has."""
    model = "equidistant" if camera.__struct_config__.tag == "fisheye" else "radtan"
    coefficients = camera.coefficients[:4]  # type: ignore[union-attr]  # a fifth is zero
    lines = [
        *(f"# {note}" for note in notes),
        "cam0:",
        "  cam_overlaps: []",
        "  camera_model: pinhole",
        f"  distortion_coeffs: {list_text(coefficients)}",
        f"  distortion_model: {model}",
        f"  intrinsics: {list_text((camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))}",
        f"  resolution: [{camera.width_px}, {camera.height_px}]",
        f"  rostopic: /{name}/image_raw",
    ]
    return ("\n".join(lines) + "\n").encode()
