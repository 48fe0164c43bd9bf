"""Laser-pointer calibration and its check, for programs and notebooks; the command line calls the same functions.

Wrong input raises an :class:`~gripmon.model.errors.InputError`; samples from which nothing can be calibrated raise a
:class:`~gripmon.calibrate.sighting.CalibrationError`.  The text of both is one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.api import disc, line, write
from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.sighting import CalibrationError, NotFound
from gripmon.laser.calibrating import LaserResult, Spots, calibrate, document, groups_of
from gripmon.laser.judgement import SpotJudgement, SpotSeen, SpotWatchSettings
from gripmon.laser.planar_start import SEED
from gripmon.laser.planning import Plan, plan
from gripmon.laser.refinement import PoseNoise
from gripmon.laser.samples import Samples, read_samples, spots_of
from gripmon.laser.setup import LaserCalibration, laser_lines, spots_on_plane
from gripmon.laser.spots import Spot
from gripmon.laser.watch import SpotWatch
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.errors import InputError, input_errors
from gripmon.model.geometry import invert
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Alert, Array, Image

__all__ = [
    "SEED",
    "CalibratedLaser",
    "LaserCheck",
    "PoseNoise",
    "Samples",
    "SpotWatchSettings",
    "calibrate_laser",
    "check_laser",
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
        return invert(self.fit.refined.setup.cam_T_base)

    def plan(self, reach_m: float, poses: int = 10) -> Plan:
        """The next poses that improve the calibration the most, for an arm with this reach."""
        return plan(self.fit.refined, reach_m, poses)

    def document(self, provenance: Provenance) -> LaserCalibration:
        """The contents of the calibration's file."""
        names = self.samples.names
        other = [name for name, k in zip(names, self.fit.candidate, strict=True) if k > 0]
        notes = [*self.unseen, *self.notes]
        if other:
            notes.append(f"not the brightest place but another one is the spot in: {', '.join(other)}")
        orientations = len(groups_of(self.samples.groups, self.samples.base_T_ee))
        return document(self.fit.refined, names, orientations, (*notes, *self.fit.warnings), provenance)

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


@dataclass(frozen=True, slots=True)
class LaserCheck:
    """Whether a laser calibration still holds: ``verdict`` is "same", "moved", or "unclear" if at most half of the
    spots are inliers; ``text`` gives the result in words.  ``judged``: each sample's name and judgement.
    """

    verdict: str
    text: str
    alert: Alert | None
    judged: tuple[tuple[str, SpotJudgement], ...]

    @property
    def last(self) -> SpotJudgement:
        """The judgement after all spots."""
        return self.judged[-1][1]


def check_laser(
    calibration: LaserCalibration,
    samples: Samples | Sequence[Path],
    settings: SpotWatchSettings | None = None,
    progress: Progress = quiet,
) -> LaserCheck:
    """Judge new spots one after the other."""
    samples = samples if isinstance(samples, Samples) else read_samples(samples)
    watch = SpotWatch(calibration, settings or SpotWatchSettings())
    found = spots_of(samples, (calibration.camera.width_px, calibration.camera.height_px), progress)
    judged = tuple(
        (name, watch.judge(SpotSeen(k, pose, spots)))
        for k, (name, pose, spots) in enumerate(zip(samples.names, samples.base_T_ee, found, strict=True))
    )
    alert = watch.motion_alert  # from all spots: the alert that was raised knew only the first few
    believed, count = sum(one.used for _, one in judged), len(judged)
    if alert is not None:
        return LaserCheck("moved", alert.text, alert, judged)
    if 2 * believed <= count:
        text = f"only {believed} of {count} spots can be believed, too few or too different to tell a motion by"
        return LaserCheck("unclear", text, None, judged)
    return LaserCheck("same", f"{believed} of {count} spots are where the calibration has them", None, judged)


_WIDTH, _HEIGHT, _MARGIN = 800, 640, 50
_PAPER, _INK, _FAINT = (255, 255, 255), (40, 40, 40), (205, 205, 205)
_GOOD, _WRONG, _PLANE, _BEAM = (170, 110, 20), (40, 40, 220), (120, 180, 90), (90, 90, 235)
_SUBPIXEL_BITS = 4


def draw(result: LaserResult, base_T_ee: Array) -> Image:
    """Residuals on the left (as enlarged arrows), the scene on the right; BGR."""
    return np.concatenate([_residuals(result), _scene(result, base_T_ee)], axis=1)


def _canvas(title: str) -> NDArray[np.uint8]:
    out = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    write(out, title, (_MARGIN, 30), 0.55)
    return out


def _residuals(result: LaserResult) -> Image:
    refined = result.refined
    used = refined.used
    largest = max(float(np.linalg.norm(refined.residuals_px[used], axis=1).max()), 1e-9)
    camera = refined.camera
    most = 0.06 * camera.width_px / largest
    stretch = max(step * 10.0 ** np.floor(np.log10(most / step)) for step in (1.0, 2.0, 5.0))
    image = _canvas(f"residuals x {stretch:g}: RMS {refined.rms_px:.3f} px, {used.sum()} of {len(used)} spots used")
    scale = min((_WIDTH - 2 * _MARGIN) / camera.width_px, (_HEIGHT - 2 * _MARGIN - 20) / camera.height_px)

    def place(uv: Array) -> Array:
        return np.array([_MARGIN, _MARGIN]) + scale * (uv + 0.5)

    corners = place(np.array([[-0.5, -0.5], [camera.width_px - 0.5, camera.height_px - 0.5]]))
    (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
    cv2.rectangle(image, (left, top), (right, bottom), _FAINT, 1)
    for uv, residual, good in zip(result.uv_px, refined.residuals_px, used, strict=True):
        at = place(uv)
        if good:
            line(image, at, place(uv + stretch * residual), _GOOD)
            disc(image, at, 2.5, _GOOD)
            continue
        for turn in (1.0, -1.0):
            line(image, at - 4.0 * np.array([1.0, turn]), at + 4.0 * np.array([1.0, turn]), _WRONG)
    write(image, f"{camera.width_px} x {camera.height_px} px; crosses: left out", (_MARGIN, _HEIGHT - 14))
    return image


def _scene(result: LaserResult, base_T_ee: Array) -> Image:
    """The base frame from a corner, in parallel projection."""
    setup = result.refined.setup
    base_T_cam = invert(setup.cam_T_base)
    to_base = base_T_cam[:3, :3]
    spots = spots_on_plane(setup, base_T_ee)[0] @ to_base.T + base_T_cam[:3, 3]
    origins = laser_lines(setup, base_T_ee)[0] @ to_base.T + base_T_cam[:3, 3]
    camera, sheet = base_T_cam[:3, 3], _sheet(result, to_base, base_T_cam[:3, 3])
    everything = np.concatenate([spots, origins, camera[None], sheet, np.zeros((1, 3))])
    view = np.array([[-0.64, 0.77, 0.0], [0.35, 0.29, -0.89]])
    flat = everything @ view.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = float(((np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN - 20) / np.maximum(high - low, 1e-9)).min())

    def place(points: Array) -> Array:
        return (points @ view.T - low) * scale + np.array([_MARGIN, _MARGIN + 10])

    image = _canvas("scene in the base frame: camera, plane, beams")
    fill = np.rint(place(sheet) * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.polylines(image, [fill], True, _PLANE, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
    for spot, origin, good in zip(spots, origins, result.refined.used, strict=True):
        if np.isfinite(spot).all():
            line(image, place(origin), place(spot), _BEAM if good else _FAINT)
            disc(image, place(spot), 2.5, _GOOD if good else _WRONG)
    for name, at, axes in (("base", np.zeros(3), np.eye(3)), ("camera", camera, to_base)):
        for axis, colour in zip(axes.T, ((40, 40, 220), (60, 160, 60), (220, 90, 40)), strict=True):
            line(image, place(at), place(at + 0.08 * float(np.ptp(everything, axis=0).max()) * axis), colour, 2)
        x, y = (round(v) for v in place(at).tolist())
        write(image, name, (x + 6, y - 6))
    return image


def _sheet(result: LaserResult, to_base: Array, centre: Array) -> Array:
    """Corners (up to 4, 3) of the image on the plane, base frame, without those whose rays miss the plane."""
    camera, setup = result.refined.camera, result.refined.setup
    width, height = camera.width_px, camera.height_px
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    rays = np.concatenate([(corners - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px], np.ones((4, 1))], 1)
    depth = setup.distance_m / (rays @ setup.normal_cam)
    rays, depth = rays[depth > 0.0], depth[depth > 0.0]
    return (rays * np.minimum(depth, 5.0 * setup.distance_m)[:, None]) @ to_base.T + centre
