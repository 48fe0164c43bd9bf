"""Which motions of the camera fresh spots would show, before there are any."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.check import LEAST_SPOTS, CheckSettings
from gripmon.laser.documents import Calibrated
from gripmon.laser.explanations import KINDS, SCALES, assumed_motion, foresee
from gripmon.laser.planning import SEED, candidates
from gripmon.laser.setup import CAMERA, spots_on_plane, spots_on_rays
from gripmon.model.records import Array

SPOTS = (LEAST_SPOTS, 10, 30, 100)
_UNIT = np.array([0.01] * 6)
"""Metres and radians that are weighted alike: at half a metre, 10 mrad move a point by 5 mm."""


class SpotSigma(msgspec.Struct, frozen=True):
    """Least and largest standard deviation of a predicted spot in its worst direction, image and plane."""

    px: tuple[float, float]
    m: tuple[float, float]


class Noticed(msgspec.Struct, frozen=True):
    """Motions of ``base_T_cam`` (base axes) that this many spots show on average."""

    spots: int
    position_m: tuple[float, ...]
    rotation_rad: tuple[float, ...]


class Forecast(msgspec.Struct, frozen=True):
    """``noticed``: by the number of spots, along and about each axis by itself; ``weakest``: the direction that shows
    the least, with its size for the most spots.
    """

    spot_sigma: SpotSigma
    noticed: tuple[Noticed, ...]
    weakest: Noticed


def forecast(known: Calibrated, settings: CheckSettings) -> Forecast:
    """The forecast for spots at random poses.  :class:`CalibrationError` if the camera hardly sees a spot of them."""
    poses = candidates(known.setup, known.camera, math.inf, np.random.default_rng(SEED))[: max(SPOTS)]
    if len(poses) < max(SPOTS):
        raise CalibrationError("the camera hardly sees the plane; a file of a camera that looks at it")
    foreseen = foresee(known, poses, settings.arm_covariance)
    noise = foreseen.by_arm + known.sigma_px**2 * np.eye(2)
    values, axes = np.linalg.eigh(foreseen.by_calibration + noise)
    sigma_px = np.sqrt(values[:, -1])
    beside = spots_on_rays(known.setup, known.camera.undistort(foreseen.uv_px + axes[:, :, -1]))
    sigma_m = sigma_px * np.linalg.norm(beside - spots_on_plane(known.setup, poses), axis=1)
    gains = [_Gain(known, foreseen.rows[:count], noise[:count], settings) for count in SPOTS]
    noticed = []
    for count, gain in zip(SPOTS, gains, strict=True):
        sizes = tuple(gain.size(axis) for axis in np.eye(6))
        noticed.append(Noticed(count, sizes[:3], sizes[3:]))
    _, directions = np.linalg.eigh(gains[-1].information * np.outer(_UNIT, _UNIT))
    weakest = directions[:, 0] * _UNIT
    weakest = weakest * gains[-1].size(weakest)
    low_px, high_px, low_m, high_m = (float(end(each)) for each in (sigma_px, sigma_m) for end in (np.min, np.max))
    return Forecast(
        SpotSigma((low_px, high_px), (low_m, high_m)),
        tuple(noticed),
        Noticed(SPOTS[-1], tuple(weakest[:3].tolist()), tuple(weakest[3:].tolist())),
    )


class _Gain:
    """What spots say on average about a motion of the camera.

    Their residuals r are normal with covariance V (noise, calibration) if nothing moved, and with V + M after a motion
    of an assumed size: the log likelihood ratio is (rᵀ (V⁻¹ - (V+M)⁻¹) r - ln|V+M| + ln|V|) / 2.
    """

    def __init__(self, known: Calibrated, rows: Array, noise: Array, settings: CheckSettings):
        count = len(rows)
        needed = -math.log(settings.false_alarm_chance(count)) - math.log(KINDS[0][2] / len(SCALES))
        stacked = rows.reshape(2 * count, -1)
        still = stacked @ known.covariance @ stacked.T
        for k in range(count):
            still[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noise[k]
        inverse, moved = np.linalg.inv(still), stacked[:, CAMERA]
        self._terms = []
        for scale in range(len(SCALES)):
            total = still + moved @ assumed_motion(0, scale)[CAMERA, CAMERA] @ moved.T
            difference = inverse - np.linalg.inv(total)
            grown = float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(still)[1])
            missing = 2.0 * needed + grown - float((difference * still).sum())
            self._terms.append((max(missing, 0.0), moved.T @ difference @ moved))
        self.information = moved.T @ inverse @ moved

    def size(self, direction: Array) -> float:
        """The factor by which a direction (6,) must be scaled for the motion to show."""
        return min(math.sqrt(missing / max(float(direction @ w @ direction), 1e-300)) for missing, w in self._terms)
