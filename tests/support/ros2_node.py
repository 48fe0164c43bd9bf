"""What a node on ``rmw_zenoh`` hears, in a process of its own: ENDPOINT OUT KEY…

A session as ``rmw_zenoh`` opens it (a peer that connects to the router and listens on a free port of loopback), for
each key an advanced subscriber as it declares one for a volatile topic; without gripmon.  A line of JSON is written to
OUT for each sample; the program ends when its input does.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import zenoh

endpoint, out, *keys = sys.argv[1:]
config = zenoh.Config()
for name, value in {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "listen/endpoints": ["tcp/127.0.0.1:0"],
    "connect/endpoints": [endpoint],
    "timestamping/enabled": True,
}.items():
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config) as session, Path(out).open("w") as file:

    def write(sample: zenoh.Sample) -> None:
        attachment = sample.attachment.to_bytes().hex() if sample.attachment else None
        line = {"key": str(sample.key_expr), "payload": sample.payload.to_bytes().hex(), "attachment": attachment}
        file.write(json.dumps(line) + "\n")
        file.flush()

    subscribers = [
        zenoh.ext.declare_advanced_subscriber(session, key, zenoh.handlers.Callback(write, indirect=True))
        for key in keys
    ]
    print("listening", flush=True)
    sys.stdin.read()
