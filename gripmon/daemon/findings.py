"""The findings of ``gripmon check``: one line each, OK, WARN or FAIL; and the monitor's surroundings: network, source,
recording, metrics.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import urlsplit

import msgspec

from gripmon.daemon.api import look_ahead
from gripmon.daemon.config import Config, check_network, load_config
from gripmon.daemon.forecast import (
    CameraValues,
    Forecast,
    GripperValues,
    InView,
    JawValues,
    ReferenceValues,
    forecast,
)
from gripmon.daemon.promised import images_of, kept_of, picture_of
from gripmon.io.sources import LiveSettings, NetworkSettings, Ros2CameraSettings
from gripmon.io.sources.live import shown_name
from gripmon.io.wire import Joining, Keys
from gripmon.model.gripper import UNTOLD_BEVEL_M
from gripmon.model.units import in_degrees, in_mm
from gripmon.teach.accuracy import RecalibrationForecast
from gripmon.teach.jaw_travel import JawTravel, OpeningCertainty
from gripmon.teach.kept import USUAL_SPREAD, Kept

Level = Literal["OK", "WARN", "FAIL"]

_NOT_SQUARE = 0.02
"""Largest difference of fx / fy from 1 in a calibration of a sensor with square pixels (no unit)."""
_PORTS = {"rtsp": 554, "http": 80, "https": 443, "rtmp": 1935}
_CONNECT_S = 2.0


class Finding(NamedTuple):
    """``FAIL``: the monitor can't work like this; ``WARN``: it can, but not as expected."""

    level: Level
    about: str
    text: str


class SourceReport(msgspec.Struct, frozen=True):
    """Whether the source can deliver frames now (``reachable`` None: only running it would show); ``odd``: what is odd
    about it.
    """

    kind: str
    reachable: bool | None
    detail: str
    odd: str | None = None


class Surroundings(msgspec.Struct, frozen=True):
    """Destinations of messages, recording and metrics (None: none), and the source of frames."""

    keys: str | None
    recording: str | None
    metrics: str | None
    zenoh: Joining | None
    source: SourceReport


@dataclass(frozen=True)
class CheckResult:
    """A checked configuration: a ``forecast`` and the surroundings; ``kept``: what the monitor says over the
    ``images``, None where there are none.
    """

    forecast: Forecast
    around: Surroundings
    kept: Kept | None = None
    images: str = ""
    draw: Callable[[str], bytes | None] | None = None

    def picture(self, ending: str) -> bytes | None:
        """The first image with what costs most drawn in it, in the format of an ``ending``; None where there is no
        image.
        """
        return None if self.draw is None else self.draw(ending)

    def values(self) -> dict[str, Any]:
        """Everything as plain values for JSON."""
        around = msgspec.to_builtins(self.around)
        kept = {"kept": msgspec.to_builtins(self.kept), "kept_over": self.images}
        return {**msgspec.to_builtins(self.forecast), **kept, **around}

    @property
    def findings(self) -> list[Finding]:
        """What to know about the configuration before it runs."""
        keys = self.around.keys
        network = Finding("OK", "network", "off" if keys is None else f"Zenoh keys {keys}…")
        found = [_source(self.around.source), *_of_config(self.forecast, self.kept, self.images), network]
        return [each for each in found if each is not None]


def check_file(path: Path, images: Path | None = None) -> CheckResult:
    """Check a configuration file.  ``images``: of the gripper at the reference, to judge by instead of the
    configuration's own.  Raises :class:`ConfigError`, and :class:`NoResultError` if recorded frames can't be used.
    """
    config = load_config(path)
    around, foreseen, found = _look_around(config), forecast(config), images_of(config, images)
    if found is None or not foreseen.in_view.enough:
        return CheckResult(foreseen, around)
    said = kept_of(config, found)
    return CheckResult(foreseen, around, said, found.what, partial(picture_of, config, found, said))


def _look_around(config: Config) -> Surroundings:
    """Check what the configuration names; nothing is joined or started except a connection to a camera's address.

    Raises :class:`ConfigError` for a network that can't be joined or frames that don't fit, and :class:`NoResultError`
    if no recorded frame can be read.
    """
    settings, metrics = config.settings, config.settings.metrics
    joining = check_network(config)
    return Surroundings(
        keys=f"gripmon/{settings.robot}/{settings.camera_name}/" if settings.publish.enabled else None,
        recording=settings.recording.directory if settings.recording.enabled else None,
        metrics=f"http://{metrics.address}:{metrics.port}/metrics" if metrics.enabled else None,
        zenoh=joining,
        source=_source_report(config),
    )


def _source_report(config: Config) -> SourceReport:
    source = config.settings.source
    kind = str(type(source).__struct_config__.tag)
    if (recorded := look_ahead(config)) is not None:
        return SourceReport(kind, True, *recorded)
    if isinstance(source, LiveSettings):
        return SourceReport(kind, *_live_reachable(source))
    if isinstance(source, NetworkSettings):
        key = source.key or Keys(config.settings.robot, config.settings.camera_name)["image"]
        return SourceReport(kind, None, f"frames on {key}; only running it shows whether any arrive")
    if isinstance(source, Ros2CameraSettings):
        return SourceReport(kind, None, f"images on {source.image}; only running it shows whether any arrive")
    return SourceReport(kind, True, "made by this program")


def _live_reachable(source: LiveSettings) -> tuple[bool | None, str]:
    device = source.device
    if isinstance(device, int) or device.isdecimal():
        device = f"/dev/video{device}"
    if device.startswith("/dev/"):
        exists = Path(device).exists()
        return exists, device if exists else f"{device} is not there now; run keeps trying"
    address = urlsplit(device)
    if address.scheme in _PORTS and address.hostname:
        where = (address.hostname, address.port or _PORTS[address.scheme])
        try:
            with socket.create_connection(where, timeout=_CONNECT_S):
                return True, f"{where[0]}:{where[1]} answers"
        except OSError as error:
            return False, f"{where[0]}:{where[1]} does not answer ({error.strerror or error}); run keeps trying"
    return None, f"{shown_name(device)}; only running it shows whether it delivers"


def _of_config(forecast: Forecast, kept: Kept | None, images: str) -> list[Finding | None]:
    return [
        _camera(forecast.camera),
        _jaw_motion(forecast.gripper),
        _mount(forecast.reference),
        _view(forecast.in_view, forecast.gripper, forecast.accuracy.corners),
        _promise(forecast, kept, images),
        None if forecast.doubt is None else Finding("WARN", "reference", forecast.doubt),
        _jaw_travel(forecast.in_view.jaw_travel, forecast.jaw),
        _recalibration(forecast.accuracy.recalibration),
    ]


def _source(source: SourceReport) -> Finding:
    if source.reachable is False:
        return Finding("FAIL", "source", f"{source.kind}: NOT REACHABLE: {source.detail}")
    text = f"{source.kind}: {source.detail}"
    return Finding("WARN", "source", f"{text}; {source.odd}") if source.odd else Finding("OK", "source", text)


def _camera(camera: CameraValues) -> Finding:
    across, down = (math.degrees(angle) for angle in camera.field_of_view_rad)
    size = f"{camera.width_px} x {camera.height_px} px"
    text = f"{size}, {camera.model} lens, sees about {across:.0f}° x {down:.0f}°"
    if abs(camera.fx_px / camera.fy_px - 1.0) > _NOT_SQUARE:
        lengths = f"fx {camera.fx_px:g} px and fy {camera.fy_px:g} px"
        odd = f"{lengths} make pixels that aren't square, as those of nearly all sensors are: is one of them wrong?"
        return Finding("WARN", "camera", f"{text}; {odd}")
    return Finding("OK", "camera", text)


def _jaw_motion(gripper: GripperValues) -> Finding | None:
    """The opening is the distance between the fingers, up to a constant."""
    rate = gripper.apart_rate
    if rate is None or 0.5 < rate < 1.5:
        return None
    text = f"two fingers move apart by {rate:.2g} mm for each millimetre of opening, where 1 is expected"
    return Finding("WARN", "jaw", f"{text}: check the signs and lengths of `axis` (fingers in {gripper.file})")


def _mount(reference: ReferenceValues) -> Finding:
    """The gripper's z axis points out of the gripper, so a wrist camera is on its negative side."""
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


def _view(in_view: InView, gripper: GripperValues, measured: int) -> Finding:
    """``measured``: how many of the corners in view can be."""
    if not in_view.enough:
        return Finding("FAIL", "view", f"nothing can be measured: {in_view.reason}")
    few = gripper.corners < in_view.corners_needed  # then ends of curves or edges are used instead
    corners = f"{in_view.corners} points" if few else f"{in_view.corners} of {gripper.corners} corners"
    edges = f"{in_view.edges} edges"
    seen = f"{corners} and {edges} can be measured"
    if in_view.corners and not few and not measured:
        why = "the edges at each are too short in the image, or parallel, so that nothing shows where the fingers end"
        text = f"{edges} can be measured, but none of the {in_view.corners} corners in view: {why}"
        return Finding("WARN", "view", f"{text}; mark others (corner: true)")
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
        unknown = "the gripper file has no faces, so self-occlusion isn't known"
        return Finding("WARN", "view", f"{text}; {unknown}")
    return Finding("OK", "view", text)


def _promise(report: Forecast, found: Kept | None, what: str) -> Finding | None:
    """By images, else by the forecast; None where nothing is in view, which the line about the view says."""
    if found is not None:
        text = f"over {what}: {found.promise() if found.images else 'none can be read'}"
        return Finding("OK" if found.reachable else "WARN", "promise", text)
    bound, bevelled = report.protection, report.protection_if_bevelled
    if bound is None:
        return None
    limit_m, limit_rad = report.alert_limit_m, report.alert_limit_rad
    sure = max(bound.position_m / limit_m, bound.rotation_rad / limit_rad) * USUAL_SPREAD <= 1.0
    text = f"forecast without images (--images gives what frames keep){report.promise.removeprefix('forecast')}"
    if report.reachable and bevelled and (bevelled.position_m > limit_m or bevelled.rotation_rad > limit_rad):
        good, sure = f"{in_mm(bevelled.position_m)} mm and {in_degrees(bevelled.rotation_rad)}°", False
        text += (
            "; that holds if all edges are as sharp as the gripper file says, with bevels of "
            f"{in_mm(UNTOLD_BEVEL_M)} mm it is good to {good}: teach them (gripmon teach), or state them (bevel_m)"
        )
    return Finding("OK" if sure else "WARN", "promise", text)


def _jaw_travel(travel: JawTravel | None, jaw: JawValues) -> Finding | None:
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
    return Finding("OK", "jaw travel", f"{span}, within the alert limit throughout")


def past_limit(certainty: OpeningCertainty) -> str | None:
    """The openings at which the bounds exceed the alert limits, in words; None if there are none.

    Neighbouring sampled openings are joined to a span.
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
    texts = (
        f"at {1e3 * low:.1f} mm" if low == high else f"from {1e3 * low:.1f} to {1e3 * high:.1f} mm"
        for low, high in spans
    )
    return " and ".join(texts) or None


def _recalibration(values: RecalibrationForecast) -> Finding:
    if not values.possible:
        text = f"the reference can't be measured again from the corners in view: {values.reason}"
        return Finding("WARN", "recalibration", text)
    return Finding("OK", "recalibration", f"possible, from {values.corners} corners")
