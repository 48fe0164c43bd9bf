"""``gripmon check`` with the configuration of a second camera."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from gripmon.cli import check_laser, check_text

if TYPE_CHECKING:
    from gripmon.daemon.config import SecondConfig


def run(config: SecondConfig, *, as_json: bool, verbose: bool) -> int:
    """Print what the configuration comes to; returns the exit code."""
    import msgspec

    from gripmon.daemon.findings import second_findings
    from gripmon.daemon.surroundings import surroundings

    watch = config.settings.laser.watch
    around = surroundings(config)
    report = {
        **_values(config),
        "foreseen": check_laser.expectation(str(config.calibration_path), config.calibration, watch),
        **msgspec.to_builtins(around),
    }
    found = second_findings(report, around)
    if as_json:
        print(json.dumps({"findings": [each._asdict() for each in found], **report}, indent=2))
    else:
        lines = check_text.lines(report["config"], found)
        more = [*_details(report), *check_text.surrounding_lines(around)]
        print("\n".join([*lines, "", *more] if verbose else lines))
    return check_text.exit_code(found)


def _values(config: SecondConfig) -> dict[str, Any]:
    """Plain values for JSON: metres, radians, px, ns."""
    settings, calibration = config.settings, config.calibration
    camera, residuals, watch = config.camera, calibration.residuals, config.settings.laser.watch
    pulses = config.pulses
    return {
        "config": str(config.path),
        "robot": settings.robot,
        "camera_name": settings.camera_name,
        "calibration": {
            "file": str(config.calibration_path),
            "time": calibration.provenance.time,
            "id": config.pulsed_watch().reference_id,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "spots": residuals.spots,
            "used": residuals.used,
            "rms_px": residuals.rms_px,
            "distance_m": calibration.plane.distance_cam_m,
            "translation_m": list(calibration.base_T_cam.translation_m),
            "rotation_xyzw": list(calibration.base_T_cam.rotation_xyzw),
            "sigmas": dict(calibration.sigmas),
        },
        "watch": {
            "false_alarms_per_1000_pulses": watch.false_alarms_per_1000_pulses,
            "arm_noise_m": watch.arm_noise_m,
            "arm_noise_rad": watch.arm_noise_rad,
            "warn_m": watch.warn_m,
            "limit_m": watch.limit_m,
        },
        "pulses": {
            "key": None if settings.laser.pulses else f"gripmon/{settings.robot}/{settings.camera_name}/pulse",
            "table": None if settings.laser.pulses is None else str(config.directory / settings.laser.pulses),
            "count": len(pulses) if settings.laser.pulses else None,
            "first_ns": pulses[0].stamp_ns if pulses else None,
            "last_ns": pulses[-1].until_ns if pulses else None,
        },
    }


def _details(report: dict[str, Any]) -> list[str]:
    sections = {
        "second": f"{report['robot']}/{report['camera_name']}, watched by a pulsed laser",
        "camera": _calibration_line(report["calibration"]),
        "known": _known_line(report["calibration"]["sigmas"]),
        "watch": _watch_line(report["watch"]),
        "pulses": _pulses_line(report["pulses"]),
    }
    lines = [f"{name:<10} {text}" for name, text in sections.items()]
    lines += check_laser.expectation_lines(report["foreseen"])[1:]
    return lines


def _calibration_line(calibration: dict[str, Any]) -> str:
    x, y, z = (1e3 * value for value in calibration["translation_m"])
    return (
        f"{calibration['width_px']} x {calibration['height_px']} px at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the base, its "
        f"plane {1e3 * calibration['distance_m']:.0f} mm away; {calibration['id']} of {calibration['file']}, "
        f"{calibration['used']} of {calibration['spots']} spots, RMS {calibration['rms_px']:.2f} px"
    )


def _known_line(sigmas: dict[str, float]) -> str:
    """By the parameters' names; those of a file that has others are left out."""
    place = [1e3 * sigmas[f"base_T_cam.{axis}_m"] for axis in "xyz" if f"base_T_cam.{axis}_m" in sigmas]
    turn = [math.degrees(sigmas[f"base_T_cam.r{axis}_rad"]) for axis in "xyz" if f"base_T_cam.r{axis}_rad" in sigmas]
    return (
        f"camera to ± {', '.join(f'{value:.2f}' for value in place)} mm and "
        f"± {', '.join(f'{value:.3f}' for value in turn)}° in the base (one standard deviation)"
    )


def _watch_line(watch: dict[str, Any]) -> str:
    return (
        f"arm exact to {1e3 * watch['arm_noise_m']:g} mm and {1e3 * watch['arm_noise_rad']:g} mrad; a warning from "
        f"{1e3 * watch['warn_m']:g} mm, an error from {1e3 * watch['limit_m']:g} mm"
    )


def _pulses_line(pulses: dict[str, Any]) -> str:
    if pulses["table"] is None:
        return f"told by the robot's program on {pulses['key']}"
    length_s = 1e-9 * (pulses["last_ns"] - pulses["first_ns"])
    return f"{pulses['count']} in {pulses['table']}, over {length_s:.4g} s"
