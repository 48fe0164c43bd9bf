"""``gripmon check --laser``: does a laser calibration still hold, and what would be noticed?"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError, NoResultError

if TYPE_CHECKING:
    from gripmon.laser.judgement import CameraMotion, SpotJudgement, SpotWatchSettings
    from gripmon.laser.planning import Forecast
    from gripmon.laser.setup import LaserCalibration
    from gripmon.model.records import Array

_OPTIONS = ("arm_noise", "false_alarms", "wrong_spots")
_AXES = ("x", "y", "z")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add its options to the parser of ``check``."""
    group = parser.add_argument_group(
        "laser calibration",
        "Instead of a configuration: does a file of gripmon calibrate laser still hold?  SPOTS are fresh tables of "
        "spots and poses as for gripmon calibrate laser, in the order in which they were taken.  Without any: which "
        "motions fresh spots would tell.",
    )
    group.add_argument("--laser", metavar="LASER.yaml", help="the calibration; what else is named are SPOTS, if any")
    group.add_argument(
        "--arm-noise",
        type=common.arm_noise,
        metavar="M:RAD",
        help="standard deviations of the arm's poses, position (m) and rotation (rad), each axis "
        "(default 0.0001:0.0002)",
    )
    group.add_argument(
        "--false-alarms",
        type=common.positive_number,
        metavar="N",
        help="how often in 1000 spots an unmoved set-up may be said to have moved (default 0.1, at most 10)",
    )
    group.add_argument(
        "--wrong-spots",
        type=common.positive_number,
        metavar="PART",
        help="part of the spots that may be reflections (default 0.2, at most 0.5)",
    )


def refuse_without_laser(arguments: argparse.Namespace) -> None:
    """End the command if an option of this check stands alone."""
    for name in _OPTIONS:
        if getattr(arguments, name) is not None:
            option = name.replace("_", "-")
            raise InputError(f"--{option}: only has a meaning for a laser calibration; add --laser LASER.yaml")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon check --laser``."""
    settings = _settings(arguments)
    calibration = _calibration(Path(arguments.laser))
    if not arguments.config:
        report = expectation(arguments.laser, calibration, settings)
        print(json.dumps(report, indent=2) if arguments.json else "\n".join(expectation_lines(report)))
        return common.EXIT_DONE
    report = _judged(arguments.laser, calibration, settings, [Path(name) for name in arguments.config])
    print(json.dumps(report, indent=2) if arguments.json else "\n".join(_judged_lines(report)))
    return common.EXIT_DONE if report["verdict"] == "same" else common.EXIT_FAILED


def _settings(arguments: argparse.Namespace) -> SpotWatchSettings:
    from gripmon.laser.judgement import SpotWatchSettings

    given: dict[str, Any] = {}
    if arguments.arm_noise is not None:
        given["arm_noise_m"], given["arm_noise_rad"] = arguments.arm_noise
    for name, key, most in (
        ("false_alarms", "false_alarms_per_1000_pulses", 10.0), ("wrong_spots", "wrong_spots", 0.5),
    ):  # fmt: skip
        value = getattr(arguments, name)
        if value is None:
            continue
        if value > most:
            option = name.replace("_", "-")
            raise InputError(f"--{option} {value:g}: too many; at most {most:g}")
        given[key] = value
    return SpotWatchSettings(**given)


def _calibration(path: Path) -> LaserCalibration:
    from gripmon.daemon.config.second import read_laser

    if not path.is_file():
        raise InputError(f"--laser {path}: there is no such file; a file of gripmon calibrate laser")
    return read_laser(path, path)


def expectation(name: str, calibration: LaserCalibration, settings: SpotWatchSettings) -> dict[str, Any]:
    """What fresh spots would tell, as plain values for JSON: metres, radians, px."""
    from gripmon.laser.planning import ASSUMED_DISTANCE_M, ASSUMED_TILT_RAD, assumed_poses, forecast
    from gripmon.laser.world import calibrated

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
        **_foresight_values(found),
    }  # fmt: skip


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


def _foresight_values(found: Forecast) -> dict[str, Any]:
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


def expectation_lines(report: dict[str, Any]) -> list[str]:
    """The same in words, the calibration's own line first."""
    assumed, sigma, weakest = report["assumed"], report["spot_sigma"], report["weakest"]
    tilt = math.degrees(assumed["tilt_rad"])
    low_px, high_px = sigma["px"]
    low_mm, high_mm = (1e3 * value for value in sigma["m"])
    poses = f"{assumed['spots']} spots over the image, the beam {tilt:.0f}° off the plane's normal"
    each = f"each to {low_px:.2f} to {high_px:.2f} px, {low_mm:.2f} to {high_mm:.2f} mm on the plane"
    alarms = f"{report['false_alarms_per_1000_pulses']:g} false alarms in 1000 pulses"
    lines = [
        *_header_lines(report),
        f"foreseen   {poses}, the laser {assumed['distance_m']:g} m away:",
        f"           {each} (one standard deviation, worst direction)",
        f"noticed    with {alarms}, motions of the camera, base axes:",
    ]
    for row in report["noticed"]:
        place = ", ".join(f"{a} {1e3 * v:.2f}" for a, v in zip(_AXES, row["position_m"], strict=True))
        turn = ", ".join(f"{a} {math.degrees(v):.3f}" for a, v in zip(_AXES, row["rotation_rad"], strict=True))
        lines.append(f"           in {row['pulses']:>3} pulses: along {place} mm, about {turn}°")
    motion = f"by {_mm(weakest['position_m'])} mm while turned by {_degrees(weakest['rotation_rad'])}°"
    return [*lines, f"weakest    in {weakest['pulses']} pulses from these poses, {motion}"]


def _header_lines(report: dict[str, Any]) -> list[str]:
    noise = f"{1e3 * report['arm_noise_m']:g} mm, {1e3 * report['arm_noise_rad']:g} mrad"
    spots = f"{report['used']} of {report['spots']} spots, RMS {report['rms_px']:.3f} px"
    return [f"{report['calibration']}: {spots}, {report['time']}; arm exact to {noise}"]


def _judged(name: str, calibration: LaserCalibration, settings: SpotWatchSettings, paths: list[Path]) -> dict[str, Any]:
    from gripmon.laser.api import check_laser

    found = check_laser(calibration, paths, settings, common.progress_bar)
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
                "distance_m": d.distance_m,
                "sigma_m": d.sigma_m,
                "square": d.square,
                "degrees_of_freedom": d.freedom,
            }
            for d in judged.disagreements
        ],
    }


def _values(array: Array | None) -> Any:
    """Lists with None for what isn't known."""
    import numpy as np

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


def _judged_lines(report: dict[str, Any]) -> list[str]:
    lines = _header_lines(report)
    lines.append("mm (sigma) by which two ways to the spot disagree; px off where the calibration has it")
    width = max(len(row["name"]) for row in report["spots_judged"])
    lines.append(f"{'spot':<{width}}  beam and plane   ray and plane         beam            off")
    lines.append(f"{'':<{width}}  / ray and plane  / beam and ray         / ray             px")
    for row in report["spots_judged"]:
        note = f"  {row['reason']}" if row["reason"] else ""
        lines.append(f"{row['name']:<{width}}  {_gaps(row)}{note}".rstrip())
    return [*lines, f"verdict    {report['verdict']}: {report['text']}"]


def _gaps(row: dict[str, Any]) -> str:
    if row["off_px"] is None:
        return " " * 62
    shown = []
    for pair in (["beam and plane", "ray and plane"], ["ray and plane", "beam and ray"], ["beam", "ray"]):
        gap = next((d for d in row["disagreements"] if d["ways"] == pair), None)
        shown.append("—" if gap is None else f"{1e3 * gap['distance_m']:.2f} ({math.sqrt(gap['square']):.1f})")
    off = f"{math.hypot(*row['off_px']):.2f} ({row['sigmas']:.1f})"
    return f"{shown[0]:>14}  {shown[1]:>14}  {shown[2]:>14}  {off:>14}"


def _mm(values: list[float]) -> str:
    return "({:+.2f}, {:+.2f}, {:+.2f})".format(*(1e3 * v for v in values))


def _degrees(values: list[float]) -> str:
    return "({:+.3f}, {:+.3f}, {:+.3f})".format(*(math.degrees(v) for v in values))
