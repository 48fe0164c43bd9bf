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
from gripmon.model.targets import Charuco, Target, TargetError, name_of, parse_target

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
    not_found: Mapping[str, str]

    @property
    def sightings(self) -> tuple[Sighting, ...]:
        """The images that the fit is to."""
        return self.fit.sightings

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
    left_out = [f"{name} is left out: {reason}" for name, reason in contradicting.items()]
    found = replace(found, warnings=(*left_out, *found.warnings, *_about_target(found.sightings, target)))
    return CameraFromViews(found, target, MappingProxyType({**not_found, **contradicting}))


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
    smaller: list[tuple[str, tuple[int, int]]] = []
    with progress(len(images), "image") as step:
        for name, image in images_of_one_camera(images):
            sight = detect(image, target, name)
            if isinstance(sight, NotFound):
                not_found[name] = sight.reason
                larger += [f"{name}: {sight.reason}"] if sight.larger else []
                smaller += [(f"{name}: {sight.reason}", sight.whole)] if sight.whole else []
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
    # A smaller one beside the target, or a misjudged end, is left out where other images show more than it has.
    spans = [_points_along(sighting, target) for sighting in sightings]
    small = [(said, whole) for said, whole in smaller if all(a <= whole[0] and b <= whole[1] for a, b in spans)]
    if small:
        of = f"{len(small)} of {len(images)} images show a smaller one whole, none shows more"
        raise TargetError(f"{of} ({small[0][0]}); its full size")
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
        crossed = cross_validate(result, fixed=fixed, folds=_FOLDS, step=step)
    return with_scatter(result, crossed)


def _points_along(sighting: Sighting, target: Target) -> tuple[int, int]:
    """How many points a sighting spans along both sides, the longer first."""
    steps = np.rint(np.ptp(sighting.plate_m[:, :2], axis=0) / target.step_m)
    short, long = sorted(int(each) + 1 for each in steps)
    return long, short


def _about_target(sightings: Sequence[Sighting], target: Target) -> list[str]:
    """A warning if the target may be smaller than it was described: without markers nothing else reveals that."""
    if isinstance(target, Charuco):
        return []
    whole = [last + 1 for last in target.last]
    seen = [max(each) for each in zip(*(_points_along(s, target) for s in sightings), strict=True)]
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
    return replace(found, warnings=robot_world.check_reading(found, cam_T_target, arm))
