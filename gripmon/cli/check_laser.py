"""The output of ``gripmon check`` for a laser calibration, and for a second camera that monitors one."""

from __future__ import annotations

import math
from typing import Any

_AXES = ("x", "y", "z")


def details(report: dict[str, Any]) -> list[str]:
    """A second camera's configuration."""
    sections = {
        "second": f"{report['robot']}/{report['camera_name']}, watched by a pulsed laser",
        "camera": _calibration_line(report["calibration"]),
        "known": _known_line(report["calibration"]["sigmas"]),
        "watch": _watch_line(report["watch"]),
        "pulses": _pulses_line(report["pulses"]),
    }
    lines = [f"{name:<10} {text}" for name, text in sections.items()]
    return lines + expectation_lines(report["foreseen"])[1:]


def _calibration_line(calibration: dict[str, Any]) -> str:
    x, y, z = (1e3 * value for value in calibration["translation_m"])
    return (
        f"{calibration['width_px']} x {calibration['height_px']} px at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the base, its "
        f"plane {1e3 * calibration['distance_m']:.0f} mm away; {calibration['id']} of {calibration['file']}, "
        f"{calibration['used']} of {calibration['spots']} spots, RMS {calibration['rms_px']:.2f} px"
    )


def _known_line(sigmas: dict[str, float]) -> str:
    """Standard deviations of known parameters; a file may have others."""
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
        return f"by the robot's program on {pulses['key']}"
    length_s = 1e-9 * (pulses["last_ns"] - pulses["first_ns"])
    return f"{pulses['count']} in {pulses['table']}, over {length_s:.4g} s"


def expectation_lines(report: dict[str, Any]) -> list[str]:
    """Which motions fresh spots would detect, the calibration's own line first."""
    assumed, sigma, weakest = report["assumed"], report["spot_sigma"], report["weakest"]
    tilt = math.degrees(assumed["tilt_rad"])
    low_px, high_px = sigma["px"]
    low_mm, high_mm = (1e3 * value for value in sigma["m"])
    poses = f"{assumed['spots']} spots over the image, the beam {tilt:.0f}° off the plane's normal"
    each = f"each to {low_px:.2f} to {high_px:.2f} px, {low_mm:.2f} to {high_mm:.2f} mm on the plane"
    alarms = f"{report['false_alarms_per_1000_pulses']:g} false alarms in 1000 pulses"
    lines = [
        *_header_lines(report),
        f"forecast   {poses}, the laser {assumed['distance_m']:g} m away:",
        f"           {each} (one standard deviation, worst direction)",
        f"detects    with {alarms}, motions of the camera, base axes:",
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


def judged_lines(report: dict[str, Any]) -> list[str]:
    """What fresh spots show."""
    lines = _header_lines(report)
    lines.append("mm (sigma) by which two ways to the spot disagree; px off the predicted position")
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
