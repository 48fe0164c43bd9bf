"""What a calibration is worth on views that had no part in it, and whether its parts agree as its errors say."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from scipy.special import chdtri

from gripmon.calibrate.bundle import BundleProblem
from gripmon.calibrate.intrinsics import Fixed, IntrinsicsResult, calibrate, doubts_of
from gripmon.calibrate.lens_models import PINHOLE, LensModel, lens_vector
from gripmon.calibrate.plate_pose import plate_pose_start
from gripmon.calibrate.sighting import CalibrationError
from gripmon.calibrate.target_shape import CHANCE, FEWEST_VIEWS


def cross_validate(
    whole: IntrinsicsResult,
    *,
    fixed: Fixed = MappingProxyType({}),
    folds: int = 5,
    step: Callable[[], None] = lambda: None,
) -> CrossValidation:
    """Views that are left out of the calibration, a part of all at a time, with only their own pose fitted; without an
    answer for fewer than four views.  ``whole``: the calibration from all of them, with the same values ``fixed``.
    """
    sightings = whole.sightings
    folds = min(folds, len(sightings))
    squares, count = 0.0, 0
    cameras: list[IntrinsicsResult] = []
    if len(sightings) < 4:
        return CrossValidation()
    for fold in range(folds):
        others = [s for k, s in enumerate(sightings) if k % folds != fold]
        try:
            exact = whole.target is None
            camera = calibrate(others, whole.model, fixed=fixed, near=whole.camera, exact_target=exact)
        except CalibrationError:
            step()
            continue
        cameras.append(camera)
        lens_model, parameters = LensModel(whole.model, *sightings[0].size_px), lens_vector(camera.camera)
        for sighting in camera.where_they_are(sightings)[fold::folds]:
            pose = plate_pose_start(lens_model, parameters, sighting)
            bundle = BundleProblem(lens_model, [sighting], np.zeros((len(parameters), 0))).solve(parameters, [pose])
            residuals = bundle.residuals_px[0][bundle.used[0]]
            squares, count = squares + float(np.square(residuals).sum()), count + residuals.size
        step()
    return CrossValidation(math.sqrt(squares / count) if count else None, _scatter(whole, cameras))


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """``rms_px``: root mean square residual of views that had no part in the fit (None: not known); ``scatter``: by how
    much the fits without some of the views scatter more than their covariance says, by parameter, in standard
    deviations over the stated ones; only what is more than chance.
    """

    rms_px: float | None = None
    scatter: Mapping[str, float] = field(default_factory=dict)


def _scatter(whole: IntrinsicsResult, without: Sequence[IntrinsicsResult]) -> dict[str, float]:
    """By the jackknife with groups of views left out (Shao and Wu, "A general theory for jackknife variance
    estimation", 1989), of the pinhole's parameters.
    """
    g = len(without)
    if g < FEWEST_VIEWS or any(each.parameters != whole.parameters for each in without):
        return {}
    tried = [name for name in PINHOLE if name in whole.parameters]
    stated = whole.covariance.diagonal()
    limit = float(chdtri(g - 1, CHANCE / max(len(tried), 1))) / (g - 1)
    ratios = {
        name: (g - 1) ** 2 / g * float(np.var([each.values[name] for each in without], ddof=1)) / float(stated[k])
        for k, name in enumerate(whole.parameters)
        if name in tried
    }
    return {name: math.sqrt(ratio) for name, ratio in ratios.items() if ratio > limit}


def with_scatter(result: IntrinsicsResult, found: CrossValidation) -> IntrinsicsResult:
    """The result with what its cross-validation shows: where parts of the views differ more than their errors allow, a
    covariance that covers it, and a warning.
    """
    result = replace(result, cross_validated_rms_px=found.rms_px)
    if not found.scatter:
        return result
    name, times = max(found.scatter.items(), key=lambda each: each[1])
    wrong = (
        f"fits without some of the views differ more than their errors allow ({name} {times:.1f} times): all ± are "
        "enlarged to cover it; more views, tilted to all sides, of a flat target"
    )
    doubts = doubts_of(result)
    result = replace(
        result, covariance=times**2 * result.covariance, warnings=tuple(w for w in result.warnings if w not in doubts)
    )
    return replace(result, warnings=(*result.warnings, wrong, *doubts_of(result)))
