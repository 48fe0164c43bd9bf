"""A subscriber without gripmon, in a process of its own: ENDPOINT KEY COUNT; prints COUNT payloads, one a line."""

from __future__ import annotations

import json
import sys

import zenoh

endpoint, key, count = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber(key)
    for _ in range(int(count)):
        print(subscriber.recv().payload.to_string(), flush=True)
