"""Fresh spots of a laser on an arm whose truth is known, and a calibration of it from noisy spots."""

from __future__ import annotations

import functools

import numpy as np

from gripmon.laser.api import Samples, calibrate_laser
from gripmon.laser.documents import Calibrated, LaserCalibration, calibrated
from gripmon.laser.setup import LaserSetup, in_camera, spots_on_plane
from gripmon.model.geometry import perturb
from gripmon.model.provenance import provenance_of
from support.laser_scenes import PAPER_LENS, paper_setup, sampled

NOISE_PX = 0.3
AXES = np.eye(13)


@functools.cache
def calibration() -> LaserCalibration:
    """From 50 spots of the paper's set-up with 0.3 px of noise."""
    rng = np.random.default_rng(1)
    data = sampled(paper_setup(rng), rng)
    uv_px = data.uv_px + rng.normal(0.0, NOISE_PX, data.uv_px.shape)
    found = calibrate_laser(Samples.of_spots(uv_px, data.base_T_ee), PAPER_LENS)
    return found.document(provenance_of("test"))


@functools.cache
def known() -> Calibrated:
    return calibrated(calibration())


def true_setup() -> LaserSetup:
    """What :func:`calibration` was made of."""
    return paper_setup(np.random.default_rng(1))


@functools.cache
def poses(seed: int = 1) -> np.ndarray:
    """Others than those of the calibration, from which the spot is well within the image, in any order."""
    rng = np.random.default_rng(seed)
    setup = paper_setup(rng)
    data = sampled(setup, np.random.default_rng(seed + 1000), orientations=30)
    inside = (data.uv_px > 60).all(axis=1) & (data.uv_px < [580, 420]).all(axis=1)
    return np.random.default_rng(seed).permutation(data.base_T_ee[inside])


def drawn_setup(rng: np.random.Generator) -> LaserSetup:
    """A truth that the calibration's covariance allows."""
    root = np.linalg.cholesky(known().covariance + 1e-18 * np.eye(13))
    return known().setup.moved(root @ rng.normal(size=13))


def pixels(setup: LaserSetup, base_T_ee: np.ndarray) -> np.ndarray:
    """(n, 2) without noise."""
    return known().camera.project(in_camera(setup, spots_on_plane(setup, base_T_ee)))


def fresh(
    setup: LaserSetup, base_T_ee: np.ndarray, rng: np.random.Generator, *, arm: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Spots (n, 2) with noise; the arm is off by ``arm`` (m, rad), at the same pose each time by the same."""
    errors: dict[bytes, np.ndarray] = {}
    for pose in base_T_ee:
        errors.setdefault(pose.tobytes(), np.r_[rng.normal(0.0, arm[0], 3), rng.normal(0.0, arm[1], 3)])
    real = np.stack([perturb(pose, errors[pose.tobytes()]) for pose in base_T_ee])
    return pixels(setup, real) + rng.normal(0.0, NOISE_PX, (len(real), 2))
