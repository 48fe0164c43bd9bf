"""Prometheus metrics: the content of the state message, counts of alerts and verdicts, and a latency histogram.

The monitor's loop only updates a few counters (:class:`Tally`); a thread of the HTTP server turns them into metrics on
each scrape.  The text format comes from ``prometheus-client``, an optional dependency (``gripmon[metrics]``) that is
imported when the server starts.
"""

from __future__ import annotations

import errno
import importlib.util
import itertools
import logging
import socket
import threading
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

import msgspec
from msgspec import Meta

from gripmon.model.errors import InputError
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
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

_log = logging.getLogger(__name__)

_POLL_S = 0.1  # longest time that stopping waits for the server


LATENCY_BOUNDS_S = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0)
"""Upper bounds of the latency histogram's buckets, s; one more bucket is unbounded."""

_BOUNDS_NS = tuple(round(1e9 * bound) for bound in LATENCY_BOUNDS_S)
_COUNTED = (AlertEvent.RAISED, AlertEvent.NOTED)  # updates and ends are not counted as alerts


class Tally(Output):
    """An output that only counts and keeps the newest.  One thread puts; others read, at worst a frame apart."""

    name = "metrics"
    public = True

    def __init__(self) -> None:
        self.state_record: StateRecord | None = None
        self.record: FrameRecord | None = None
        self.latencies = [0] * (len(_BOUNDS_NS) + 1)
        self.latency_sum_ns = 0
        self.verdicts = dict.fromkeys(Verdict, 0)
        self.alerts: dict[tuple[AlertKind, Cause, Severity], int] = {}

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Count a frame."""
        self.latencies[bisect_left(_BOUNDS_NS, record.latency_ns)] += 1
        self.latency_sum_ns += record.latency_ns
        self.verdicts[record.verdict] += 1
        self.record = record

    def event(self, event: Event) -> None:
        """Keep the state; count an alert that is new."""
        if isinstance(event, StateRecord):
            self.state_record = event
        elif isinstance(event, AlertRecord) and event.event in _COUNTED:
            key = (event.kind, event.cause, event.severity)
            self.alerts[key] = self.alerts.get(key, 0) + 1


class MetricsError(InputError):
    """Metrics can't be served as configured: ``key: what is wrong; what would be right``."""


def package_fault(settings: MetricsSettings) -> tuple[str, str, str] | None:
    """Return key, what is wrong and what would be right if the package that the settings need is missing; else None."""
    if not settings.enabled or importlib.util.find_spec("prometheus_client") is not None:
        return None
    right = "pip install -e '.[metrics]' in gripmon's checkout, or enabled: false"
    return "metrics.enabled", "is true, but the package prometheus-client is missing", right


class MetricsServer(Tally):
    """An output that counts its records and serves the counts at ``/metrics``."""

    def __init__(self, settings: MetricsSettings, robot: str, camera: str) -> None:
        """Start listening immediately, in a separate thread.  Raises :class:`MetricsError`."""
        super().__init__()
        if (fault := package_fault(settings)) is not None:
            raise MetricsError("{}: {}; {}".format(*fault))
        from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app

        registry = CollectorRegistry(auto_describe=False)
        registry.register(cast(Any, Families(self, robot, camera)))
        ProcessCollector(registry=registry)
        try:
            self._server = _listen(settings.address, settings.port)
        except (OSError, UnicodeError) as error:  # UnicodeError: not a possible host name
            where = f"{settings.address}:{settings.port}"
            key, right = _remedy(error)
            reason = getattr(error, "strerror", None) or error
            raise MetricsError(f"metrics.{key}: can't listen at {where} ({reason}); {right}") from None
        self._server.set_app(make_wsgi_app(registry))
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="gripmon-metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening.  Calling it twice does nothing more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """One thread per request, so that a client that doesn't read its answer delays no one else."""

    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        _log.debug("metrics for %s", client_address, exc_info=True)  # client hung up; not a traceback on stderr


class _Handler(WSGIRequestHandler):
    timeout = 10.0  # s, for a client that connects and sends no request

    def log_message(self, format: str, *values: object) -> None:
        """Suppress the log line per request."""

    def address_string(self) -> str:
        return str(self.client_address[0])


def _listen(address: str, port: int) -> _Server:
    """Open the server.  OSError if it can't listen there, UnicodeError for an impossible host name."""
    family, *_, where = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    bound = type("_Bound", (_Server,), {"address_family": family})
    return cast(_Server, bound(where[:2], _Handler))


def _remedy(error: Exception) -> tuple[str, str]:
    if getattr(error, "errno", None) == errno.EADDRINUSE:
        return "port", "a port that no other program has, one for each monitor"
    if getattr(error, "errno", None) == errno.EACCES:
        return "port", "a port from 1024 on"
    return "address", "an address of this machine, 127.0.0.1 for itself alone"


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


class _Family(NamedTuple):
    """A metric: name, help text, and samples by the values of its ``labels`` (robot and camera are added to these)."""

    kind: Literal["counter", "gauge"]
    name: str
    text: str
    samples: Mapping[Any, float]
    labels: tuple[str, ...] = ()


class Families:
    """A ``prometheus_client`` collector, called in the HTTP server's thread: the counts and the newest state, with
    names and units by Prometheus's conventions.  An unknown value has no sample, because a zero would look healthy.
    """

    def __init__(self, tally: Tally, robot: str, camera: str) -> None:
        self._tally = tally
        self._who = (robot, camera)

    def collect(self) -> Iterator[Metric]:
        """Yield all metric families, from the newest state and the frames so far."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

        kinds = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}
        state = self._tally.state_record
        for each in (*(() if state is None else _of_state(state)), *_of_frames(self._tally)):
            family = kinds[each.kind](each.name, each.text, labels=("robot", "camera", *each.labels))
            for values, number in each.samples.items():
                family.add_metric((*self._who, *values), number)
            yield family
        latency = HistogramMetricFamily(
            "gripmon_latency_seconds",
            "Time from a frame's arrival at the machine to its verdict",
            labels=("robot", "camera"),
        )
        latency.add_metric(self._who, _cumulative(self._tally.latencies[:]), 1e-9 * self._tally.latency_sum_ns)
        yield latency


def _of_state(state: StateRecord) -> Iterator[_Family]:
    for name, text, count in (
        ("gripmon_frames", "Frames processed", state.frames),
        ("gripmon_frames_refused", "Frames that could not be measured at all", state.frames_refused),
        ("gripmon_frames_dropped", "Frames dropped because another one was being processed", state.frames_dropped),
        ("gripmon_recording_dropped", "Frames missing in the recording", state.recording_dropped),
        ("gripmon_recording_images_dropped", "Images missing in the recording", state.recording_images_dropped),
        ("gripmon_transforms_unsent", "Transforms not sent because there was no session yet", state.transforms_unsent),
        ("gripmon_messages_malformed", "Malformed messages received", state.malformed),
    ):
        yield _Family("counter", name, text, {} if count is None else {(): count})
    for name, text, value in (
        ("gripmon_frames_per_second", "Recent frame rate; 0 without frames", state.frames_per_s),
        ("gripmon_uptime_seconds", "Time since the monitor's start", state.uptime_s),
        ("gripmon_camera_connected", "1 while the source is open", float(state.camera_connected)),
        ("gripmon_reference_revision", "Revision of the reference in force", state.revision),
        ("gripmon_state_timestamp_seconds", "Time of the last state message, Unix time", 1e-9 * state.stamp_ns),
        ("gripmon_sigma_meters", "Largest standard deviation of the TCP along a camera axis", state.sigma_m),
        ("gripmon_protection_meters", "Bound on the TCP's position error", state.protection_m),
        ("gripmon_alert_limit_meters", "Position error of the TCP that the task tolerates", state.alert_limit_m),
    ):
        yield _Family("gauge", name, text, {} if value is None else {(): value})
    text = "1 for the error that protection bounds: absolute, or reference, of the motion since the reference"
    by = {} if state.valid_by is None else {(each.value,): float(each is state.valid_by) for each in ValidBy}
    yield _Family("gauge", "gripmon_valid_by", text, by, ("valid_by",))
    shift = {(axis,): value for axis, value in zip("xyz", state.tcp_shift_m or (), strict=False)}
    text = "Displacement of the TCP from the reference, along the camera's axes"
    yield _Family("gauge", "gripmon_tcp_shift_meters", text, shift, ("axis",))
    text, version = "Always 1: the version and the reference", {(state.version, state.reference_id): 1.0}
    yield _Family("gauge", "gripmon_info", text, version, ("version", "reference"))
    # One sample per state, 1 for the current one, even if this version doesn't know that state's name.
    states = {(each.value,): 0.0 for each in State} | {(str(state.state),): 1.0}
    yield _Family("gauge", "gripmon_state", "1 for the monitor's current state", states, ("state",))
    verdicts = {(each.value,): 0.0 for each in Verdict} | {(str(state.verdict),): 1.0}
    yield _Family("gauge", "gripmon_verdict", "1 for the last transform's verdict", verdicts, ("verdict",))
    severities = [alert.severity for alert in state.open_alerts]
    open_alerts = {(severity.value,): float(severities.count(severity)) for severity in Severity}
    yield _Family("gauge", "gripmon_open_alerts", "Alerts raised and not cleared", open_alerts, ("severity",))


def _of_frames(tally: Tally) -> Iterator[_Family]:
    verdicts = {(verdict.value,): float(count) for verdict, count in tally.verdicts.items()}
    yield _Family("counter", "gripmon_verdicts", "Frames by verdict", verdicts, ("verdict",))
    record = tally.record
    known = record is not None and record.verdict is not Verdict.UNKNOWN and record.drift is not None
    turn = {(): record.drift.rotation_rad} if known and record and record.drift else {}
    yield _Family("gauge", "gripmon_rotation_radians", "Rotation of the camera from the reference", turn)
    # Copied, because the loop may add an entry meanwhile.
    alerts = {tuple(n.value for n in names): float(count) for names, count in dict(tally.alerts).items()}
    yield _Family("counter", "gripmon_alerts", "Alerts raised or noted", alerts, ("kind", "cause", "severity"))


def _cumulative(counts: list[int]) -> list[tuple[str, float]]:
    """Cumulative buckets, as in the text format: each counts all values below its bound."""
    totals = itertools.accumulate(counts)
    return [(bound, float(total)) for bound, total in zip((*map(str, LATENCY_BOUNDS_S), "+Inf"), totals, strict=True)]
