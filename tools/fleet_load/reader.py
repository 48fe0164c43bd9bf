"""One who reads of all monitors at once: ENDPOINT LEAVES [FILE], the leaves e.g. ``transform,state,alive``.

As a table of monitors does, it keeps the last message of each; with FILE it writes every message there, a line each, as
an alert log does, and asks for those that came before it.  A line ``mark`` on the input begins again; its end ends the
process.  The answer then is one line of JSON: messages and gaps of each kind, latencies in µs (median, 99 %), and how
many monitors are there.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import TextIO

import msgspec
import numpy as np
import zenoh

from gripmon.io.wire import Keys, PublishSettings, zenoh_config


class Numbered(msgspec.Struct):
    """What every message has."""

    seq: int
    stamp_ns: int


class Reading:
    """What came since the last mark; Zenoh's threads write."""

    def __init__(self, log: TextIO | None) -> None:
        self.lock = threading.Lock()
        self.last: dict[str, Numbered] = {}
        self.alive: set[str] = set()
        self._log = log
        self._numbered = msgspec.json.Decoder(Numbered)
        self.mark()

    def mark(self) -> None:
        with self.lock:
            self.count: dict[str, int] = defaultdict(int)
            self.gaps: dict[str, int] = defaultdict(int)
            self.latencies_us: dict[str, list[float]] = defaultdict(list)

    def take(self, sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        payload, key = sample.payload.to_bytes(), str(sample.key_expr)
        leaf = key.rpartition("/")[2]
        with self.lock:
            self.count[leaf] += 1
            if leaf != "reference":
                message = self._numbered.decode(payload)
                self.latencies_us[leaf].append(1e-3 * (now_ns - message.stamp_ns))
                if (before := self.last.get(key)) is not None:
                    self.gaps[leaf] += max(message.seq - before.seq - 1, 0)
                self.last[key] = message
            if self._log is not None:
                self._log.write(payload.decode() + "\n")

    def token(self, sample: zenoh.Sample) -> None:
        with self.lock:
            (self.alive.add if sample.kind == zenoh.SampleKind.PUT else self.alive.discard)(str(sample.key_expr))

    def figures(self) -> dict[str, object]:
        with self.lock:
            latencies = {
                leaf: [float(value) for value in np.percentile(values, [50.0, 99.0])]
                for leaf, values in self.latencies_us.items()
                if values
            }
            return {
                "count": dict(self.count), "lost": dict(self.gaps), "latency_us": latencies, "alive": len(self.alive),
            }  # fmt: skip


def main() -> None:
    endpoint, leaves, *file = sys.argv[1:]
    log = Path(file[0]).open("w", encoding="utf-8") if file else None  # noqa: SIM115  open as long as the process
    reading = Reading(log)
    keys = Keys("*", "*")
    with zenoh.open(zenoh_config(PublishSettings(mode="client", connect=(endpoint,)))) as session:
        kept = []
        for leaf in leaves.split(","):
            if leaf == "alive":
                kept.append(session.liveliness().declare_subscriber(keys[leaf], reading.token, history=True))
            elif log is not None:
                history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
                kept.append(zenoh.ext.declare_advanced_subscriber(session, keys[leaf], reading.take, history=history))
            else:
                kept.append(session.declare_subscriber(keys[leaf], reading.take))
        print("ready", flush=True)
        for line in sys.stdin:
            if line == "mark\n":
                reading.mark()
                print("marked", flush=True)
        time.sleep(0.5)  # what is still on its way
    print(json.dumps(reading.figures()), flush=True)
    if log is not None:
        log.close()


if __name__ == "__main__":
    main()
