"""Cameras in the formats of others, by the format's name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gripmon.calibrate.interchange import kalibr, mrcal, opencv_storage, ros_camera_info
from gripmon.calibrate.interchange.fault import InterchangeError
from gripmon.calibrate.interchange.fitting import fit_brown_conrady
from gripmon.model.camera import LensSettings

FORMATS = ("ros", "kalibr", "opencv", "mrcal")
LARGEST_FIT_PX = 1.0
"""A fit that is farther off than this is no calibration."""
_BROWN_COUNTS = {"ros": (4, 5, 8, 12), "kalibr": (4,), "opencv": (4, 5, 8, 12), "mrcal": (4, 5, 8, 12)}
_FITTED_COUNTS = {"ros": (5, 8), "kalibr": (4,), "opencv": (5, 8), "mrcal": (5, 8)}
_FISHEYE = ("ros", "kalibr", "opencv")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a file may leave open: which of several cameras, the image's size, and whether the lens is a fisheye."""

    which: str | None = None
    size_px: tuple[int, int] | None = None
    fisheye: bool | None = None


@dataclass(frozen=True, slots=True)
class Exported:
    """A file's bytes, and what had to be said about them."""

    data: bytes
    warnings: tuple[str, ...] = ()


def format_of(data: bytes, file: str) -> str:
    """The format that a file is in, by its content; its name tells OpenCV's JSON from nothing else."""
    head = data[:65536].lstrip(b"\xef\xbb\xbf \t\r\n")
    text = head.decode(errors="replace")
    if b"LENSMODEL_" in data:
        return "mrcal"
    if text.startswith(("%YAML:", "<?xml", "<opencv_storage")) or "opencv-matrix" in text:
        return "opencv"
    if "distortion_coeffs" in text and "camera_model" in text:
        return "kalibr"
    if "image_width" in text and "camera_matrix" in text:
        return "opencv" if Path(file).suffix == ".json" else "ros"
    raise InterchangeError(file, "", "is in no format that is recognised", f"--format {' or '.join(FORMATS)}")


def read_camera(data: bytes, file: str, kind: str, options: ReadOptions = ReadOptions()) -> LensSettings:
    """The camera in a file's bytes.  :class:`InterchangeError` for one that isn't there, or that no monitor can use,
    and for options that this format has no use for.
    """
    given = {"--camera": options.which, "--size": options.size_px, "--fisheye": options.fisheye}
    useful = {"kalibr": {"--camera"}, "opencv": {"--size", "--fisheye"}}.get(kind, set())
    for option, value in given.items():
        if value is not None and option not in useful:
            raise InterchangeError(file, "", f"{option} has no meaning for a {kind} file", "leave it out")
    if kind == "kalibr":
        return kalibr.read(data, file, options.which)
    if kind == "opencv":
        return opencv_storage.read(data, file, options.size_px, options.fisheye)
    return mrcal.read(data, file) if kind == "mrcal" else ros_camera_info.read(data, file)


def write_camera(
    camera: LensSettings, kind: str, notes: Sequence[str], *, name: str, file: str, suffix: str = "", fit: bool = False
) -> Exported:
    """A file's bytes.  ``notes`` become comments, ``name`` is the camera's; ``file`` is where it comes from, for
    messages; ``suffix`` of the file to write chooses OpenCV's syntax, YAML unless it is .xml or .json.

    A lens that the format hasn't is refused with :class:`InterchangeError`, or with ``fit`` written as the nearest one
    that it has, and how far off that is anywhere in the image is said.
    """
    warnings: list[str] = []
    if not _has(kind, camera):
        camera, said = _nearest(camera, kind, file, fit)
        warnings.append(said)
    if kind == "ros" and len(getattr(camera, "coefficients", ())) == 12:
        warnings.append("rational_polynomial with 12 coefficients: OpenCV takes them, ROS's own text speaks of 8")
    notes = [" ".join(note.split()) for note in (*notes, *warnings)]
    if kind == "opencv":
        syntax = suffix.lower() if suffix.lower() in opencv_storage.SYNTAXES else ".yaml"
        data = opencv_storage.write(camera, notes, name, syntax)
    else:
        writer = {"ros": ros_camera_info.write, "kalibr": kalibr.write, "mrcal": mrcal.write}[kind]
        data = writer(camera, notes, name)
    return Exported(data, tuple(warnings))


def _has(kind: str, camera: LensSettings) -> bool:
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
