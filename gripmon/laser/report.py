"""The forecast of a laser calibration, and the result of checking it with new spots, as plain values for JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gripmon.laser.api import LaserCheck
from gripmon.laser.judgement import CameraMotion, SpotJudgement, SpotWatchSettings
from gripmon.laser.planning import ASSUMED_DISTANCE_M, ASSUMED_TILT_RAD, Forecast, assumed_poses, forecast
from gripmon.laser.setup import LaserCalibration
from gripmon.laser.world import calibrated
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array


def expectation(name: str, calibration: LaserCalibration, settings: SpotWatchSettings) -> dict[str, Any]:
    """What new spots would detect: metres, radians, px."""
    known = calibrated(calibration)
    try:
        found = forecast(known, settings, assumed_poses(known))
    except NoResultError as error:
        raise NoResultError(f"{name}: {error}") from None
    return {
        **_header(name, calibration, settings),
        "assumed": {
            "spots": len(found.sigma_px), "tilt_rad": ASSUMED_TILT_RAD, "distance_m": ASSUMED_DISTANCE_M,
        },
        **_forecast_values(found),
    }  # fmt: skip


def check_values(
    name: str, calibration: LaserCalibration, settings: SpotWatchSettings, found: LaserCheck
) -> dict[str, Any]:
    """What new spots did detect: metres, radians, px."""
    last = found.last
    return {
        **_header(name, calibration, settings),
        "verdict": found.verdict,
        "text": found.text,
        "cause": None if found.alert is None else str(found.alert.cause),
        "causes": [{"cause": str(w.cause), "probability": w.probability} for w in last.causes],
        "probability_moved": last.probability_moved,
        "motion": None if last.motion is None else _motion_values(last.motion),
        "spots_judged": [_row(sample, judged) for sample, judged in found.judged],
    }


def _header(name: str, calibration: LaserCalibration, settings: SpotWatchSettings) -> dict[str, Any]:
    residuals = calibration.residuals
    return {
        "calibration": name,
        "time": calibration.provenance.time,
        "spots": residuals.spots,
        "used": residuals.used,
        "rms_px": residuals.rms_px,
        "arm_noise_m": settings.arm_noise_m,
        "arm_noise_rad": settings.arm_noise_rad,
        "false_alarms_per_1000_pulses": settings.false_alarms_per_1000_pulses,
    }


def _forecast_values(found: Forecast) -> dict[str, Any]:
    return {
        "spot_sigma": {
            "px": [float(found.sigma_px.min()), float(found.sigma_px.max())],
            "m": [float(found.sigma_m.min()), float(found.sigma_m.max())],
        },
        "noticed": [
            {"pulses": pulses, "position_m": size[:3].tolist(), "rotation_rad": size[3:].tolist()}
            for pulses, size in zip(found.pulses, found.sizes, strict=True)
        ],
        "weakest": {
            "pulses": found.pulses[-1],
            "position_m": found.weakest[:3].tolist(),
            "rotation_rad": found.weakest[3:].tolist(),
        },
    }


def _row(name: str, judged: SpotJudgement) -> dict[str, Any]:
    return {
        "name": name,
        "used": judged.used,
        "fault": None if judged.fault is None else str(judged.fault),
        "reason": judged.reason,
        "uv_px": _values(judged.uv_px),
        "foreseen_px": _values(judged.predicted_px),
        "off_px": _values(judged.off_px),
        "sigmas": None if judged.square is None else math.sqrt(judged.square),
        "spots_base_m": _values(judged.spots_base_m),
        "disagreements": [
            {
                "ways": list(d.ways),
                "distance_m": float(np.linalg.norm(d.gap_m)),
                "sigma_m": d.sigma_m,
                "square": d.square,
                "degrees_of_freedom": d.freedom,
            }
            for d in judged.disagreements
        ],
    }


def _values(array: Array | None) -> Any:
    """Nested lists, with None for values that aren't finite."""
    if array is None:
        return None
    out = array.astype(object)
    out[~np.isfinite(array)] = None
    return out.tolist()


def _motion_values(motion: CameraMotion) -> dict[str, Any]:
    return {
        "position_m": motion.shift[:3].tolist(),
        "rotation_rad": motion.shift[3:].tolist(),
        "covariance": motion.covariance.ravel().tolist(),
        "observed": motion.observed.tolist(),
        "complete": motion.complete,
        "text": motion.text,
    }
