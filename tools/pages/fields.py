"""The page of fields: what is exported to Parquet, drawn in a recording and scraped by Prometheus, from the lists that
the code itself goes by.
"""

from __future__ import annotations

from gripmon.io.metrics import OTHER_METRICS, state_metrics
from gripmon.record.curves import curve_path
from gripmon.record.parquet import SCHEMAS
from gripmon.record.table import COLUMNS
from pages import cell

_ROWS = {
    "frames": "frame",
    "alerts": "event in an alert's life",
    "states": "state message, once a second and on every change",
    "commands": "command carried out or refused",
    "references": "reference that was in force",
}
_HEAD = """\
# Fields

Names, units and meanings of what is recorded: columns of [Parquet](../howto/export.md), curves of a
[recording](../howto/recording.md) (in mm, degrees and µs), [metrics](../howto/metrics.md). [Messages](wire.md) has the
fields that they come from.
"""


def page() -> str:
    """The page in Markdown."""
    parts = [_HEAD]
    for table, schema in SCHEMAS.items():
        parts.append(f"\n## Table {table}\n\nOne row per {_ROWS[table]}.\n")
        with_curves = table == "frames"
        parts.append(_row("column", "unit", *["curve"] * with_curves, "meaning"))
        parts.append(_row(*["---"] * (4 if with_curves else 3)))
        for field in schema:
            unit, text = (field.metadata[key].decode() for key in (b"unit", b"description"))
            column = COLUMNS.get(field.name)
            curve = "" if column is None or column.curve is None else f"`{curve_path(column)}`"
            parts.append(_row(f"`{field.name}`", unit, *[curve] * with_curves, text))
    parts.append("\n## Metrics\n\nAll have the labels `robot` and `camera`, too.\n")
    parts += [_row("metric", "type", "labels", "meaning"), _row(*["---"] * 4)]
    for name, kind, labels, text in metrics():
        parts.append(_row(f"`{name}`", kind, ", ".join(f"`{label}`" for label in labels), text))
    return "\n".join(parts) + "\n"


def metrics() -> list[tuple[str, str, tuple[str, ...], str]]:
    """Name as exposed, type, labels and meaning of each metric."""
    found = [(m.name, m.kind, m.labels, m.help) for m in state_metrics()]
    return found + [(name, kind, labels, text) for name, (kind, labels, text) in OTHER_METRICS.items()]


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell(each) for each in cells)} |"
