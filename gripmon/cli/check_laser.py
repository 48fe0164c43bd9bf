"""The output of ``gripmon check`` for a laser calibration."""

from __future__ import annotations

import math
from typing import Any

_AXES = ("x", "y", "z")


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
