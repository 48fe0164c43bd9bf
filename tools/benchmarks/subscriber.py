"""A plain Zenoh subscriber in a process of its own: ENDPOINT KEY.  Says ``ready``; when its input ends, says what came.

The answer is one line of JSON: the frames' numbers and when each arrived (ns of the monotonic clock that all processes
share).
"""

from __future__ import annotations

import json
import sys
import time

import zenoh


def main() -> None:
    endpoint, key = sys.argv[1:]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    # Zenoh's own pauses, up to 4 s, would be most of the time that a restarted router takes to be found.
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    config.insert_json5("connect/retry", json.dumps(retry))
    seqs: list[int] = []
    arrivals_ns: list[int] = []

    def take(sample: zenoh.Sample) -> None:
        arrivals_ns.append(time.monotonic_ns())
        payload = sample.payload.to_bytes()
        start = payload.index(b'"seq":') + 6
        seqs.append(int(payload[start : payload.index(b",", start)]))

    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(key, take)
        print("ready", flush=True)
        sys.stdin.read()
        time.sleep(0.3)  # what is still on its way
        subscriber.undeclare()
    print(json.dumps({"seqs": seqs, "arrivals_ns": arrivals_ns}), flush=True)


if __name__ == "__main__":
    main()
