"""Laser-pointer calibration and its check, for programs and notebooks; the command line calls the same functions.

Wrong input raises an :class:`~gripmon.model.errors.InputError`; samples from which nothing can be calibrated raise a
:class:`~gripmon.calibrate.sighting.CalibrationError`.  The text of both is one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.sighting import CalibrationError, NotFound
from gripmon.laser.calibrating import LaserResult, Spots, calibrate, groups_of
from gripmon.laser.check import CheckSettings, LaserCheck, Sample, check_spots
from gripmon.laser.documents import LaserCalibration, LaserResiduals, calibrated, laser_document
from gripmon.laser.forecast import Forecast, forecast
from gripmon.laser.picture import draw
from gripmon.laser.plane_search import SEED
from gripmon.laser.planning import Plan, plan
from gripmon.laser.refinement import PoseNoise
from gripmon.laser.samples import Samples, read_samples, spots_of
from gripmon.laser.spots import Spot
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.errors import InputError, input_errors
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image

__all__ = [
    "SEED",
    "CalibratedLaser",
    "CheckSettings",
    "LaserCheck",
    "PoseNoise",
    "Samples",
    "calibrate_laser",
    "check_laser",
    "forecast_laser",
    "read_samples",
]


@dataclass(frozen=True, slots=True)
class CalibratedLaser:
    """A laser calibration: ``fit`` of the ``samples`` that have a spot; ``files``: the images that were read;
    ``unseen``: samples without a spot, each with the reason; ``notes``: further remarks.
    """

    fit: LaserResult
    samples: Samples
    files: tuple[Path, ...]
    unseen: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def base_T_cam(self) -> Array:
        """(4, 4)."""
        return self.fit.refined.setup.base_T_cam

    def plan(self, reach_m: float, poses: int = 10) -> Plan:
        """The next poses that improve the calibration the most, for an arm with this reach."""
        return plan(self.fit.refined, reach_m, poses)

    def document(self, provenance: Provenance) -> LaserCalibration:
        """The contents of the calibration's file."""
        names, refined = self.samples.names, self.fit.refined
        other = [name for name, k in zip(names, self.fit.candidate, strict=True) if k > 0]
        notes = [*self.unseen, *self.notes]
        if other:
            notes.append(f"not the brightest place but another one is the spot in: {', '.join(other)}")
        residuals = LaserResiduals(
            rms_px=refined.rms_px,
            sigma_px=refined.scale_px,
            spots=len(names),
            used=int(refined.used.sum()),
            orientations=len(groups_of(self.samples.groups, self.samples.base_T_ee)),
            degrees_of_freedom=refined.degrees_of_freedom,
            outliers=tuple(name for name, used in zip(names, refined.used, strict=True) if not used),
        )
        warnings = (*notes, *self.fit.warnings)
        return laser_document(refined.setup, refined.covariance, refined.camera, residuals, warnings, provenance)

    def picture(self) -> Image:
        """Picture of the spots with their residuals, and the scene from the side; BGR."""
        return draw(self.fit, self.samples.base_T_ee)


def calibrate_laser(
    samples: Samples | Sequence[Path],
    camera: CameraCalibration | LensSettings,
    *,
    refine_lens: bool = False,
    arm_noise: PoseNoise | None = None,
    progress: Progress = quiet,
) -> CalibratedLaser:
    """Calibrate a fixed camera, a plane in its view and a laser pointer on an arm, from spots on the plane and the
    arm's poses (``samples``, or tables with them).

    ``refine_lens``: also estimate the lens, within its calibration's covariance; otherwise the lens is kept, and its
    covariance is added to the result's.  ``arm_noise``: standard deviations of the poses that the arm reports.
    """
    samples = samples if isinstance(samples, Samples) else read_samples(samples)
    calibrated = camera.camera if isinstance(camera, CameraCalibration) else camera
    with input_errors("camera"):
        made = make_camera(calibrated)
    prior = _prior(camera) if isinstance(camera, CameraCalibration) else None
    if prior is None and refine_lens:
        raise InputError(
            "--refine-lens: the camera has no covariance of parameters that can be refined; a file of gripmon "
            "calibrate intrinsics"
        )
    found = spots_of(samples, (calibrated.width_px, calibrated.height_px), progress)
    named = zip(samples.names, found, strict=True)
    unseen = [f"{name}: {spots.reason}" for name, spots in named if isinstance(spots, NotFound)]
    kept = [k for k, spots in enumerate(found) if not isinstance(spots, NotFound)]
    if not kept:
        raise CalibrationError(f"none of {len(samples)} images shows a spot", unseen)
    seen = samples.picked(kept)
    fit = calibrate(
        made,
        seen.base_T_ee,
        _spots([spots for spots in found if not isinstance(spots, NotFound)], looked=bool(samples.files)),
        seen.groups,
        lens=prior,
        refine_lens=refine_lens,
        pose_noise=arm_noise,
    )
    notes = () if prior is not None else ("nothing is known of the camera's errors: it counts as exact",)
    return CalibratedLaser(fit, seen, tuple(samples.files), tuple(unseen), notes)


def _spots(found: Sequence[Sequence[Spot]], *, looked: bool) -> Spots:
    """Spots with their covariances.  ``looked``: some were found in images and have their own covariance; the others
    then count with a standard deviation of one pixel.
    """
    uv_px = np.array([spots[0].uv_px for spots in found])
    if not looked:
        return Spots(uv_px)
    covariances = [spots[0].covariance_px if spots[0].area_px else np.eye(2) for spots in found]
    others = tuple(np.array([spot.uv_px for spot in spots[1:]]).reshape(-1, 2) for spots in found)
    return Spots(uv_px, np.array(covariances), others)


def _prior(calibration: CameraCalibration) -> GivenCamera | None:
    """The prior that a camera's calibration gives for its lens; None if it has no covariance."""
    given = GivenCamera.calibrated(calibration)
    try:
        return given if given.free.size else None
    except CalibrationError:
        return None


def check_laser(
    calibration: LaserCalibration,
    samples: Samples | Sequence[Path],
    settings: CheckSettings | None = None,
    progress: Progress = quiet,
) -> LaserCheck:
    """Compare fresh spots with a calibration: does it still hold, and if not, which of camera, plane and pointer moved?

    Raises :class:`CalibrationError` for a calibration whose numbers make no set-up.
    """
    known = calibrated(calibration)
    samples = samples if isinstance(samples, Samples) else read_samples(samples)
    found = spots_of(samples, (calibration.camera.width_px, calibration.camera.height_px), progress)
    fresh = [Sample(*each) for each in zip(samples.names, samples.base_T_ee, found, strict=True)]
    return check_spots(known, fresh, settings or CheckSettings())


def forecast_laser(calibration: LaserCalibration, settings: CheckSettings | None = None) -> Forecast:
    """Which motions of the camera fresh spots would show.  Raises :class:`CalibrationError` as :func:`check_laser`."""
    return forecast(calibrated(calibration), settings or CheckSettings())
