"""Metrics for Prometheus: what the state message says, counts of alerts and verdicts, and the latency's distribution.

The loop's thread only adds to a few counters (:class:`Tally`); a thread of the HTTP server makes metrics of them when
somebody asks.  The text format comes from ``prometheus-client``, an optional dependency (``gripmon[metrics]``) that is
imported when the server starts.
"""

from __future__ import annotations

from gripmon.io.metrics.server import MetricsError, MetricsServer, package_fault
from gripmon.io.metrics.settings import MetricsSettings
from gripmon.io.metrics.tally import LATENCY_BOUNDS_S, Tally

__all__ = ["LATENCY_BOUNDS_S", "MetricsError", "MetricsServer", "MetricsSettings", "Tally", "package_fault"]
