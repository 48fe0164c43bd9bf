"""``gripmon replay`` with the configuration of a second camera: one JSON line a pulse."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.daemon.config import SecondConfig
    from gripmon.io.sources import Source
    from gripmon.model.records import Frame


def run(config: SecondConfig, source: Source, write: Callable[[bytes], None], step: Callable[[], None]) -> int:
    """Judge the table's pulses on recorded frames; the same input gives the same bytes.  Returns the exit code."""
    from gripmon.model.records import to_json

    faults: Counter[str] = Counter()
    count = used = 0
    try:
        for record in config.pulsed_watch().replayed(_frames(source, step), config.pulses):
            write(to_json(record) + b"\n")
            count, used = count + 1, used + record.used
            if record.fault is not None:
                faults[record.fault] += 1
    finally:
        why = ", ".join(f"{number} {fault}" for fault, number in faults.most_common())
        print(f"replay: {count} pulses: {used} used{f'; {why}' if why else ''}", file=sys.stderr)
    return common.EXIT_DONE if used else common.EXIT_FAILED


def _frames(source: Source, step: Callable[[], None]) -> Iterator[Frame]:
    from gripmon.model.records import Frame

    while (item := source.read()) is not None:
        step()
        if isinstance(item, Frame):
            yield item
