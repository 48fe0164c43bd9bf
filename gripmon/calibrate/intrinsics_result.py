"""A calibrated camera, and what of it the views can't support: in words, for a person."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.bundle import DEGENERATE, Bundle
from gripmon.calibrate.lens_models import LensModel, ModelName, parameter_names
from gripmon.calibrate.plate_pose import lens_vector
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import LensSettings
from gripmon.model.records import Array

DOUBTFUL_FOCAL = 0.01
"""Relative standard deviation of the focal length from which a warning names it; and the one from which there is no
calibration."""
USELESS_FOCAL = 0.2
COVERED = 0.6
"""Part of the image's half diagonal that points should reach: beyond them the lens is extrapolated."""
LARGE_RMS_SHARE = 0.0007
"""Root mean square residual over the image's width from which a warning calls it large; and the one from which no
camera of the model fits at all."""
LARGEST_RMS_SHARE = 0.003


@dataclass(frozen=True, slots=True)
class IntrinsicsResult:
    """A calibrated camera.

    ``covariance`` (p, p) of the p ``parameters``, keys of ``camera``; the rest was held fixed.  One a view:
    ``cam_T_plate`` (4, 4) and ``pose_covariance`` (6, 6) (position then rotation, camera axes), ``residuals_px`` (n, 2)
    and ``used`` (n,).  ``criterion``: Bayes' information criterion of each model that was tried, the smallest is best.
    """

    model: ModelName
    camera: LensSettings
    parameters: tuple[str, ...]
    covariance: Array
    cam_T_plate: tuple[Array, ...]
    pose_covariance: tuple[Array, ...]
    residuals_px: tuple[Array, ...]
    used: tuple[NDArray[np.bool_], ...]
    rms_px: float
    warnings: tuple[str, ...] = ()
    criterion: dict[str, float] | None = None
    cross_validated_rms_px: float | None = None

    @property
    def view_rms_px(self) -> tuple[float, ...]:
        """Root mean square of each view's residuals that were used, u and v each."""
        return tuple(
            float(np.sqrt(np.mean(np.square(r[u])))) if u.any() else math.inf
            for r, u in zip(self.residuals_px, self.used, strict=True)
        )

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name, those that were held, too."""
        return dict(zip(parameter_names(self.model), lens_vector(self.camera).tolist(), strict=True))


def check_fit(lens_model: LensModel, bundle: Bundle, free: Array) -> None:
    """Refuse what is no calibration: :class:`CalibrationError`."""
    if bundle.rms_px > LARGEST_RMS_SHARE * lens_model.width_px:
        raise CalibrationError(
            f"no {lens_model.name} camera explains the views: residuals of {bundle.rms_px:.3g} px are left; images of "
            "one camera and focus, the target as it was described, or another model"
        )
    moves_focal = np.flatnonzero(free[0])
    if len(moves_focal):
        share = math.sqrt(bundle.covariance[moves_focal[0], moves_focal[0]]) / bundle.parameters[0]
        if share > USELESS_FOCAL:
            raise CalibrationError(DEGENERATE)


def doubts_of(result: IntrinsicsResult, sightings: Sequence[Sighting]) -> tuple[str, ...]:
    """What the views can't support; one line each."""
    return (*_parameters(result), *_views(result, sightings))


def _parameters(result: IntrinsicsResult) -> list[str]:
    out = []
    values = result.values
    sigma = dict(zip(result.parameters, np.sqrt(result.covariance.diagonal()).tolist(), strict=True))
    focal = sigma.get("fx_px", 0.0)
    if focal > DOUBTFUL_FOCAL * result.camera.fx_px:
        out.append(
            f"the focal length is uncertain by {100.0 * focal / result.camera.fx_px:.1f} %: views tilted by 20 to 45 "
            "degrees to different sides determine it"
        )
    lens = [n for n in result.parameters if n.startswith(("coefficients", "kappa"))]
    untold = [n for n in lens if abs(values[n]) < 2.0 * sigma[n]]
    return out + [
        f"{n} is not told from 0 ({values[n]:.3g} ± {sigma[n]:.2g}): a model with fewer parameters" for n in untold
    ]


def _views(result: IntrinsicsResult, sightings: Sequence[Sighting]) -> list[str]:
    out = []
    half_px = 0.5 * np.array([result.camera.width_px, result.camera.height_px])
    reach = max(float(np.linalg.norm(s.uv_px - half_px, axis=1).max()) for s in sightings)
    if reach < COVERED * float(np.linalg.norm(half_px)):
        out.append(
            f"no point lies farther than {100.0 * reach / float(np.linalg.norm(half_px)):.0f} % of the way from the "
            "image's centre to its corners: beyond, the lens is extrapolated"
        )
    lost = sum(int((~u).sum()) for u in result.used)
    total = sum(len(u) for u in result.used)
    if lost > 0.1 * total:
        out.append(f"{lost} of {total} points don't fit and were left out: is the target flat, and described rightly?")
    if result.rms_px > LARGE_RMS_SHARE * result.camera.width_px:
        out.append(
            f"residuals of {result.rms_px:.2g} px are large: is the target flat, the focus fixed, the model right?"
        )
    rms = result.view_rms_px
    for sighting, value in zip(sightings, rms, strict=True):
        if value > 3.0 * float(np.median(rms)) and value > 0.1:
            out.append(f"{sighting.name} fits badly: {value:.2g} px, the others {float(np.median(rms)):.2g} px")
    return out
