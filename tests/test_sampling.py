"""Covariances by sampling: edge points with known noise, and one in a hundred anywhere, through the joint fit, the
lines and the corners.  Normalised squared errors (NEES) have the mean of their degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.meters import FISHEYE_LENS, JAW_SIGMA_M, difference
from support.sampled import OPENING_M, NoisyMeter
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, nominal_cam_T_grip

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import LensSettings
from gripmon.model.gripper import Gripper
from gripmon.track.edges import Measurement

SAMPLES = 200
ADAPTIVE = read_gripper(BOX_FINGERS.parent / "adaptive_arc_fingers.yaml")


def normalised(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def measurements(meter: NoisyMeter, reported: bool = True, count: int = SAMPLES) -> list[Measurement]:
    """Many, each with an opening that is told wrong by the stated standard deviation."""
    told_m = OPENING_M + np.random.default_rng(7).normal(scale=JAW_SIGMA_M, size=count)
    return [meter.forecast(nominal_cam_T_grip(), opening_m, reported) for opening_m in told_m]


@pytest.mark.parametrize(
    ("lens", "gripper", "reported", "gross"),
    [
        (PAPER_LENS, None, True, 0.0),
        pytest.param(
            PAPER_LENS,
            None,
            False,
            0.01,
            marks=pytest.mark.slow("12 s: sampled; the reported opening is in the default run"),
        ),
        (STRONG_LENS, None, True, 0.01),
        pytest.param(
            FISHEYE_LENS,
            None,
            False,
            0.0,
            marks=pytest.mark.slow("10 s: sampled; the reported opening is in the default run"),
        ),
        (PAPER_LENS, ADAPTIVE, True, 0.01),
    ],
    ids=["paper", "paper, unknown, gross", "brown_conrady, gross", "fisheye, unknown", "fingers on an arc, gross"],
)
def test_the_joint_fits_covariance_is_that_of_its_errors(
    lens: LensSettings, gripper: Gripper | None, reported: bool, gross: float
):
    """Pose and opening together, seven unknowns; of the means three or four per cent are chance."""
    nees_7, nees_6 = [], []
    meter = NoisyMeter(JAW_SIGMA_M, lens=lens, gripper=gripper, gross=gross)
    for found in measurements(meter, reported, 500):
        error = np.append(difference(found.cam_T_grip, nominal_cam_T_grip()), OPENING_M - found.jaw_opening_m)
        nees_7.append(normalised(error, found.covariance))
        nees_6.append(normalised(error[:6], found.covariance[:6, :6]))
    assert np.mean(nees_6) == pytest.approx(6.0, rel=0.1)
    assert np.mean(nees_7) == pytest.approx(7.0, rel=0.1)
    # 99.9 % of chi-square with six degrees of freedom lie below this; the scatter itself is an estimate.
    assert np.mean(np.array(nees_6) < 22.46) > 0.985


@pytest.mark.parametrize("gross", [0.0, 0.01], ids=["normal", "1 % gross"])
def test_the_corners_joint_covariance_is_that_of_their_errors(gross: float):
    """Also between corners at two ends of an edge.  Weights about the joint fit, not about each line by itself, leave
    the lines a little nearer to it than they claim: a quarter of the variance, and what the mean of so few scatters by.
    """
    meter = NoisyMeter(JAW_SIGMA_M, gross=gross)
    true_xy, errors, nees = None, [], []
    for found in measurements(meter):
        usable = found.corners.usable
        assert np.count_nonzero(usable) == 6
        true_xy = found.corners_at(OPENING_M)[usable]
        error = (found.corners.xy[usable] - true_xy[:, :2] / true_xy[:, 2:]).ravel()
        joint = found.corners.joint_covariance_xy(usable)
        errors.append(error)
        nees.append(normalised(error, joint))
        np.testing.assert_allclose(
            joint.reshape(6, 2, 6, 2)[range(6), :, range(6)], found.corners.covariance_xy[usable], rtol=1e-12
        )
    assert 0.7 * 12.0 < np.mean(nees) < 1.1 * 12.0
    scale = np.sqrt(joint.diagonal())
    claimed = joint / np.outer(scale, scale)
    assert np.abs(claimed - np.eye(12)).max() > 0.4, "corners do err together"
    # A sampled correlation scatters by 1 / sqrt(n).
    np.testing.assert_allclose(np.corrcoef(np.array(errors).T), claimed, atol=4.0 / np.sqrt(SAMPLES))
