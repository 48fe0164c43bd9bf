"""The output of ``gripmon check``: the findings, and with ``--verbose`` the forecast in mm, degrees and px."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gripmon.model.units import in_degrees, in_mm

if TYPE_CHECKING:
    from gripmon.daemon import forecast as forecasts
    from gripmon.daemon.findings import Finding, Surroundings
    from gripmon.io.wire import Joining
    from gripmon.teach import accuracy as expected
    from gripmon.teach import jaw_travel

_POORLY = 2.0  # growth of the standard deviation without a known opening above which the two are hardly separable
_JAW_ERROR_M = 1e-5  # the error of the opening whose effect is printed
_AXES = ("x", "y", "z")
_DOES = {"listen": "listens on", "connect": "connects to"}


def lines(path: str, findings: Sequence[Finding]) -> list[str]:
    """A headline, then one line per finding."""
    counts = {level: sum(each.level == level for each in findings) for level in ("FAIL", "WARN")}
    parts = [_counted(counts["FAIL"], "failure")] if counts["FAIL"] else ["sound"]
    parts += [_counted(counts["WARN"], "warning")] if counts["WARN"] else []
    width = max(len(each.about) for each in findings)
    rows = [f"{each.level:<4}  {each.about:<{width}}  {each.text}" for each in findings]
    return [f"{path}: {', '.join(parts)}", *rows]


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count > 1 else ''}"


def details(report: forecasts.Forecast) -> list[str]:
    """The forecast as text: px, mm, degrees."""
    edges = [edge.id for edge in report.edges if edge.visible]
    seen = sum(corner.visible for corner in report.corners)
    sections = {
        "camera": _camera_line(report.camera),
        "gripper": _gripper_line(report.gripper, report.jaw),
        "reference": _reference_line(report.reference),
        "taught": _taught_line(report.taught, edges),
        "edges": f"{len(edges)} of {len(report.edges)} visible: {', '.join(edges)}",
        "corners": f"{seen} of {len(report.corners)} visible:",
    }
    lines = [f"{name:<10} {text}" for name, text in sections.items()]
    if not report.gripper.faces:
        # Before the corners, whose list follows.
        lines.insert(-1, " " * 11 + "the gripper file has no faces: which of its own edges a finger hides is unknown")
    lines[2:2] = [" " * 11 + note for note in report.gripper.notes]
    width = max(len(corner.id) for corner in report.corners)
    lines += [_corner_line(corner, width) for corner in report.corners]
    lines += _accuracy_lines(report.accuracy)
    lines.append(f"promise    forecast: {report.promise}")
    view = report.in_view
    return [*lines, *_border_lines(view), *_camera_lines(view), *_jaw_lines(view.jaw_travel)]


def _camera_line(camera: forecasts.CameraValues) -> str:
    across, down = (math.degrees(angle) for angle in camera.field_of_view_rad)
    size = f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:g}, {camera.fy_px:g} px"
    return f"{size}, lens {camera.model}, sees about {across:.0f}° x {down:.0f}°"


def _gripper_line(gripper: forecasts.GripperValues, jaw: forecasts.JawValues) -> str:
    name = f"{gripper.name} ({gripper.file})"
    if gripper.jaw_m is None or jaw.opening_m is None:
        return f"{name}: no jaw"
    low_mm, high_mm = (1e3 * v for v in gripper.jaw_m)
    opening = f"{1e3 * jaw.opening_m:.1f} mm"
    if jaw.source == "fixed":
        return f"{name}: jaw {low_mm:g} to {high_mm:g} mm, fixed at {opening}{', the nominal one' * jaw.nominal}"
    return f"{name}: jaw {low_mm:g} to {high_mm:g} mm, opening from {jaw.source}; the following at {opening}"


def _reference_line(reference: forecasts.ReferenceValues) -> str:
    x, y, z = (1e3 * v for v in reference.translation_m)
    place = f"{reference.id}: TCP at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the camera frame"
    turn = f"{math.degrees(reference.turn_rad):.1f}° between camera and gripper"
    return f"{place}, {turn}, 1 px is {1e3 * reference.metres_per_px:.3f} mm at the TCP"


def _taught_line(taught: forecasts.TaughtValues | None, visible: list[str]) -> str:
    if taught is None:
        return "nothing; `gripmon teach` removes the bias of bevels, rounded edges and shading"
    largest, images = taught.largest, "1 image" if taught.images == 1 else f"{taught.images} images"
    count = f"{len(taught.edges)} edges from {images} ({taught.file}, {taught.time})"
    farthest = f"largest offset {largest.edge}, {1e6 * largest.offset_m:+.0f} µm ({largest.offset_px:+.2f} px)"
    missing = [name for name in visible if name not in taught.edges]
    return f"{count}; {farthest}" + (f"; visible, but not taught: {', '.join(missing)}" if missing else "")


def _corner_line(corner: forecasts.CornerView, width: int) -> str:
    reason = {None: "", "outside": "outside of the image", "self_hidden": "hidden by its own finger"}[corner.reason]
    place = "       —       " if corner.uv_px is None else "({:6.1f}, {:6.1f})".format(*corner.uv_px)
    return f"           {corner.id:<{width}} {place} px  {1e3 * corner.distance_m:6.1f} mm  {reason}".rstrip()


def _accuracy_lines(values: expected.Accuracy) -> list[str]:
    edges, sigma, weakest = values.edges, values.expected, values.weakest
    if sigma is None or weakest is None:
        accuracy = [f"accuracy   NONE: {edges} edges can be sampled, at least {values.edges_needed} are needed"]
    else:
        way, sigma_px = values.measurement, values.edge_point_sigma_px
        turn = _degrees(weakest.rotation_rad)
        accuracy = [
            f"accuracy   standard deviations of a frame by {way}, {edges} edges seen to {sigma_px:g} px a point:",
            f"           {_sigmas(sigma)}",
            f"weakest    TCP by {_mm(weakest.tcp_m)} mm while turned by {turn}°",
        ]
    jaw = [] if values.jaw is None else _jaw_accuracy_lines(values.jaw)
    drift = [] if values.drift is None else _drift_lines(values.drift)
    return [*accuracy, *jaw, *drift, f"new pose   {_recalibration_text(values.recalibration)}"]


def _jaw_accuracy_lines(jaw: expected.JawAccuracy) -> list[str]:
    unknown, growth = jaw.unknown, jaw.growth
    shift_m = [_JAW_ERROR_M * v for v in jaw.pose_per_jaw_m.tcp_m]
    separates = f"{'can hardly separate' if growth >= _POORLY else 'separates'} the opening from {jaw.like}"
    less = f"{growth:.1f} times less certain than with it"
    return [
        f"jaw        opening reported to {1e3 * jaw.reported_sigma_m:.3f} mm; if it were unknown:",
        f"           {_sigmas(unknown)}; opening {1e3 * unknown.jaw_m:.3f} mm",
        f"           the image {separates}: correlation {jaw.correlation:.2f}, {less}",
        f"           taken as exact but wrong by {1e3 * _JAW_ERROR_M:.3f} mm it shifts the TCP by {_mm(shift_m)} mm",
    ]


def _drift_lines(drift: expected.DriftForecast) -> list[str]:
    alarms, frames_per_s = drift.false_alarms_per_day, drift.frames_per_s
    lines = [
        f"drift      at most {alarms:g} false alarms a day at {frames_per_s:g} frames/s; where errors last for",
        f"           {drift.correlation_frames:.0f} frames the smallest step that is noticed: "
        + _sigmas(drift.smallest),
    ]
    lines.append("           on average, by means over 1, 2, 4 … 4096 frames, each complete one frame later:")
    for size, delays in drift.delay_frames.items():
        noticed = ", ".join(
            f"{axis} {'never' if frames is None else f'within {frames} frames'}"
            for axis, frames in zip("xyz", delays, strict=True)
        )
        lines.append(f"           a step of the TCP by {1e3 * float(size):g} mm is noticed along {noticed}")
    return lines


def _recalibration_text(values: expected.RecalibrationForecast) -> str:
    if not values.possible:
        return f"NOT from corners in this view: {values.reason}; past the limit the reference stays"
    where = "in one plane (4 are needed)" if values.coplanar else "(6 are needed)"
    text = f"past the limit from {values.corners} corners {where}"
    sigma_m, sure_m = values.sigma_m, values.sure_sigma_m
    if values.mode == "off" or sigma_m is None:
        return text
    if values.mode == "confirm":
        return f"{text}; an operator has to accept it (recalibration.mode)"
    if sigma_m <= sure_m:
        return f"{text}; certain to {1e3 * sigma_m:.3f} mm, taken without an operator up to {1e3 * sure_m:g} mm"
    asked = f"an operator has to accept most, above {1e3 * sure_m:g} mm (monitor.recalibration.sure_sigma_m)"
    return f"{text}; certain to {1e3 * sigma_m:.3f} mm: {asked}"


def _sigmas(values: expected.PoseValues | expected.UnknownJaw) -> str:
    x, y, z = (1e3 * v for v in values.tcp_m)
    a, b, c = (math.degrees(v) for v in values.rotation_rad)
    return f"TCP x {x:.3f}, y {y:.3f}, z {z:.3f} mm, turn about x {a:.3f}, y {b:.3f}, z {c:.3f}°"


def _mm(values: Sequence[float]) -> str:
    return "({:+.3f}, {:+.3f}, {:+.3f})".format(*(1e3 * v for v in values))


def _degrees(values: Sequence[float]) -> str:
    return "({:+.3f}, {:+.3f}, {:+.3f})".format(*(math.degrees(v) for v in values))


def _border_lines(values: forecasts.InView) -> list[str]:
    nearest, behind = values.border, values.behind_another_finger
    if nearest is None:
        return ["margin     NONE: no corner is visible"]
    sides = ", ".join(f"{side} {getattr(nearest, side):.0f}" for side in ("left", "right", "top", "bottom"))
    where = f"{nearest.corner}, {nearest.smallest_px:.0f} px from the {nearest.side} ({sides} px)"
    lines = [f"margin     nearest to the image's border is {where}"]
    return lines + ([f"           behind another finger: {', '.join(behind)}"] if behind else [])


def _camera_lines(values: forecasts.InView) -> list[str]:
    free = values.camera_may_move
    if free is None:
        return [f"           NOT enough to measure: {values.reason}"]
    shifts = ", ".join(f"{axis} {_span(free.shift_m[axis], 1e3, free.sought_m)}" for axis in _AXES)
    turns = ", ".join(f"{axis} {_span(free.turn_rad[axis], math.degrees(1.0), free.sought_rad)}" for axis in _AXES)
    lines = [
        f"           it can be measured until the camera shifts along its {shifts} mm",
        f"           or turns about its {turns}°; each alone{', at this opening' * (values.jaw_travel is not None)}",
    ]
    known = [
        (amount, f"{sign}{axis}", free.shift_reason[axis][k])
        for axis in _AXES
        for k, (sign, amount) in enumerate(zip("-+", free.shift_m[axis], strict=True))
        if amount is not None
    ]
    if known:
        amount_m, way, reason = min(known)
        lines.append(f"           the shortest way is {1e3 * amount_m:.1f} mm along {way}: then {reason}")
        if amount_m < values.limit_m:
            limit = f"{1e3 * values.limit_m:g} mm (monitor.policy.limit_m)"
            lines.append(f"           LESS than the shift past which the reference is measured again, {limit}")
    return lines


def _span(amounts: Sequence[float | None], factor: float, sought: float) -> str:
    """None: the limit is beyond the range searched."""
    low, high = (f"{'' if a is not None else 'beyond '}{sign}" for a, sign in zip(amounts, "-+", strict=True))
    low_amount, high_amount = (f"{factor * (sought if a is None else a):.1f}" for a in amounts)
    return f"{low}{low_amount} to {high}{high_amount}"


def _jaw_lines(jaw: jaw_travel.JawTravel | None) -> list[str]:
    if jaw is None:
        return []
    low_mm, high_mm = 1e3 * jaw.from_m, 1e3 * jaw.to_m
    corners, edges = (f"{low} to {high}" if low < high else str(low) for low, high in (jaw.corners, jaw.edges))
    travel = f"{_percent(jaw.share)} of {low_mm:g} to {high_mm:g} mm"
    gaps = [f"           NOT from {1e3 * gap.from_m:.2f} to {1e3 * gap.to_m:.2f} mm: {gap.reason}" for gap in jaw.gaps]
    seen = f"jaw travel enough is visible in {travel}; corners {corners}, edges {edges}"
    return [seen, *gaps, *_certainty_lines(jaw.certainty)]


def _certainty_lines(values: jaw_travel.OpeningCertainty) -> list[str]:
    from gripmon.daemon.findings import past_limit

    known = [(s, m) for m, s in zip(values.opening_m, values.worst_sigma_m, strict=True) if s is not None]
    if not known:
        return []
    least_m, at_m = max(known)
    lines = [f"           the TCP is least certain at {1e3 * at_m:.1f} mm of opening: to {1e3 * least_m:.3f} mm"]
    if (past := past_limit(values)) is not None:
        bounds = values.protection_m, values.protection_rad
        worst_m, worst_rad = (max(v for v in each if v is not None) for each in bounds)
        worst = f"{in_mm(worst_m)} mm, {in_degrees(worst_rad)} degrees"
        lines.append(
            f"           no transform is valid {past}: bounds of up to {worst} (monitor.policy.alert_limit_m, _rad)"
        )
    return lines


def _percent(share: float) -> str:
    """100 % and 0 % only if exact."""
    rounded = f"{100.0 * share:.1f}"
    if (rounded == "100.0" and share < 1.0) or (rounded == "0.0" and share > 0.0):
        return f"{'over 99.9' if share > 0.5 else 'under 0.1'} %"
    return f"{rounded.removesuffix('.0')} %"


def surrounding_lines(around: Surroundings) -> list[str]:
    """The source of frames, and the destinations of messages, recording and metrics."""
    source = around.source
    sections = {
        "source": f"{source.kind}: {'NOT REACHABLE: ' if source.reachable is False else ''}{source.detail}",
        "Zenoh": _zenoh_line(around.keys, around.zenoh),
        "recording": around.recording or "off",
        "metrics": around.metrics or "off",
    }
    return [f"{name:<10} {text}" for name, text in sections.items()]


def _zenoh_line(keys: str | None, session: Joining | None) -> str:
    if session is None:
        return "off"
    parts = [f"{keys}, {session.mode}"]
    parts += [f"{does} {', '.join(getattr(session, key))}" for key, does in _DOES.items() if getattr(session, key)]
    return ", ".join(parts) + (f" (by {session.file})" if session.file else "")
