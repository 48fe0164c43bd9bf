"""Cameras for other programs, by format name; a lens that a format doesn't support becomes the nearest one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gripmon.calibrate.foreign import InterchangeError
from gripmon.model.camera import BrownConradyLens, Camera, LensSettings, make_camera
from gripmon.model.lenses import BrownMap
from gripmon.model.records import Array
from gripmon.model.yaml_text import as_yaml

FORMATS = ("ros", "kalibr", "opencv", "mrcal")
LARGEST_FIT_PX = 1.0
"""Largest error of a fit that still counts as a calibration (px)."""
_BROWN_COUNTS = {"ros": (4, 5, 8, 12), "kalibr": (4,), "opencv": (4, 5, 8, 12), "mrcal": (4, 5, 8, 12)}
_FITTED_COUNTS = {"ros": (5, 8), "kalibr": (4,), "opencv": (5, 8), "mrcal": (5, 8)}
_FISHEYE = ("ros", "kalibr", "opencv")
SYNTAXES = {
    ".yaml": cv2.FileStorage_FORMAT_YAML, ".yml": cv2.FileStorage_FORMAT_YAML,
    ".xml": cv2.FileStorage_FORMAT_XML, ".json": cv2.FileStorage_FORMAT_JSON,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Exported:
    """A file's bytes, and warnings about them."""

    data: bytes
    warnings: tuple[str, ...] = ()


def write_camera(
    camera: LensSettings, kind: str, notes: Sequence[str], *, name: str, file: str, suffix: str = "", fit: bool = False
) -> Exported:
    """A file's bytes.  ``notes`` become comments, ``name`` is the camera's; ``file`` is where it comes from, for
    messages; ``suffix`` of the output file selects OpenCV's syntax: YAML unless it is .xml or .json.

    A lens that the format doesn't support raises :class:`InterchangeError`, or with ``fit`` is written as the nearest
    one that it supports, with a warning about the largest error in the image.
    """
    warnings: list[str] = []
    if not _supports(kind, camera):
        camera, warning = _nearest(camera, kind, file, fit)
        warnings.append(warning)
    if kind == "ros" and len(getattr(camera, "coefficients", ())) == 12:
        warnings.append("rational_polynomial with 12 coefficients: OpenCV takes them, ROS's own text speaks of 8")
    notes = [" ".join(note.split()) for note in (*notes, *warnings)]
    if kind == "opencv":
        data = _write_opencv(camera, notes, name, suffix.lower() if suffix.lower() in SYNTAXES else ".yaml")
    else:
        data = {"ros": _write_ros, "kalibr": _write_kalibr, "mrcal": _write_mrcal}[kind](camera, notes, name)
    return Exported(data, tuple(warnings))


def _supports(kind: str, camera: LensSettings) -> bool:
    tag = camera.__struct_config__.tag
    if tag == "fisheye":
        return kind in _FISHEYE
    if tag != "brown_conrady":
        return False
    coefficients = camera.coefficients  # type: ignore[union-attr]
    return len(coefficients) in _BROWN_COUNTS[kind] or (kind == "kalibr" and not any(coefficients[4:]))


def _nearest(camera: LensSettings, kind: str, file: str, fit: bool) -> tuple[LensSettings, str]:
    lens = f"{kind} has no lens like this one ({camera.__struct_config__.tag})"
    try:
        fitted = fit_brown_conrady(camera, _FITTED_COUNTS[kind])
    except ValueError as error:
        raise InterchangeError(
            file, "camera.model", f"{lens}, and none that is near: {error}", "another format"
        ) from None
    off = f"{fitted.largest_px:.2g} px off at most anywhere in the image"
    if fitted.largest_px > LARGEST_FIT_PX:
        raise InterchangeError(file, "camera.model", f"{lens}, and the nearest is {off}", "another format")
    count = len(fitted.camera.coefficients)
    if not fit:
        raise InterchangeError(
            file, "camera.model", lens,
            f"another format, or --fit for the nearest Brown-Conrady ({count} coefficients), {off}",
        )  # fmt: skip
    return fitted.camera, f"the lens was {camera.__struct_config__.tag}; this is the nearest Brown-Conrady, {off}"


def _commented(notes: Sequence[str], content: dict[str, Any]) -> bytes:
    return ("".join(f"# {note}\n" for note in notes) + as_yaml(content, inline=True)).encode()


def _matrix(values: NDArray[Any]) -> dict[str, Any]:
    """Of two dimensions, as ROS writes it."""
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def _write_ros(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """Write rectification and projection for a monocular camera."""
    coefficients = list(camera.coefficients)  # type: ignore[union-attr]
    if camera.__struct_config__.tag == "fisheye":
        model = "equidistant"
    elif len(coefficients) <= 5:
        model = "plumb_bob"
        coefficients += [0.0] * (5 - len(coefficients))
    else:
        model = "rational_polynomial"
    matrix = _pinhole(camera)
    content = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": name,
        "camera_matrix": _matrix(matrix),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([coefficients])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([matrix, np.zeros(3)])),
    }
    return _commented(notes, content)


def _pinhole(camera: LensSettings) -> Array:
    return np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])


def _write_kalibr(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
    """One camera, ``cam0``."""
    content = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": list(camera.coefficients[:4]),  # type: ignore[union-attr]  # a fifth is zero
        "distortion_model": "equidistant" if camera.__struct_config__.tag == "fisheye" else "radtan",
        "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{name}/image_raw",
    }
    return _commented(notes, {"cam0": content})


def _write_mrcal(camera: LensSettings, notes: Sequence[str], name: str) -> bytes:
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


def _write_opencv(camera: LensSettings, notes: Sequence[str], name: str, suffix: str = ".yaml") -> bytes:
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
    storage.write("camera_matrix", _pinhole(camera))
    storage.write("distortion_coefficients", np.array([camera.coefficients]).T)  # type: ignore[union-attr]
    return storage.releaseAndGetString().encode()


GOOD_ENOUGH_PX = 0.001
"""Error below which a fit with fewer coefficients is accepted (px)."""
_STEPS = 20
"""For a refinement with a good start."""
_FITTED, _CHECKED = 41, 101
"""Points along each side of the image: where the lens is fitted, and where it is compared."""


@dataclass(frozen=True, slots=True)
class FittedLens:
    """``camera`` approximates another camera to within ``largest_px`` anywhere in the image."""

    camera: BrownConradyLens
    largest_px: float


def fit_brown_conrady(camera: LensSettings, counts: tuple[int, ...]) -> FittedLens:
    """The Brown-Conrady camera with the fewest of ``counts`` coefficients that is near enough, otherwise the nearest;
    focal lengths and principal point are kept.  ValueError if the image shows directions that no such lens maps.
    """
    original = make_camera(camera)
    best: FittedLens | None = None
    fault = ""
    for count in sorted(counts):
        try:
            fitted = _fit(original, count)
        except ValueError as error:
            fault = str(error)
            continue
        if best is None or fitted.largest_px < best.largest_px:
            best = fitted
        if best.largest_px <= GOOD_ENOUGH_PX:
            break
    if best is None:
        raise ValueError(fault)
    return best


def _fit(original: Camera, count: int) -> FittedLens:
    xy, uv_px = _seen(original, _FITTED)
    settings = original.settings
    q = (uv_px - [settings.cx_px, settings.cy_px]) / [settings.fx_px, settings.fy_px]
    start = _linear(xy, q, count)
    coefficients = start
    if count == 8:

        def errors(values: Array) -> Array:
            found = BrownMap(_ordered(values)).distort(np.ascontiguousarray(xy.T)).T
            return np.asarray(np.where(np.isfinite(found), found - q, 1.0)).ravel() * settings.fx_px

        coefficients = least_squares(errors, start, x_scale="jac", max_nfev=_STEPS).x
    lens = BrownConradyLens(
        **{key: getattr(settings, key) for key in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")},
        coefficients=_ordered(coefficients),
    )
    fitted = make_camera(lens)
    xy, uv_px = _seen(original, _CHECKED)
    apart_px = np.linalg.norm(fitted.distort(xy) - uv_px, axis=1)
    if not np.isfinite(apart_px).all():
        raise ValueError("the fitted lens doesn't map all of the image")
    return FittedLens(lens, float(apart_px.max()))


def _seen(camera: Camera, points: int) -> tuple[Array, Array]:
    """Ideal coordinates (n, 2) and pixels (n, 2) of a grid over the whole image."""
    u, v = np.linspace(0, camera.width_px - 1, points), np.linspace(0, camera.height_px - 1, points)
    uv_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = camera.undistort(uv_px)
    if not np.isfinite(xy).all():
        raise ValueError("the image's corners see too far to the side for a lens without fisheye")
    return xy, uv_px


def _linear(xy: Array, q: Array, count: int) -> Array:
    """Radial and tangential terms by least squares: k1 k2 p1 p2 [k3 [k4 k5 k6]], the rational ones multiplied out."""
    x, y = xy.T
    r2 = x * x + y * y
    columns = [
        xy * r2[:, None],
        xy * (r2 * r2)[:, None],
        np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1),
        np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1),
        xy * (r2**3)[:, None],
        *(-q * (r2**power)[:, None] for power in (1, 2, 3)),
    ]
    matrix = np.stack([column.ravel() for column in columns[:count]], axis=1)
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    found: Array = np.linalg.lstsq(matrix / scale, (q - xy).ravel(), rcond=1e-12)[0] / scale
    return found


def _ordered(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
