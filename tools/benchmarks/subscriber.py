"""A plain Zenoh subscriber in a process of its own: ENDPOINT KEY… MODE.  Says ``ready``; ends when its input does.

``note``: in the end it says what came, one line of JSON: the frames' numbers and when each arrived (ns of the monotonic
clock that all processes share).  ``free``: it reads, until someone stops the process.  ``block``: its callback never
returns, in Zenoh's own thread, so that nothing more is read from the network while the connection stays alive.
"""

from __future__ import annotations

import json
import os
import sys
import time

import zenoh

_FOR_EVER_S = 3600.0


def main() -> None:
    endpoint, *keys, mode = sys.argv[1:]
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
        if mode == "block":
            time.sleep(_FOR_EVER_S)
        if mode == "note":
            arrivals_ns.append(time.monotonic_ns())
            payload = sample.payload.to_bytes()
            start = payload.index(b'"seq":') + 6
            seqs.append(int(payload[start : payload.index(b",", start)]))

    session = zenoh.open(config)
    callback = zenoh.handlers.Callback(take, indirect=mode == "note")
    subscribers = [session.declare_subscriber(key, callback) for key in keys]
    print("ready", flush=True)
    sys.stdin.read()
    if mode != "note":
        os._exit(0)  # a session whose thread is blocked can't be closed
    time.sleep(0.3)  # what is still on its way
    for subscriber in subscribers:
        subscriber.undeclare()
    session.close()
    print(json.dumps({"seqs": seqs, "arrivals_ns": arrivals_ns}), flush=True)


if __name__ == "__main__":
    main()
