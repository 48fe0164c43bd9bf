"""What ``gripmon check`` says first: one line for each thing that matters, OK, WARN or FAIL."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

from gripmon.daemon.forecast_values import (
    CameraValues,
    Forecast,
    GripperValues,
    InView,
    JawTravelForecast,
    JawValues,
    OpeningCertainty,
    RecalibrationForecast,
    ReferenceValues,
)
from gripmon.daemon.surroundings import SourceReport, Surroundings

Level = Literal["OK", "WARN", "FAIL"]

_USUAL_SPREAD = 2.0
"""By how much the bound of one frame in twenty is larger than the foreseen one (no unit; docs/integrity.md)."""


class Finding(NamedTuple):
    """``FAIL``: the monitor can't do its work so; ``WARN``: it can, but not all that is expected of it."""

    level: Level
    about: str
    text: str


def findings(forecast: Forecast, around: Surroundings) -> list[Finding]:
    """What to know of a wrist camera's configuration before it runs."""
    found = [
        _source(around.source),
        _camera(forecast.camera),
        _mount(forecast.reference),
        _view(forecast.in_view, forecast.gripper),
        _promise(forecast),
        _jaw_travel(forecast.in_view.jaw_travel, forecast.jaw),
        _recalibration(forecast.accuracy.recalibration),
        _network(around.keys),
    ]
    return [each for each in found if each is not None]


def second_findings(report: dict[str, Any], around: Surroundings) -> list[Finding]:
    """Those about a second camera."""
    calibration, watch, pulses = report["calibration"], report["watch"], report["pulses"]
    spots = f"{calibration['used']} of {calibration['spots']} spots, RMS {calibration['rms_px']:.2f} px"
    size = f"{calibration['width_px']} x {calibration['height_px']} px"
    limits = f"a warning from {1e3 * watch['warn_m']:g} mm, an error from {1e3 * watch['limit_m']:g} mm"
    table = pulses["table"]
    heard = f"by the robot's program on {pulses['key']}" if table is None else f"{pulses['count']} in {table}"
    return [
        _source(around.source),
        Finding("OK", "calibration", f"{size}, {spots}"),
        Finding("OK", "watch", limits),
        Finding("OK", "pulses", heard),
        _network(around.keys),
    ]


def _source(source: SourceReport) -> Finding:
    if source.reachable is False:
        return Finding("FAIL", "source", f"{source.kind}: NOT REACHABLE: {source.detail}")
    text = f"{source.kind}: {source.detail}"
    return Finding("WARN", "source", f"{text}; {source.odd}") if source.odd else Finding("OK", "source", text)


def _camera(camera: CameraValues) -> Finding:
    across, down = (math.degrees(angle) for angle in camera.field_of_view_rad)
    size = f"{camera.width_px} x {camera.height_px} px"
    return Finding("OK", "camera", f"{size}, {camera.model} lens, sees about {across:.0f}° x {down:.0f}°")


def _mount(reference: ReferenceValues) -> Finding:
    """The gripper's z axis points out of the gripper: a camera on the wrist is on its negative side."""
    ahead_m = reference.camera_ahead_m
    if ahead_m <= 0.0:
        way = f"which looks along the fingers at {math.degrees(reference.tilt_rad):.0f}°"
        text = f"TCP {1e3 * reference.distance_m:.1f} mm from the camera, {way}"
        return Finding("OK", "mount", text)
    text = f"the camera would be {1e3 * ahead_m:.0f} mm in front of the fingertips, looking back at the gripper"
    if reference.sound_as_wxyz:
        right = "rotation_xyzw read as w, x, y, z puts it behind them: write x, y, z, w"
        return Finding("FAIL", "mount", f"{text}; {right} (reference.cam_T_grip)")
    return Finding("WARN", "mount", f"{text}; a camera on the wrist is behind them (reference.cam_T_grip)")


def _view(in_view: InView, gripper: GripperValues) -> Finding:
    if not in_view.enough:
        return Finding("FAIL", "view", f"nothing can be measured: {in_view.reason}")
    seen = f"{in_view.corners} of {gripper.corners} corners and {in_view.edges} edges can be measured"
    spans = {} if in_view.camera_may_move is None else in_view.camera_may_move.shift_m
    shifts = [amount for span in spans.values() for amount in span if amount is not None]
    if not shifts:
        return Finding("OK", "view", seen)
    shortest_m, limit_m = min(shifts), in_view.limit_m
    text = f"{seen}; too few once the camera shifts by {1e3 * shortest_m:.1f} mm"
    if shortest_m < limit_m:
        limit = f"{1e3 * limit_m:g} mm (monitor.policy.limit_m)"
        return Finding("WARN", "view", f"{text}: less than the shift that leads to a recalibration, {limit}")
    if not gripper.faces:
        unknown = "the gripper file has no faces, so what a finger itself hides isn't known"
        return Finding("WARN", "view", f"{text}; {unknown}")
    return Finding("OK", "view", text)


def _promise(report: Forecast) -> Finding | None:
    found = report.protection
    if found is None:
        return None  # the line about the view says why
    limit_m, limit_rad = report.alert_limit_m, report.alert_limit_rad
    share = max(found.position_m / limit_m, found.rotation_rad / limit_rad)
    good = f"{_millimetres(found.position_m)} and {_degrees(found.rotation_rad)}"
    limit = f"the alert limit of {_millimetres(limit_m)} and {_degrees(limit_rad)}"
    if share > 1.0:
        text = f"no transform can be valid: good to {good}, beyond {limit}; valid needs {report.needed}"
        return Finding("WARN", "promise", text)
    if _USUAL_SPREAD * share > 1.0:
        often = "one frame in twenty is twice as uncertain: some will be suspect"
        return Finding("WARN", "promise", f"good to {good}, close to {limit}; {often}")
    return Finding("OK", "promise", f"a transform is good to {good}, within {limit}")


def _jaw_travel(travel: JawTravelForecast | None, jaw: JawValues) -> Finding | None:
    if travel is None:
        return None
    if jaw.source == "fixed" and jaw.opening_m is not None:
        return Finding("OK", "jaw travel", f"none: the opening is fixed at {1e3 * jaw.opening_m:.1f} mm")
    gaps = [f"from {1e3 * gap.from_m:.1f} to {1e3 * gap.to_m:.1f} mm" for gap in travel.gaps]
    span = f"{1e3 * travel.from_m:g} to {1e3 * travel.to_m:g} mm"
    texts = [f"nothing can be measured {', '.join(gaps)}"] if gaps else []
    past = past_limit(travel.certainty)
    texts += [f"every transform is suspect {past}"] if past is not None else []
    if texts:
        return Finding("WARN", "jaw travel", f"of {span}: {'; '.join(texts)}")
    return Finding("OK", "jaw travel", f"{span}, within the alert limit all the way")


def past_limit(certainty: OpeningCertainty) -> str | None:
    """At which openings the bounds exceed the alert limits, in words; None for nowhere.

    Neighbours among the openings that were looked at make a span.
    """
    limit_m, limit_rad = certainty.alert_limit_m, certainty.alert_limit_rad
    rows = zip(certainty.opening_m, certainty.protection_m, certainty.protection_rad, strict=True)
    spans: list[list[float]] = []
    before = False
    for opening_m, bound_m, bound_rad in rows:
        past = bound_m is not None and bound_rad is not None and (bound_m > limit_m or bound_rad > limit_rad)
        if past and before:
            spans[-1][1] = opening_m
        elif past:
            spans.append([opening_m, opening_m])
        before = past
    return " and ".join(_span(1e3 * low, 1e3 * high) for low, high in spans) or None


def _span(low_mm: float, high_mm: float) -> str:
    return f"at {low_mm:.1f} mm" if low_mm == high_mm else f"from {low_mm:.1f} to {high_mm:.1f} mm"


def _recalibration(values: RecalibrationForecast) -> Finding:
    if not values.possible:
        text = f"the reference can't be measured anew from the corners in view: {values.reason}"
        return Finding("WARN", "recalibration", text)
    return Finding("OK", "recalibration", f"possible, from {values.corners} corners")


def _network(keys: str | None) -> Finding:
    return Finding("OK", "network", "off" if keys is None else f"Zenoh keys {keys}…")


def _millimetres(value_m: float) -> str:
    return f"{1e3 * value_m:.2g} mm"


def _degrees(value_rad: float) -> str:
    return f"{math.degrees(value_rad):.2g}°"
