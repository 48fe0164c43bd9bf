"""Sends rubbish on every key that a monitor listens on, from a process of its own: ENDPOINT PREFIX SEED COUNT."""

from __future__ import annotations

import json
import random
import sys

import zenoh

from support.loopback import plain_session
from support.rubbish import broken_json, frames, jaws

NAMES = ("undo", "reset", "accept", "explode")
COMMANDS_SHARE = 10
"""One command for so many payloads: each is waited for."""


def main(endpoint: str, prefix: str, seed: int, count: int) -> None:
    rng = random.Random(seed)
    with plain_session(connect=endpoint) as session:
        for index, (frame, jaw) in enumerate(zip(frames(seed, count), jaws(seed, 2 * count), strict=False)):
            session.put(
                f"{prefix}/image",
                frame.payload,
                encoding=frame.encoding or None,
                attachment=frame.attachment,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            session.put(f"{prefix}/jaw", jaw, congestion_control=zenoh.CongestionControl.BLOCK)
            if index % COMMANDS_SHARE == 0:
                _command(session, f"{prefix}/cmd/{rng.choice(NAMES)}", broken_json(rng, {"argument": 7}))
    print(f"{count} frames and jaw messages")


def _command(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Whatever is asked is answered, by one error in JSON."""
    if payload.startswith(b'{"argument": "'):
        return  # by chance it is a command
    (reply,) = session.get(key, payload=payload, timeout=20.0)
    assert reply.err is not None, f"{payload!r} was taken for a command"
    assert json.loads(reply.err.payload.to_bytes())["error"] in ("malformed", "unknown_command"), reply.err.payload


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
