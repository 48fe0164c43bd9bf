"""A subscriber that stalls, in a process of its own: ENDPOINT KEY… MODE.  Says ``ready``; ends when its input does.

``block``: its callback never returns, in Zenoh's own thread, so that nothing more is read from the network while the
connection stays alive.  ``free``: it reads, until someone stops the process.
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

    def take(sample: zenoh.Sample) -> None:
        if mode == "block":
            time.sleep(_FOR_EVER_S)

    session = zenoh.open(config)
    callback = zenoh.handlers.Callback(take, indirect=False)
    _subscribers = [session.declare_subscriber(key, callback) for key in keys]
    print("ready", flush=True)
    sys.stdin.read()
    os._exit(0)  # a session whose thread is blocked can't be closed


if __name__ == "__main__":
    main()
