"""Prometheus metrics: the content of the state message, counts of alerts and verdicts, and a latency histogram.

Served by ``prometheus-client``, an optional dependency (``gripmon[metrics]``) that is imported when the server starts.
"""

from __future__ import annotations

import errno
import functools
import importlib.util
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import msgspec
import msgspec.inspect as kinds
from msgspec import Meta

from gripmon.model.errors import InputError
from gripmon.model.fields import Field, fields_of
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    Frame,
    FrameRecord,
    Severity,
    StateRecord,
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

        def made(name: str, **more: Any) -> Any:
            kind, labels, text = OTHER_METRICS[name]
            return getattr(prometheus, kind.capitalize())(name, text, (*_WHO, *labels), registry=registry, **more)

        self._latency = made("gripmon_latency_seconds", buckets=LATENCY_BOUNDS_S).labels(*who)
        verdicts = made("gripmon_verdicts_total")
        self._verdicts = {verdict: verdicts.labels(*who, verdict.value) for verdict in Verdict}
        self._alerts = made("gripmon_alerts_total")
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

        families: dict[str, type[Any]] = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}
        state, record = self._state, self._record
        for metric in state_metrics() if state is not None else ():
            family = families[metric.kind](metric.name, metric.help, labels=(*_WHO, *metric.labels))
            for values, number in metric.samples(state).items():
                family.add_metric((*self._who, *values), number)
            yield family
        turn = GaugeMetricFamily("gripmon_rotation_radians", OTHER_METRICS["gripmon_rotation_radians"][2], labels=_WHO)
        if record is not None and record.verdict is not Verdict.UNKNOWN and record.drift is not None:
            turn.add_metric(self._who, record.drift.rotation_rad)
        yield turn


class StateMetric(NamedTuple):
    """A metric of the state message: its samples by the values of ``labels``, none where the value is unknown."""

    name: str
    kind: Literal["counter", "gauge"]
    help: str
    labels: tuple[str, ...]
    samples: Callable[[Any], dict[tuple[str, ...], float]]


_SPELLED = {
    "m": ("_meters", 1.0), "rad": ("_radians", 1.0), "s": ("_seconds", 1.0), "1/s": ("_per_second", 1.0),
    "ns": ("_seconds", 1e-9),
}  # fmt: skip
"""Units in names by Prometheus's conventions, and what a value in ours is multiplied by."""
_RENAMED = {"revision": "reference_revision", "malformed": "messages_malformed", "stamp": "state_timestamp"}
_GAUGES = ("revision", "stamp_ns")  # whole numbers that aren't counts
_NO_METRIC = ("seq",)


def _metric_of(field: Field) -> StateMetric | None:
    """Counts are counters, names have a sample for each possible one, texts are no metrics."""
    value, kind = attrgetter(field.name), field.type
    spelled, scale = _SPELLED.get(field.unit, ("", 1.0))
    name = f"gripmon_{_RENAMED.get(field.stem, field.stem)}{spelled}"
    text = field.help.partition("; null")[0].rstrip(".").replace("Unix ns", "Unix").removesuffix(f", {field.unit}")
    if field.name == "open_alerts":
        return StateMetric(name, "gauge", text, ("severity",), _by_severity)
    if isinstance(kind, kinds.EnumType):
        # One sample per name, 1 for the current one, even if this version doesn't know it.
        none: dict[tuple[str, ...], float] = {(str(each.value),): 0.0 for each in kind.cls}
        return StateMetric(name, "gauge", f"{text}: 1, 0 for the others", (field.name,), lambda state: (
            {} if value(state) is None else none | {(str(value(state)),): 1.0}
        ))  # fmt: skip
    if isinstance(kind, kinds.TupleType):
        return StateMetric(name, "gauge", text, ("axis",), lambda state: (
            dict(zip(_AXES, value(state) or (), strict=False))
        ))  # fmt: skip
    if not isinstance(kind, kinds.IntType | kinds.FloatType | kinds.BoolType) or field.name in _NO_METRIC:
        return None
    counts = isinstance(kind, kinds.IntType) and field.name not in _GAUGES
    return StateMetric(name + "_total" * counts, "counter" if counts else "gauge", text, (), lambda state: (
        {} if value(state) is None else {(): scale * value(state)}
    ))  # fmt: skip


_AXES = (("x",), ("y",), ("z",))


def _by_severity(state: StateRecord) -> dict[tuple[str, ...], float]:
    found = [alert.severity for alert in state.open_alerts]
    return {(severity.value,): float(found.count(severity)) for severity in Severity}


@functools.cache
def state_metrics() -> tuple[StateMetric, ...]:
    """A metric for each field of the state message that can be one."""
    info = StateMetric(
        "gripmon_info", "gauge", "always 1: the version and the reference", ("version", "reference"),
        lambda state: {(state.version, state.reference_id): 1.0},
    )  # fmt: skip
    return *filter(None, map(_metric_of, fields_of(StateRecord).values())), info


OTHER_METRICS = {
    "gripmon_rotation_radians": ("gauge", (), "rotation of the camera from the reference"),
    "gripmon_verdicts_total": ("counter", ("verdict",), "frames by verdict"),
    "gripmon_latency_seconds": ("histogram", (), "time from a frame's arrival at the machine to its verdict"),
    "gripmon_alerts_total": (
        "counter", ("kind", "cause", "severity"), "alerts raised or noted; no sample before the first of its kind",
    ),
}  # fmt: skip
"""Of the frames and alerts themselves: kind, labels, help."""


def _remedy(error: Exception) -> tuple[str, str]:
    if getattr(error, "errno", None) == errno.EADDRINUSE:
        return "port", "a port that no other program has, one for each monitor"
    if getattr(error, "errno", None) == errno.EACCES:
        return "port", "a port from 1024 on"
    return "address", "an address of this machine, 127.0.0.1 for itself alone"
