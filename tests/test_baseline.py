"""An inexact reference is no drift: its error is taken out of the first frames, within what its covariance allows."""

from __future__ import annotations

import numpy as np

from gripmon.policy import Baseline, Evidence, Policy, PolicySettings
from gripmon.records import AlertKind, Cause

SETTINGS = PolicySettings(settle_frames=5)
REFERENCE_SIGMA = np.array([2e-4] * 3 + [2e-3] * 3)
NOISE = np.array([5e-6] * 3 + [1e-4] * 3)


def drift_alerts(reference_sigma: np.ndarray | None, shift_m: float, later_m: float = 0.0) -> int:
    """Alerts of kind drift over 200 frames that all stand ``shift_m`` beside the reference, ``later_m`` more from
    frame 100 on.
    """
    policy, alerts = Policy(SETTINGS, reference_sigma), 0
    for index in range(200):
        shift = np.zeros(6)
        shift[0] = shift_m + (later_m if index >= 100 else 0.0)
        judgement = policy.measured(Evidence(shift, NOISE, abs(shift[0]), 0.0, False, Cause.UNKNOWN))
        alerts += sum(alert.kind is AlertKind.DRIFT for alert in judgement.alerts)
    return alerts


def test_an_offset_within_the_reference_s_uncertainty_is_no_drift():
    assert drift_alerts(REFERENCE_SIGMA, 5e-4) == 0
    assert drift_alerts(None, 5e-4) == 1, "the same offset of an exact reference is one"


def test_an_offset_beyond_the_reference_s_uncertainty_is_drift():
    assert drift_alerts(REFERENCE_SIGMA, 9e-4) == 1


def test_motion_after_the_start_is_drift_whatever_the_reference():
    assert drift_alerts(REFERENCE_SIGMA, 5e-4, later_m=2e-4) == 1


def test_the_error_is_the_mean_of_the_first_frames():
    baseline, rng = Baseline(REFERENCE_SIGMA, 4), np.random.default_rng(1)
    shifts = rng.normal(0.0, 1e-4, (6, 6))
    results = [baseline.subtract(shift) for shift in shifts]
    assert results[:3] == [None, None, None]
    np.testing.assert_allclose(results[5], shifts[5] - shifts[:4].mean(axis=0), atol=1e-15)
