"""The table of ``gripmon watch``: one row per monitor, for a terminal, a log or a program."""

from __future__ import annotations

import contextlib
import datetime
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from gripmon.cli.render import columns

if TYPE_CHECKING:
    from rich.console import RenderableType

    from gripmon.cli.alert_log import Event
    from gripmon.client import MonitorStatus
    from gripmon.model.records import StateRecord

COLUMNS = ("monitor", "state", "verdict", "drift mm", "sigma mm", "bound mm", "fps", "heard s", "reference", "alerts")
_SPARED, _WIDE = "sigma mm", 100  # the column that is left out on a terminal with fewer characters per line
_FRAME_LINES = 6  # lines of a terminal for title, head, rule, summary, legend, and one free line
_STYLES = {
    "gone": "bold red", "silent": "bold red", "several": "bold red", "unknown": "red", "starting": "yellow",
    "suspect": "yellow", "stopped": "dim", "valid": "green"
}  # fmt: skip
_AS_DATA = (
    "monitor_id", "condition", "gone_since_ns", "state_age_s", "drift_m", "transforms_per_s", "transform_age_s", "state"
)  # fmt: skip
_MARKS = {"error": "!!", "warning": "!", "info": "i"}
_NOT_NOW = "the clock of recorded images, or an alert from before"
LEGEND = "open alerts: !! errors, ! warnings, i notes, with their number and the worst one's text"


class Row(NamedTuple):
    """One monitor's row, as text; ``condition`` decides its colour."""

    condition: str
    cells: tuple[str, ...]


def row(status: MonitorStatus) -> Row:
    """The cells in the order of :data:`COLUMNS`; for a monitor that is gone, its last report."""
    state = status.state
    there = state is not None and status.condition in ("valid", "suspect", "unknown")
    age_s = status.state_age_s if status.transform_age_s is None else status.transform_age_s
    rate = status.transforms_per_s if status.transforms_per_s is not None or state is None else state.frames_per_s
    cells = (
        printable(f"{status.name} {status.monitor_id}" if status.several else str(status.name)),
        _what(status),
        state.verdict.value if state is not None and there else "unknown",
        _number(1e3, status.drift_m, ".3f"),
        _number(1e3, None if state is None else state.sigma_m, ".3f"),
        _bound(state),
        _number(1.0, rate if there else None, ".1f"),
        f"{age_s:.1f}",
        "-" if state is None else f"{state.revision} {printable(state.reference_id)}",
        _alerts(status),
    )
    return Row(status.condition.value, cells)


def summary(statuses: Sequence[MonitorStatus], fault: str) -> str:
    """The number of monitors in each condition, and any other fault."""
    counts = Counter(status.condition for status in statuses)
    parts = [f"{count} {condition}" for condition, count in sorted(counts.items(), key=lambda item: _order(item[0]))]
    text = f"{len(statuses)} monitor{'s' * (len(statuses) != 1)}" + (f": {', '.join(parts)}" if parts else "")
    return text + (f"; {printable(fault)}" if fault else "")


def plain(statuses: Sequence[MonitorStatus], fault: str) -> str:
    """Aligned columns without colours."""
    table = columns([COLUMNS, *(row(status).cells for status in statuses)])
    legend = [LEGEND] if any(status.alerts for status in statuses) else []
    return "\n".join([*table, summary(statuses, fault), *legend])


def line(status: MonitorStatus) -> str:
    """One monitor in one line of a log."""
    cells = row(status).cells
    named = ", ".join(f"{name} {cell}" for name, cell in zip(COLUMNS[3:-2], cells[3:-2], strict=True) if cell != "-")
    return f"{cells[0]}: {cells[1]}, {cells[2]}, {named}, reference {cells[-2]}; {cells[-1] or 'no open alerts'}"


def event_line(event: Event) -> str:
    """An alert, or the appearance or disappearance of a monitor, in one line of a log."""
    head, record = f"{clock(event.stamp_ns)}  {event.name}", event.alert
    if record is None:
        return printable(f"{head}  {event.what}")
    if not _is_today(event.stamp_ns):
        head = f"{clock(event.stamp_ns)} ({_NOT_NOW})  {event.name}"
    which = f" ({record.alert_id})" if record.alert_id else ""
    text = f"{record.severity.value:7}  {event.what}, revision {record.revision}: {record.text}{which}"
    return printable(f"{head}  {text}")


def table(statuses: Sequence[MonitorStatus], fault: str, height: int, width: int) -> RenderableType:
    """For a terminal of that size: the worst monitors, as many as fit; on a narrow one without sigma."""
    from rich.table import Table
    from rich.text import Text

    shown = statuses[: max(1, height - _FRAME_LINES)]
    out = Table(title="gripmon watch", title_justify="left", expand=True, box=None, pad_edge=False)
    chosen = [name for name in COLUMNS if name != _SPARED or width >= _WIDE]
    for name in chosen:
        ratio, number = 1 if name == "alerts" else None, name in COLUMNS[3:8]
        out.add_column(name, justify="right" if number else "left", no_wrap=True, overflow="ellipsis", ratio=ratio)
    for status in shown:
        condition, cells = row(status)
        # Text, not markup: input from the network must not affect the formatting.
        named = zip(COLUMNS, cells, strict=True)
        out.add_row(*(Text(cell) for name, cell in named if name in chosen), style=_STYLES[condition])
    rest = len(statuses) - len(shown)
    out.caption = Text(summary(statuses, fault) + (f"; {rest} more not shown, none of them worse" * (rest > 0)))
    if any(status.alerts for status in shown):
        out.caption.append(f"\n{LEGEND}")
    out.caption_justify = "left"
    return out


def as_data(status: MonitorStatus) -> dict[str, Any]:
    """The table's values, for ``--json``."""
    values = {"robot": status.name.robot, "camera": status.name.camera}
    values |= {name: getattr(status, name) for name in _AS_DATA}
    return values | {"state_age_s": round(status.state_age_s, 3)}


def local_time(stamp_ns: int) -> datetime.datetime | None:
    """A stamp's local time; None for an invalid one from the network."""
    try:
        return datetime.datetime.fromtimestamp(1e-9 * stamp_ns).astimezone()
    except (OverflowError, ValueError, OSError):
        return None


def clock(stamp_ns: int) -> str:
    """Local time of day, with the date if that isn't today's; a stamp from the network may be invalid."""
    if (when := local_time(stamp_ns)) is None:
        return "at no time"
    return when.strftime("%H:%M:%S" if _is_today(stamp_ns) else "%Y-%m-%d %H:%M:%S")


def _is_today(stamp_ns: int) -> bool:
    """False for an invalid stamp."""
    with contextlib.suppress(OverflowError, ValueError, OSError):
        return datetime.datetime.fromtimestamp(1e-9 * stamp_ns).date() == datetime.datetime.now().date()
    return False


def printable(text: str) -> str:
    """The text without control characters for a terminal: it came from the network."""
    return "".join(c if c.isprintable() else " " for c in text)


def _order(condition: Any) -> int:
    from gripmon.client import Condition

    return list(Condition).index(condition)


def _what(status: MonitorStatus) -> str:
    if status.gone_since_ns is not None:
        return f"{status.condition} since {clock(status.gone_since_ns)}"
    state = "starting" if status.state is None else printable(status.state.state)
    before = {"silent": "silent, was ", "several": "several, "}
    return f"{before.get(status.condition, '')}{state}"


def _alerts(status: MonitorStatus) -> str:
    """The proposal that waits for an operator; the number of alerts of each severity, and the worst one's text; without
    an alert, the state's message.
    """
    waits = _waits(status)
    if not status.alerts:
        return waits or (printable(status.state.message) if status.state is not None else "")
    counts = Counter(alert.severity for alert in status.alerts)
    marks = " ".join(f"{_MARKS[severity]}{count}" for severity, count in counts.items())
    worst = status.alerts[0]
    text = f"{marks} {printable(worst.text)}{' (acknowledged)' * worst.acknowledged}"
    return f"{waits}; {text}" if waits else text


def _waits(status: MonitorStatus) -> str:
    """The command to type if a new reference waits for an operator; otherwise empty."""
    from gripmon.model.records import accepting

    if status.state is None or not status.state.proposal_id or status.gone_since_ns is not None:
        return ""
    return "waits: " + printable(accepting(status.state.proposal_id, *status.name))


def _bound(state: StateRecord | None) -> str:
    """The protection level over the alert limit, if known; ``ref``: of the motion since the reference."""
    if state is None or state.protection_m is None:
        return "-"
    limit = "" if state.alert_limit_m is None else f"/{1e3 * state.alert_limit_m:g}"
    by = " ref" if state.valid_by == "reference" else ""
    return f"{1e3 * state.protection_m:.2f}{limit}{by}"


def _number(scale: float, value: float | None, how: str) -> str:
    return "-" if value is None else format(scale * value, how)
