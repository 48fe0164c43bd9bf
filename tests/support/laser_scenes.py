"""Laser set-ups with known truth, as the benchmark has them."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from benchmarks import laser_printed
from benchmarks.laser_scenes import PAPER_LENS, LaserData, paper_setup, sampled

__all__ = [
    "PAPER_LENS",
    "LaserData",
    "assert_same",
    "laser_printed",
    "numeric",
    "paper_setup",
    "sampled",
    "scene",
    "sides",
    "translation_error",
    "write_csv",
]

STEP = 1e-6


def scene(seed=1, **options):
    rng = np.random.default_rng(seed)
    return sampled(paper_setup(rng), rng, **options)


def numeric(function, count):
    """Central differences of a function of a small change (count,), stacked behind."""
    columns = [(function(STEP * e) - function(-STEP * e)) / (2.0 * STEP) for e in np.eye(count)]
    return np.stack(columns, axis=-1)


def sides(setup):
    """A laser line's moment and direction, which don't depend on which of its points is given."""
    return np.concatenate([setup.direction_ee, np.cross(setup.point_ee_m, setup.direction_ee)])


def assert_same(found, truth, tolerance=1e-9):
    assert np.abs(found.cam_T_base - truth.cam_T_base).max() < tolerance
    assert np.abs(found.normal_cam - truth.normal_cam).max() < tolerance
    assert abs(found.distance_cam_m - truth.distance_cam_m) < tolerance
    assert np.abs(sides(found) - sides(truth)).max() < tolerance


def translation_error(setup, truth):
    found, right = setup.base_T_cam[:3, 3], truth.base_T_cam[:3, 3]
    return np.linalg.norm(found - right) / np.linalg.norm(right)


def write_csv(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path
