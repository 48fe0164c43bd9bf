"""Prometheus metrics: the content of the state message, counts of alerts and verdicts, and a latency histogram.

Served by ``prometheus-client``, an optional dependency (``gripmon[metrics]``) that is imported when the server starts.
"""

from __future__ import annotations

import errno
import importlib.util
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, cast

import msgspec
from msgspec import Meta

from gripmon.model.errors import InputError
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    Frame,
    FrameRecord,
    Severity,
    State,
    StateRecord,
    ValidBy,
    Verdict,
)

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

LATENCY_BOUNDS_S = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0)
"""Upper bounds of the latency histogram's buckets, s; one more bucket is unbounded."""

_WHO = ("robot", "camera")
_COUNTED = (AlertEvent.RAISED, AlertEvent.NOTED)  # updates and ends are not counted as alerts


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where Prometheus finds the metrics: ``http://<address>:<port>/metrics``."""

    enabled: Annotated[bool, Meta(description="true: metrics for Prometheus over HTTP")] = False
    address: Annotated[
        str,
        Meta(
            min_length=1,
            description="address to listen on, from which anyone may read; 0.0.0.0: all network interfaces",
        ),
    ] = "127.0.0.1"
    port: Annotated[
        int, Meta(ge=1, le=65535, description="TCP port; each monitor on a machine needs its own (no unit)")
    ] = 9464


class MetricsError(InputError):
    """Metrics can't be served as configured: ``key: what is wrong; what would be right``."""


def package_fault(settings: MetricsSettings) -> tuple[str, str, str] | None:
    """Return key, what is wrong and what would be right if the package that the settings need is missing; else None."""
    if not settings.enabled or importlib.util.find_spec("prometheus_client") is not None:
        return None
    right = "pip install -e '.[metrics]' in gripmon's checkout, or enabled: false"
    return "metrics.enabled", "is true, but the package prometheus-client is missing", right


class MetricsServer(Output):
    """An output that counts its records and serves the counts, and the newest state, at ``/metrics``.

    The names and units are by Prometheus's conventions.  An unknown value has no sample, because a zero would look
    healthy.
    """

    name = "metrics"
    public = True

    def __init__(self, settings: MetricsSettings, robot: str, camera: str) -> None:
        """Start listening immediately, in a separate thread.  Raises :class:`MetricsError`."""
        if (fault := package_fault(settings)) is not None:
            raise MetricsError("{}: {}; {}".format(*fault))
        import prometheus_client as prometheus

        prometheus.disable_created_metrics()  # type: ignore[no-untyped-call]
        registry = prometheus.CollectorRegistry(auto_describe=False)
        who = self._who = (robot, camera)
        self._state: StateRecord | None = None
        self._record: FrameRecord | None = None
        text = "Time from a frame's arrival at the machine to its verdict"
        self._latency = prometheus.Histogram(
            "gripmon_latency_seconds", text, _WHO, buckets=LATENCY_BOUNDS_S, registry=registry
        ).labels(*who)
        verdicts = prometheus.Counter("gripmon_verdicts", "Frames by verdict", (*_WHO, "verdict"), registry=registry)
        self._verdicts = {verdict: verdicts.labels(*who, verdict.value) for verdict in Verdict}
        labels = (*_WHO, "kind", "cause", "severity")
        self._alerts = prometheus.Counter("gripmon_alerts", "Alerts raised or noted", labels, registry=registry)
        prometheus.ProcessCollector(registry=registry)
        registry.register(self)
        try:
            self._server, self._thread = prometheus.start_http_server(settings.port, settings.address, registry)
        except (OSError, UnicodeError) as error:  # UnicodeError: not a possible host name
            where = f"{settings.address}:{settings.port}"
            key, right = _remedy(error)
            reason = getattr(error, "strerror", None) or error
            raise MetricsError(f"metrics.{key}: can't listen at {where} ({reason}); {right}") from None
        # A client that sends no request would keep a thread for ever, one that hung up be a traceback on stderr.
        handler = cast(type, self._server.RequestHandlerClass)
        self._server.RequestHandlerClass = type("_Handler", (handler,), {"timeout": 10.0})
        self._server.handle_error = lambda *_: None  # type: ignore[method-assign]

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Count a frame."""
        self._latency.observe(record.latency_ns / 1e9)
        self._verdicts[record.verdict].inc()
        self._record = record

    def event(self, event: Event) -> None:
        """Keep the state; count an alert that is new."""
        if isinstance(event, StateRecord):
            self._state = event
        elif isinstance(event, AlertRecord) and event.event in _COUNTED:
            self._alerts.labels(*self._who, event.kind.value, event.cause.value, event.severity.value).inc()

    def close(self) -> None:
        """Stop listening.  Calling it twice does nothing more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def collect(self) -> Iterator[Metric]:
        """For ``prometheus_client``: what isn't counted frame by frame, from the newest state and frame."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        def family(kind: type[Any], name: str, text: str, samples: Mapping[str, float], *labels: str) -> Metric:
            made = kind(name, text, labels=(*_WHO, *labels))
            for value, number in samples.items():
                made.add_metric((*self._who, *([value] if labels else ())), number)
            return made

        state, record = self._state, self._record
        if state is not None:
            for name, (text, count) in _counts(state).items():
                yield family(CounterMetricFamily, name, text, {} if count is None else {"": count})
            for name, (text, value) in _values(state).items():
                yield family(GaugeMetricFamily, name, text, {} if value is None else {"": value})
            for name, (text, label, samples) in _by_label(state).items():
                yield family(GaugeMetricFamily, name, text, samples, label)
            info = GaugeMetricFamily(
                "gripmon_info", "Always 1: the version and the reference", labels=(*_WHO, "version", "reference")
            )
            info.add_metric((*self._who, state.version, state.reference_id), 1.0)
            yield info
        turn = {}
        if record is not None and record.verdict is not Verdict.UNKNOWN and record.drift is not None:
            turn = {"": record.drift.rotation_rad}
        yield family(GaugeMetricFamily, "gripmon_rotation_radians", "Rotation of the camera from the reference", turn)


def _counts(state: StateRecord) -> dict[str, tuple[str, int | None]]:
    return {
        "gripmon_frames": ("Frames processed", state.frames),
        "gripmon_frames_refused": ("Frames that could not be measured at all", state.frames_refused),
        "gripmon_frames_dropped": (
            "Frames dropped because another one was being processed",
            state.frames_dropped,
        ),
        "gripmon_recording_dropped": ("Frames missing in the recording", state.recording_dropped),
        "gripmon_recording_images_dropped": ("Images missing in the recording", state.recording_images_dropped),
        "gripmon_transforms_unsent": (
            "Transforms not sent because there was no session yet",
            state.transforms_unsent,
        ),
        "gripmon_messages_malformed": ("Malformed messages received", state.malformed),
    }


def _values(state: StateRecord) -> dict[str, tuple[str, float | None]]:
    return {
        "gripmon_frames_per_second": ("Recent frame rate; 0 without frames", state.frames_per_s),
        "gripmon_uptime_seconds": ("Time since the monitor's start", state.uptime_s),
        "gripmon_camera_connected": ("1 while the source is open", float(state.camera_connected)),
        "gripmon_reference_revision": ("Revision of the reference in force", state.revision),
        "gripmon_state_timestamp_seconds": ("Time of the last state message, Unix time", 1e-9 * state.stamp_ns),
        "gripmon_sigma_meters": ("Largest standard deviation of the TCP along a camera axis", state.sigma_m),
        "gripmon_protection_meters": ("Bound on the TCP's position error", state.protection_m),
        "gripmon_alert_limit_meters": ("Position error of the TCP that the task tolerates", state.alert_limit_m),
    }


def _by_label(state: StateRecord) -> dict[str, tuple[str, str, dict[str, float]]]:
    severities = [alert.severity for alert in state.open_alerts]
    return {
        "gripmon_valid_by": (
            "1 for the error that protection bounds: absolute, or reference, of the motion since the reference",
            "valid_by",
            {} if state.valid_by is None else {each.value: float(each is state.valid_by) for each in ValidBy},
        ),
        "gripmon_tcp_shift_meters": (
            "Displacement of the TCP from the reference, along the camera's axes",
            "axis",
            dict(zip("xyz", state.tcp_shift_m or (), strict=False)),
        ),
        # One sample per state, 1 for the current one, even if this version doesn't know that state's name.
        "gripmon_state": (
            "1 for the monitor's current state",
            "state",
            {each.value: 0.0 for each in State} | {str(state.state): 1.0},
        ),
        "gripmon_verdict": (
            "1 for the last transform's verdict",
            "verdict",
            {each.value: 0.0 for each in Verdict} | {str(state.verdict): 1.0},
        ),
        "gripmon_open_alerts": (
            "Alerts raised and not cleared",
            "severity",
            {severity.value: float(severities.count(severity)) for severity in Severity},
        ),
    }


def _remedy(error: Exception) -> tuple[str, str]:
    if getattr(error, "errno", None) == errno.EADDRINUSE:
        return "port", "a port that no other program has, one for each monitor"
    if getattr(error, "errno", None) == errno.EACCES:
        return "port", "a port from 1024 on"
    return "address", "an address of this machine, 127.0.0.1 for itself alone"
