"""Calibrations from images and poses, for programs and notebooks; ``gripmon calibrate`` calls the same functions.

Images are arrays (as OpenCV reads them) or paths.  Wrong input raises an :class:`~gripmon.model.errors.InputError`;
input from which nothing can be calibrated raises a :class:`~gripmon.calibrate.sighting.CalibrationError`.  The text of
both is one line.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from gripmon.calibrate import intrinsics, robot_world
from gripmon.calibrate.bundle import ContradictionError
from gripmon.calibrate.cross_validation import cross_validate, with_scatter
from gripmon.calibrate.detection import detect
from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
from gripmon.calibrate.intrinsics import IntrinsicsResult
from gripmon.calibrate.lens_models import MODELS, ModelName, parameter_names
from gripmon.calibrate.markers import other_dictionary
from gripmon.calibrate.robot_world import RobotWorld
from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
from gripmon.calibrate.single_view import calibrate_single_view
from gripmon.calibrate.verify import verify
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
from gripmon.model.geometry import invert
from gripmon.model.images import images_of_one_camera
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, Chequerboard, Target, TargetError, name_of, parse_target

__all__ = ["CameraFromViews", "calibrate_intrinsics", "calibrate_robot_world", "verify"]

_FOLDS = 5
_TRIED = 3
"""Images without a board that are searched for markers of other dictionaries."""
Wanted = ModelName | Literal["auto"] | None


@dataclass(frozen=True, slots=True)
class CameraFromViews:
    """A camera calibrated from ``sightings`` of the ``target``; ``not_found``: images without it, and why."""

    fit: IntrinsicsResult
    target: Target
    sightings: tuple[Sighting, ...]
    not_found: Mapping[str, str]

    @property
    def camera(self) -> LensSettings:
        """Focal lengths, principal point and lens."""
        return self.fit.camera

    @property
    def sigmas(self) -> dict[str, float | None]:
        """Standard deviations of all parameters by name; None for one that was held or is tied to another."""
        found = dict(zip(self.fit.parameters, self.fit.covariance.diagonal() ** 0.5, strict=True))
        return {name: float(found[name]) if name in found else None for name in self.fit.values}

    @property
    def points(self) -> int:
        """Number of points in all views together."""
        return sum(len(sighting) for sighting in self.sightings)

    @property
    def outliers(self) -> int:
        """Number of points that were left out."""
        return sum(int((~used).sum()) for used in self.fit.used)

    def values(self) -> dict[str, Any]:
        """The result as plain values: px, and the lens's own units."""
        fit, sigmas = self.fit, self.sigmas
        views = zip(self.sightings, fit.used, fit.view_rms_px, strict=True)
        return {
            "model": fit.model,
            "parameters": {name: {"value": value, "sigma": sigmas[name]} for name, value in fit.values.items()},
            "rms_px": fit.rms_px,
            "cross_validated_rms_px": fit.cross_validated_rms_px,
            "criterion": fit.criterion,
            "views": [
                {"image": s.name, "points": len(s), "left_out": int((~used).sum()), "rms_px": rms, "note": s.note}
                for s, used, rms in views
            ],
            "not_found": [{"image": name, "reason": reason} for name, reason in self.not_found.items()],
            "warnings": list(fit.warnings),
        }

    def document(self, provenance: Provenance) -> CameraCalibration:
        """The contents of the calibration's file."""
        return CameraCalibration(
            camera=self.camera,
            parameters=self.fit.parameters,
            covariance=tuple(self.fit.covariance.ravel().tolist()),
            residuals=CameraResiduals(
                rms_px=self.fit.rms_px,
                views=len(self.sightings),
                points=self.points - self.outliers,
                outliers=self.outliers,
                cross_validated_rms_px=self.fit.cross_validated_rms_px,
            ),
            target=name_of(self.target),
            warnings=self.fit.warnings,
            provenance=provenance,
        )


def calibrate_intrinsics(
    images: Sequence[str | Path | Image],
    target: Target | str,
    *,
    model: Wanted = None,
    fixed: Mapping[str, float | None] = MappingProxyType({}),
    progress: Progress = quiet,
) -> CameraFromViews:
    """Calibrate a camera from images of a flat ``target`` (or its description, "chequerboard:9x6:0.025"); each image
    may show only part of it.

    ``model``: the lens model; "auto" picks the one with the smallest information criterion, None means brown_conrady,
    or paper for a single image.  ``fixed``: parameters to hold, at a value or (None) at their start, see
    :func:`gripmon.calibrate.intrinsics.calibrate`.
    """
    target = parse_target(target) if isinstance(target, str) else target
    check_fixed(fixed, model)
    sightings, not_found = _views(images, target, progress)
    found, contradicting = _agreeing(sightings, model, fixed, progress)
    sightings = [sighting for sighting in sightings if sighting.name not in contradicting]
    left_out = [f"{name} is left out: {reason}" for name, reason in contradicting.items()]
    found = replace(found, warnings=(*left_out, *found.warnings, *_about_target(sightings, target)))
    return CameraFromViews(found, target, tuple(sightings), MappingProxyType({**not_found, **contradicting}))


def check_fixed(fixed: Mapping[str, float | None], model: Wanted) -> None:
    """:class:`~gripmon.model.errors.InputError` for parameters that can't be held like this."""
    models = [m for m in MODELS if model in (m, "auto") or (model is None and m != "fisheye")]
    known = list(dict.fromkeys(name for one in models for name in parameter_names(one)))
    for name, value in fixed.items():
        fault = None
        if name not in (*known, "aspect"):
            fault = f"is not a parameter of the model; {', '.join(known)} or aspect"
        elif name == "aspect" and value is not None:
            fault = "takes no value: pixels are square"
        elif value is not None and not math.isfinite(value):
            fault = f"is not a number; {name}=VALUE"
        elif name in ("fx_px", "fy_px") and (value is None or value <= 0.0):
            fault = f"is to be held, but without a value; {name}=VALUE (px), above 0"
        if fault is not None:
            raise InputError(f"{name}: {fault}")
    if "aspect" in fixed and "fy_px" in fixed:
        raise InputError("fy_px: is fx_px with aspect; one of them")


def _views(
    images: Sequence[str | Path | Image], target: Target, progress: Progress
) -> tuple[list[Sighting], dict[str, str]]:
    """The target in all images, and the reason for each image in which it isn't found."""
    sightings: list[Sighting] = []
    not_found: dict[str, str] = {}
    larger: list[str] = []
    smaller: list[str] = []
    with progress(len(images), "image") as step:
        for name, image in images_of_one_camera(images):
            sight = detect(image, target, name)
            if isinstance(sight, NotFound):
                not_found[name] = sight.reason
                larger += [f"{name}: {sight.reason}"] if sight.larger else []
                smaller += [f"{name}: {sight.reason}"] if sight.smaller else []
            else:
                sightings.append(sight)
            step()
    if not sightings:
        (reason, times), *_ = Counter(not_found.values()).most_common(1)
        why = reason if times == len(images) else f"{times} of them: {reason}"
        if isinstance(target, Charuco) and (other := other_dictionary(images_of_one_camera(images[:_TRIED]), target)):
            why = f"markers of {other} are in the images, not of {target.dictionary}"
            raise TargetError(f"{why}; {name_of(msgspec.structs.replace(target, dictionary=other))}")
        count = "the image doesn't show" if len(images) == 1 else f"none of {len(images)} images shows"
        # If all images have the same fault, the one line says enough.
        details = [f"{name}: {why}" for name, why in not_found.items()] if len(set(not_found.values())) > 1 else []
        raise CalibrationError(f"{count} the target ({why})", details)
    if larger:
        # If the rest is hidden or out of view, a smaller target fits as well: such images prove nothing.
        raise TargetError(f"{len(larger)} of {len(images)} images show a larger one ({larger[0]}); its full size")
    if smaller and not any(sighting.anchored for sighting in sightings):
        of = f"{len(smaller)} of {len(images)} images show a smaller one whole, none this one"
        raise TargetError(f"{of} ({smaller[0]}); its full size")
    return sightings, not_found


def _agreeing(
    sightings: list[Sighting], wanted: Wanted, fixed: Mapping[str, float | None], progress: Progress
) -> tuple[IntrinsicsResult, dict[str, str]]:
    """The fit to the views that don't contradict it, more than half of them, and why the others do, by name."""
    left, contradicting = sightings, dict[str, str]()
    while True:
        try:
            return _fitted(left, wanted, fixed, progress), contradicting
        except ContradictionError as error:
            left = [sighting for sighting in left if sighting is not error.sighting]
            contradicting[error.sighting.name] = error.said
            if 2 * len(left) <= len(sightings):
                raise


def _fitted(
    sightings: list[Sighting], wanted: Wanted, fixed: Mapping[str, float | None], progress: Progress
) -> IntrinsicsResult:
    single = len(sightings) == 1
    model: ModelName = "paper" if single else "brown_conrady"
    if wanted is not None and wanted != "auto":
        model = wanted
    if single:
        return calibrate_single_view(sightings[0], model, fixed=fixed)
    steps = (len(MODELS) if wanted == "auto" else 1) + min(_FOLDS, len(sightings)) * (len(sightings) > 3)
    with progress(steps, "fit") as step:
        if wanted == "auto":
            result = intrinsics.calibrate_best(sightings, MODELS, fixed=fixed, step=step)
        else:
            result = intrinsics.calibrate(sightings, model, fixed=fixed)
            step()
        crossed = cross_validate(sightings, result, fixed=fixed, folds=_FOLDS, step=step)
    return with_scatter(result, crossed, sightings)


def _about_target(sightings: list[Sighting], target: Target) -> list[str]:
    """A warning if the target may be smaller than it was described: without markers nothing else reveals that."""
    if isinstance(target, Charuco):
        return []
    if isinstance(target, Chequerboard):
        step_m, whole = target.square_m, [target.columns, target.rows]
    else:
        step_m, whole = target.step_m, [max(each) + 1 for each in zip(*target.places, strict=True)]
    spans = [sorted(np.ptp(s.plate_m[:, :2], axis=0).tolist(), reverse=True) for s in sightings]
    seen = [round(max(span[k] for span in spans) / step_m) + 1 for k in (0, 1)]
    if seen[0] >= max(whole) or len(sightings) == 1:
        return []
    points = f"{seen[0]} x {seen[1]} of the target's {whole[0]} x {whole[1]} points"
    return [f"no image shows more than {points}: is its description right?"]


def calibrate_robot_world(
    base_T_ee: Array,
    cam_T_target: Array,
    covariance: Array | None = None,
    *,
    common: Array | None = None,
    eye_in_hand: bool = False,
) -> RobotWorld:
    """Both unknown transforms of ``cam_T_target = cam_T_base base_T_ee ee_T_target`` from poses (n, 4, 4) each, with
    the ``covariance`` (n, 6, 6) of the targets' poses if known, and ``common`` (n, 6, k): the effect of the camera's
    independent errors, per standard deviation, on all of them.

    ``eye_in_hand``: the camera is on the hand and the target is fixed; the result's ``cam_T_base`` is then
    ``cam_T_ee``, and its ``ee_T_target`` is ``base_T_target``.
    """
    arm = np.stack([invert(T) for T in base_T_ee]) if eye_in_hand else base_T_ee
    start = robot_world.solve(cam_T_target, arm)
    found = robot_world.refine(
        cam_T_target, arm, start, covariance, inexact_arm=True, eye_in_hand=eye_in_hand, common=common
    )
    robot_world.check_reading(found, cam_T_target, arm)
    return found


_MAP_PX = 900
_SIDE_PX = 380
_TOP_PX = 64
_CELLS = 12
_LONGEST_PX = 28.0
"""Length of an arrow for three standard deviations (px)."""
_INK, _PALE, _GOOD, _BAD, _EMPTY = (40, 40, 40), (245, 245, 245), (150, 90, 20), (40, 40, 210), (205, 205, 225)
_SUBPIXEL_BITS = 4
_Colour = tuple[int, int, int]


@dataclass(frozen=True)
class _Frame:
    """Where the image lies in the picture."""

    scale: float
    width: int
    height: int

    def at(self, uv_px: Array) -> Array:
        out: Array = (uv_px + 0.5) * self.scale + np.array([0.0, _TOP_PX])
        return out


def draw_maps(result: IntrinsicsResult, sightings: Sequence[Sighting]) -> Image:
    """Picture of the calibration, BGR.  Image cells without points are tinted; arrows are enlarged residuals, with the
    factor in the title; red ones were left out.  On the right each view's root mean square residual.
    """
    size = (result.camera.width_px, result.camera.height_px)
    scale = _MAP_PX / size[0]
    frame = _Frame(scale, _MAP_PX, round(scale * size[1]))
    picture = np.full((max(frame.height, 240) + _TOP_PX, frame.width + _SIDE_PX, 3), 255, np.uint8)
    _coverage(picture, frame, sightings, size)
    enlarged = _LONGEST_PX / max(3.0 * result.rms_px, 1e-6)
    for sighting, residual, used in zip(sightings, result.residuals_px, result.used, strict=True):
        start = frame.at(sighting.uv_px)
        length = np.linalg.norm(residual, axis=1, keepdims=True) * enlarged
        # Large outliers would cross the whole picture.
        arrow = np.nan_to_num(residual) * enlarged * np.minimum(1.0, 2.0 * _LONGEST_PX / np.maximum(length, 1e-9))
        for a, b, good in zip(start, start + np.nan_to_num(arrow), used.tolist(), strict=True):
            colour = _GOOD if good else _BAD
            line(picture, a, b, colour)
            disc(picture, a, 1.5, colour)
    centre = frame.at(np.array([[result.camera.cx_px, result.camera.cy_px]]))[0]
    at = (round(float(centre[0])), round(float(centre[1])))
    cv2.drawMarker(picture, at, _INK, cv2.MARKER_CROSS, 18, 1, cv2.LINE_AA)
    _bars(picture, frame, result, sightings)
    _titles(picture, frame, result, sightings, enlarged / scale)
    return picture


def _coverage(picture: Image, frame: _Frame, sightings: Sequence[Sighting], size: tuple[int, int]) -> None:
    rows = max(1, round(_CELLS * size[1] / size[0]))
    points = np.concatenate([s.uv_px for s in sightings]) / np.array(size)
    counts, _, _ = np.histogram2d(points[:, 1], points[:, 0], bins=(rows, _CELLS), range=((0, 1), (0, 1)))
    edges_x = np.rint(np.linspace(0, frame.width, _CELLS + 1)).astype(int)
    edges_y = np.rint(np.linspace(0, frame.height, rows + 1)).astype(int) + _TOP_PX
    for r, c in np.ndindex(*counts.shape):
        corners = (int(edges_x[c]), int(edges_y[r])), (int(edges_x[c + 1]) - 1, int(edges_y[r + 1]) - 1)
        cv2.rectangle(picture, *corners, _PALE if counts[r, c] else _EMPTY, -1)
    cv2.rectangle(picture, (0, _TOP_PX), (frame.width - 1, frame.height + _TOP_PX - 1), _INK, 1)


def _bars(picture: Image, frame: _Frame, result: IntrinsicsResult, sightings: Sequence[Sighting]) -> None:
    rms = result.view_rms_px
    left, width = frame.width + 16, _SIDE_PX - 32
    step = min(26.0, (frame.height - 10) / len(rms))
    longest = max(max(rms), 1e-9)
    for k, (value, sighting, used) in enumerate(zip(rms, sightings, result.used, strict=True)):
        top = round(_TOP_PX + k * step)
        high = max(round(step) - 2, 1)
        colour = (225, 200, 170) if used.mean() > 0.5 else (190, 190, 240)
        cv2.rectangle(picture, (left, top), (left + round(width * value / longest), top + high), colour, -1)
        if step >= 13.0:
            text = f"{value:.3f}  {Path(sighting.name).name}"[:44]
            write(picture, text, (left + 4, top + high - 5), 0.4)


def _titles(
    picture: Image, frame: _Frame, result: IntrinsicsResult, sightings: Sequence[Sighting], enlarged: float
) -> None:
    out = sum(int((~u).sum()) for u in result.used)
    total = sum(len(s) for s in sightings)
    lines = (
        f"{result.model}, {len(sightings)} views, {total - out} points, {result.rms_px:.3f} px; {out} left out (red)",
        f"residuals {enlarged:.0f} times enlarged; cross: principal point; tinted: no point seen there",
    )
    for k, text in enumerate(lines):
        write(picture, text, (8, 24 + 24 * k), 0.55)
    write(picture, "rms of each view (px)", (frame.width + 16, 48), 0.55)


def write(image: Image, text: str, at: tuple[int, int], size: float = 0.42) -> None:
    """Write a text that begins at a place (px)."""
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def line(image: Image, start: Array, end: Array, colour: _Colour, width: int = 1) -> None:
    """Draw a line between two places (2,), px."""
    first, last = (np.rint(point * 2**_SUBPIXEL_BITS).astype(int).tolist() for point in (start, end))
    cv2.line(image, first, last, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def disc(image: Image, at: Array, radius: float, colour: _Colour) -> None:
    """Draw a filled disc at a place (2,), px."""
    x, y = (round(v * 2**_SUBPIXEL_BITS) for v in at.tolist())
    cv2.circle(image, (x, y), round(radius * 2**_SUBPIXEL_BITS), colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
