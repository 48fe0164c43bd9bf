"""A monitor's state as the level, text and values of a ``diagnostic_msgs/DiagnosticStatus``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec

from gripmon.model.records import Cause, FrameRecord, Severity, StandingAlert, State, StateRecord, Verdict

OK, WARN, ERROR, STALE = range(4)

_OF_VERDICT = {
    Verdict.VALID: (OK, "use the transform"),
    Verdict.SUSPECT: (WARN, "begin no motion by the transform, and grasp nothing"),
    Verdict.UNKNOWN: (ERROR, "don't move by the transform"),
}
_OF_SEVERITY = {Severity.INFO: OK, Severity.WARNING: WARN, Severity.ERROR: ERROR}
_OF_FRAME = ("reason", "valid_by", "drift", "protection", "since_reference", "absolute")


def level_of(state: StateRecord, alerts: Iterable[StandingAlert]) -> int:
    """Stale without frames; otherwise the worst of the verdict, the state's message, and the open alerts that are not
    acknowledged.
    """
    levels = [_OF_SEVERITY[alert.severity] for alert in alerts if not alert.acknowledged]
    worst = max(_OF_VERDICT[state.verdict][0], WARN if state.message else OK, *levels, OK)
    return STALE if state.state is State.STALE else worst


def summary_of(state: StateRecord, alerts: Iterable[StandingAlert]) -> str:
    """One line of text."""
    parts = [f"{state.state}, transform {state.verdict}", state.message, *(alert.text for alert in alerts)]
    return "; ".join(part for part in parts if part)


def values_of(
    state: StateRecord, frame: FrameRecord | None, alerts: Iterable[StandingAlert], causes: Mapping[str, Cause]
) -> dict[str, str]:
    """What to do and why (``causes``: by alert), then the fields of the state message that are known, and those of the
    newest frame that tell its drift and its bounds, by their names on the wire.
    """
    of_alerts = {f"{alert.kind} ({alert.severity})": causes.get(alert.alert_id) for alert in alerts}
    values = {
        "what to do": _OF_VERDICT[state.verdict][1],
        "alerts": ", ".join(of_alerts),
        "cause": ", ".join(sorted({str(cause) for cause in of_alerts.values() if cause is not None})),
    }
    fields = msgspec.to_builtins(state)
    del fields["open_alerts"]
    if frame is not None:
        values["frame age (s)"] = f"{1e-9 * (state.stamp_ns - frame.stamp_ns):.3f}"
        fields |= {name: msgspec.to_builtins(getattr(frame, name)) for name in _OF_FRAME}
    return values | dict(_flat(fields))


def _flat(fields: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Names and texts of values, one within another as ``drift.rotation_rad``; without those that are null."""
    for name, value in fields.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        elif isinstance(value, list | tuple):
            yield f"{before}{name}", " ".join(f"{part:.6g}" for part in value)
        elif value is not None:
            yield f"{before}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)
