"""The part of ``gripmon check`` that says how exact a frame will be, and what the view can't tell apart."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.model.records import Array
    from gripmon.teach.forecast import JawOutlook, Outlook

_DIRECTIONS = (
    "a shift along x", "a shift along y", "the distance (z)", "a tilt about x", "a tilt about y", "a roll about z",
)  # fmt: skip
_POORLY = 2.0  # times less certain than with an exact opening: beyond, the two count as hardly separable
_STEPS_M = (5e-5, 1e-4, 5e-4)  # of the TCP, for which the delay is given
_JAW_ERROR_M = 1e-5  # an error of the opening for which its effect is given


def accuracy(config: Config) -> dict[str, Any]:
    """What one frame can show, as plain values for JSON: metres, radians, px.  With too few edges only that."""
    from gripmon.teach.forecast import EDGE_POINT_SIGMA_PX, FEWEST_EDGES, expect

    settings = config.settings.monitor
    outlook = expect(
        config.camera, config.gripper, settings, config.reference, config.jaw_opening_m, config.taught_edges
    )
    out: dict[str, Any] = {
        "measurement": settings.measurement,
        "edges": outlook.edges,
        "edges_needed": FEWEST_EDGES,
        "edge_point_sigma_px": EDGE_POINT_SIGMA_PX,
        "recalibration": _recalibration(config, outlook),
    }
    if not outlook.enough:
        return {**out, "expected": None, "weakest": None, "jaw": None, "drift": None}
    return {
        **out,
        "expected": _split(outlook.sigma),
        "weakest": _split(outlook.weakest),
        "jaw": None if outlook.jaw is None else _jaw(outlook.jaw, outlook.lever_m, settings.jaw_sigma_m),
        "drift": _drift(config, outlook),
    }


def _split(values: Array) -> dict[str, list[float]]:
    return {"tcp_m": values[:3].tolist(), "rotation_rad": values[3:].tolist()}


def _jaw(jaw: JawOutlook, lever_m: float, reported_sigma_m: float) -> dict[str, Any]:
    per_m = [abs(v) * (1.0 if k < 3 else lever_m) for k, v in enumerate(jaw.pose_per_m.tolist())]
    return {
        "reported_sigma_m": reported_sigma_m,
        "unknown": {**_split(jaw.sigma), "jaw_m": jaw.sigma_m},
        "pose_per_jaw_m": _split(jaw.pose_per_m),
        "like": _DIRECTIONS[per_m.index(max(per_m))],
        "correlation": jaw.correlation,
        "growth": jaw.growth,
    }


def _drift(config: Config, outlook: Outlook) -> dict[str, Any]:
    """What the drift test notices, and after how many frames."""
    from gripmon.judge.drift import CORRELATION_FRAMES, foresee

    settings = config.settings.monitor.drift
    foresight = foresee(outlook.covariance, settings)
    return {
        "false_alarms_per_day": settings.false_alarms_per_day,
        "frames_per_s": settings.frames_per_s,
        "correlation_frames": CORRELATION_FRAMES,
        "smallest": _split(foresight.smallest),
        "delay_frames": {
            f"{size_m:g}": [foresight.delay_frames(size_m, axis) for axis in range(3)] for size_m in _STEPS_M
        },
    }


def _recalibration(config: Config, outlook: Outlook) -> dict[str, Any]:
    """Whether the corners that this view shows give a full pose by themselves, and how certain one frame's is: what is
    averaged over frames whose errors last is hardly more certain.
    """
    from gripmon.judge.recalibrate import coplanar, refusal
    from gripmon.monitor import CORNER_COUNTS

    gripper, variant = config.gripper, config.settings.monitor.recalibrate_corners
    taken = gripper.innermost_corners(outlook.corners, CORNER_COUNTS[variant])
    points_grip_m = gripper.points_grip_m(config.jaw_opening_m)[gripper.corner_points][taken]
    reason = refusal(points_grip_m)
    return {
        "corners": len(points_grip_m),
        "coplanar": bool(len(points_grip_m) >= 3 and coplanar(points_grip_m)),
        "possible": reason is None,
        "reason": reason,
        "sigma_m": float(max(outlook.sigma[:3])) if outlook.enough else None,
        "sure_sigma_m": config.settings.monitor.recalibration.sure_sigma_m,
        "mode": config.settings.monitor.recalibration.mode,
    }


def accuracy_lines(values: dict[str, Any]) -> list[str]:
    """The same for a person: mm and degrees."""
    edges, expected, weakest = values["edges"], values["expected"], values["weakest"]
    if expected is None:
        accuracy = [f"accuracy   NONE: {edges} edges can be sampled, at least {values['edges_needed']} are needed"]
    else:
        way, sigma_px = values["measurement"], values["edge_point_sigma_px"]
        turn = _degrees(weakest["rotation_rad"])
        accuracy = [
            f"accuracy   standard deviations of a frame by {way}, {edges} edges seen to {sigma_px:g} px a point:",
            f"           {_sigmas(expected)}",
            f"weakest    TCP by {_mm(weakest['tcp_m'])} mm while turned by {turn}°",
        ]
    jaw = [] if values["jaw"] is None else _jaw_lines(values["jaw"])
    drift = [] if values["drift"] is None else _drift_lines(values["drift"])
    return [*accuracy, *jaw, *drift, f"new pose   {_recalibration_text(values['recalibration'])}"]


def _jaw_lines(jaw: dict[str, Any]) -> list[str]:
    unknown, growth = jaw["unknown"], jaw["growth"]
    shift_m = [_JAW_ERROR_M * v for v in jaw["pose_per_jaw_m"]["tcp_m"]]
    told = f"{'can hardly separate' if growth >= _POORLY else 'separates'} the opening from {jaw['like']}"
    less = f"{growth:.1f} times less certain than with it"
    return [
        f"jaw        opening reported to {1e3 * jaw['reported_sigma_m']:.3f} mm; if it were unknown:",
        f"           {_sigmas(unknown)}; opening {1e3 * unknown['jaw_m']:.3f} mm",
        f"           the image {told}: correlation {jaw['correlation']:.2f}, {less}",
        f"           taken as exact but wrong by {1e3 * _JAW_ERROR_M:.3f} mm it shifts the TCP by {_mm(shift_m)} mm",
    ]


def _drift_lines(drift: dict[str, Any]) -> list[str]:
    alarms, frames_per_s = drift["false_alarms_per_day"], drift["frames_per_s"]
    lines = [
        f"drift      at most {alarms:g} false alarms a day at {frames_per_s:g} frames/s; where errors last for",
        f"           {drift['correlation_frames']:.0f} frames the smallest step that is noticed: "
        + _sigmas(drift["smallest"]),
    ]
    lines.append("           on average, by means over 1, 2, 4 … 4096 frames, each complete one frame later:")
    for size, delays in drift["delay_frames"].items():
        noticed = ", ".join(
            f"{axis} {'never' if frames is None else f'within {frames} frames'}"
            for axis, frames in zip("xyz", delays, strict=True)
        )
        lines.append(f"           a step of the TCP by {1e3 * float(size):g} mm is noticed along {noticed}")
    return lines


def _recalibration_text(values: dict[str, Any]) -> str:
    if not values["possible"]:
        return f"NOT from corners in this view: {values['reason']}; past the limit the reference stays"
    where = "in one plane (4 are needed)" if values["coplanar"] else "(6 are needed)"
    text = f"past the limit from {values['corners']} corners {where}"
    sigma_m, sure_m = values["sigma_m"], values["sure_sigma_m"]
    if values["mode"] == "off" or sigma_m is None:
        return text
    if values["mode"] == "confirm":
        return f"{text}; an operator has to accept it (recalibration.mode)"
    if sigma_m <= sure_m:
        return f"{text}; certain to {1e3 * sigma_m:.3f} mm, taken without an operator up to {1e3 * sure_m:g} mm"
    asked = f"an operator has to accept most, above {1e3 * sure_m:g} mm (monitor.recalibration.sure_sigma_m)"
    return f"{text}; certain to {1e3 * sigma_m:.3f} mm: {asked}"


def _sigmas(values: dict[str, list[float]]) -> str:
    x, y, z = (1e3 * v for v in values["tcp_m"])
    a, b, c = (math.degrees(v) for v in values["rotation_rad"])
    return f"TCP x {x:.3f}, y {y:.3f}, z {z:.3f} mm, turn about x {a:.3f}, y {b:.3f}, z {c:.3f}°"


def _mm(values: list[float]) -> str:
    return "({:+.3f}, {:+.3f}, {:+.3f})".format(*(1e3 * v for v in values))


def _degrees(values: list[float]) -> str:
    return "({:+.3f}, {:+.3f}, {:+.3f})".format(*(math.degrees(v) for v in values))
