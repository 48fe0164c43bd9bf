"""Counts and the newest state -> metric families, named and in units as Prometheus has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from gripmon.io.metrics.tally import LATENCY_BOUNDS_S, Tally
from gripmon.model.records import Severity, State, StateRecord, Verdict

_WHO = ("robot", "camera")


class Families(Collector):
    """Asked in the HTTP server's thread.  What isn't known has no sample: a zero would look like health."""

    def __init__(self, tally: Tally, robot: str, camera: str) -> None:
        self._tally = tally
        self._who = (robot, camera)

    def describe(self) -> Iterable[Metric]:
        """Nothing is promised beforehand: there may be no state yet."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """All families, of the newest state and the frames so far."""
        state = self._tally.state_record
        if state is not None:
            yield from self._counters(state)
            yield from self._gauges(state)
            yield from self._names(state)
        yield from self._of_frames()
        yield from self._alerts(state)

    def _counters(self, state: StateRecord) -> Iterator[Metric]:
        for name, text, value in (
            ("gripmon_frames", "Frames handled", state.frames),
            ("gripmon_frames_refused", "Frames that could not be measured at all", state.frames_refused),
            ("gripmon_frames_dropped", "Frames that came while another one was worked on", state.frames_dropped),
            ("gripmon_recording_dropped", "Frames that the recording had no time for", state.recording_dropped),
            ("gripmon_recording_images_dropped", "Images of recorded frames without", state.recording_images_dropped),
            ("gripmon_transforms_unsent", "Transforms from before there was a session", state.transforms_unsent),
            ("gripmon_messages_malformed", "Messages received that were none", state.malformed),
        ):
            yield self._family(CounterMetricFamily(name, text, labels=_WHO), value)

    def _gauges(self, state: StateRecord) -> Iterator[Metric]:
        for name, text, value in (
            ("gripmon_frames_per_second", "Rate of the last frames; 0 while none come", state.frames_per_s),
            ("gripmon_uptime_seconds", "Since the monitor's start", state.uptime_s),
            ("gripmon_camera_connected", "1 while the source is open", float(state.camera_connected)),
            ("gripmon_reference_revision", "Of the reference in force", state.revision),
            ("gripmon_state_timestamp_seconds", "When the state was said, Unix time", 1e-9 * state.stamp_ns),
            ("gripmon_sigma_meters", "Largest standard deviation of the TCP along a camera axis", state.sigma_m),
            ("gripmon_protection_meters", "Bound on the TCP's position error", state.protection_m),
            ("gripmon_alert_limit_meters", "Error of the TCP's position that the task bears", state.alert_limit_m),
        ):
            yield self._family(GaugeMetricFamily(name, text, labels=_WHO), value)
        text = "Displacement of the TCP along the camera's axes against the reference"
        shift = GaugeMetricFamily("gripmon_tcp_shift_meters", text, labels=(*_WHO, "axis"))
        for axis, value in zip("xyz", state.tcp_shift_m or (), strict=False):
            shift.add_metric((*self._who, axis), value)
        yield shift

    def _names(self, state: StateRecord) -> Iterator[Metric]:
        info = GaugeMetricFamily(
            "gripmon_info", "Always 1: the version and the reference", labels=(*_WHO, "version", "reference")
        )
        info.add_metric((*self._who, state.version, state.reference_id), 1.0)
        yield info
        yield self._one_of("gripmon_state", "1 for what the monitor is doing", "state", State, state.state)
        yield self._one_of("gripmon_verdict", "1 for the last transform's verdict", "verdict", Verdict, state.verdict)

    def _of_frames(self) -> Iterator[Metric]:
        tally, record = self._tally, self._tally.record
        verdicts = CounterMetricFamily("gripmon_verdicts", "Frames by verdict", labels=(*_WHO, "verdict"))
        for verdict, count in tally.verdicts.items():
            verdicts.add_metric((*self._who, verdict.value), count)
        yield verdicts
        latency = HistogramMetricFamily(
            "gripmon_latency_seconds", "From when a frame came to the machine until it is judged", labels=_WHO
        )
        latency.add_metric(self._who, _cumulative(tally.latencies[:]), 1e-9 * tally.latency_sum_ns)
        yield latency
        rotation = GaugeMetricFamily(
            "gripmon_rotation_radians", "Turn of the camera against the reference", labels=_WHO
        )
        known = record is not None and record.verdict is not Verdict.UNKNOWN
        yield self._family(rotation, record.drift.rotation_rad if known and record and record.drift else None)

    def _alerts(self, state: StateRecord | None) -> Iterator[Metric]:
        alerts = CounterMetricFamily(
            "gripmon_alerts", "Alerts raised or noted", labels=(*_WHO, "kind", "cause", "severity")
        )
        for names, count in dict(self._tally.alerts).items():  # a copy: the loop may add one meanwhile
            alerts.add_metric((*self._who, *(name.value for name in names)), count)
        yield alerts
        if state is not None:
            standing = GaugeMetricFamily(
                "gripmon_open_alerts", "Alerts raised and not cleared", labels=(*_WHO, "severity")
            )
            for severity in Severity:
                count = sum(alert.severity is severity for alert in state.open_alerts)
                standing.add_metric((*self._who, severity.value), count)
            yield standing

    def _family(self, family: CounterMetricFamily | GaugeMetricFamily, value: float | None) -> Metric:
        if value is not None:
            family.add_metric(self._who, value)
        return family

    def _one_of(self, name: str, text: str, label: str, names: Iterable[State | Verdict], present: str) -> Metric:
        """A sample for each name, 1 for the one that holds: also for one that this version has no name for."""
        family = GaugeMetricFamily(name, text, labels=(*_WHO, label))
        values: Mapping[str, float] = dict.fromkeys((each.value for each in names), 0.0) | {str(present): 1.0}
        for each, value in values.items():
            family.add_metric((*self._who, each), value)
        return family


def _cumulative(counts: list[int]) -> list[tuple[str, float]]:
    """Buckets as the text format has them: each counts all below its bound."""
    total, buckets = 0, []
    for bound, count in zip((*map(str, LATENCY_BOUNDS_S), "+Inf"), counts, strict=True):
        total += count
        buckets.append((bound, float(total)))
    return buckets
