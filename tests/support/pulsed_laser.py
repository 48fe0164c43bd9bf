"""Pulses of a laser on an arm whose truth is known: calibrated from noisy spots, then watched."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from gripmon.laser.calibrating import Spots, calibrate, document
from gripmon.laser.judgement import SpotSeen
from gripmon.laser.setup import LaserCalibration, LaserSetup
from gripmon.laser.spots import plain_spot
from gripmon.laser.world import Calibrated, World, calibrated, predict
from gripmon.model.geometry import invert, perturb
from gripmon.model.provenance import provenance_of
from support.laser_scenes import paper_setup, sampled

NOISE_PX = 0.3
AXES = np.eye(13)


@functools.cache
def calibration() -> LaserCalibration:
    """From 50 spots of the paper's set-up with 0.3 px of noise."""
    rng = np.random.default_rng(1)
    data = sampled(paper_setup(rng), rng)
    uv_px = data.uv_px + rng.normal(0.0, NOISE_PX, data.uv_px.shape)
    refined = calibrate(data.camera, data.base_T_ee, Spots(uv_px)).refined
    return document(refined, tuple(map(str, range(len(uv_px)))), 5, (), provenance_of("test"))


def true_world() -> World:
    """What :func:`calibration` was made of."""
    setup = paper_setup(np.random.default_rng(1))
    base_T_cam = invert(setup.cam_T_base)
    normal = base_T_cam[:3, :3] @ setup.normal_cam
    distance_m = setup.distance_m + float(normal @ base_T_cam[:3, 3])
    return World(base_T_cam, LaserSetup(np.eye(4), normal, distance_m, setup.point_ee_m, setup.direction_ee))


@functools.cache
def poses(seed: int = 1) -> tuple[np.ndarray, ...]:
    """Others than those of the calibration, from which the spot is well within the image."""
    rng = np.random.default_rng(seed)
    setup = paper_setup(rng)
    data = sampled(setup, np.random.default_rng(seed + 1000), orientations=30)
    inside = (data.uv_px > 60).all(axis=1) & (data.uv_px < [580, 420]).all(axis=1)
    return tuple(np.random.default_rng(seed).permutation(data.base_T_ee[inside]))


def drawn_world(known: Calibrated, rng: np.random.Generator) -> World:
    """A truth that the calibration's covariance allows."""
    root = np.linalg.cholesky(known.covariance + 1e-18 * np.eye(13))
    return known.world.moved(root @ rng.normal(size=13))


def pulses(
    world: World,
    where: tuple[np.ndarray, ...],
    count: int,
    rng: np.random.Generator,
    *,
    moved: World | None = None,
    after: int = 10**9,
    wrong: float = 0.0,
    arm: tuple[float, float] = (0.0, 0.0),
) -> Iterator[SpotSeen]:
    """From these poses in turn, one every two seconds; ``moved`` is how it is from pulse ``after`` on; a part of the
    spots is anywhere in the image.  The arm is off at each pose, each time by the same.
    """
    camera = calibrated(calibration()).camera
    off = [np.r_[rng.normal(0.0, arm[0], 3), rng.normal(0.0, arm[1], 3)] for _ in where]
    real = [perturb(pose, error) for pose, error in zip(where, off, strict=True)]
    for k in range(count):
        there = world if moved is None or k < after else moved
        uv_px = predict(there, camera, real[k % len(where)]).uv_px + rng.normal(0.0, NOISE_PX, 2)
        if rng.uniform() < wrong:
            uv_px = rng.uniform([0.0, 0.0], [639.0, 479.0])
        yield SpotSeen(2_000_000_000 * k, where[k % len(where)], [plain_spot(uv_px)])
