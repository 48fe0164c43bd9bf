"""Recordings -> Parquet, for any engine: a table each of frames, alerts, states, commands and references.

``<out>/<table>/robot=…/camera=…/date=YYYY-MM-DD/<run>-<number>.parquet``: each file of a recording gives one a table
and day (UTC), which is replaced when it is exported again.  References, which outlive a day, are not partitioned by
it: each has a file of its own.
"""

from __future__ import annotations

from gripmon.record.export.exporter import Exported, Exporter, export
from gripmon.record.export.schemas import SCHEMAS

__all__ = ["SCHEMAS", "Exported", "Exporter", "export"]
