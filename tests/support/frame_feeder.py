"""A camera driver in a process of its own, in step with the monitor: ENDPOINT FOLDER KEY FORMAT PREFIX [FIRST LAST].

With a part of the frames their stamps are the time of sending.

It knows plain Zenoh, JSON and the libraries that make images, nothing of gripmon.  After each frame
it waits for the transform of that frame, so that none is dropped however slow the machine is.
"""

from __future__ import annotations

import contextlib
import csv
import json
import queue
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zenoh

from support.loopback import WAIT_S, plain_session, wait_until

Sent = tuple[bytes, zenoh.Encoding | None, bytes | None]
"""Payload, encoding and attachment."""


def _note(row: dict[str, str], **more: Any) -> bytes:
    return json.dumps({"stamp_ns": int(row["stamp_ns"]), "jaw_opening_m": float(row["jaw_opening_m"]), **more}).encode()


def raw(image: np.ndarray, row: dict[str, str]) -> Sent:
    height, width = image.shape
    return image.tobytes(), None, _note(row, width=width, height=height, encoding="mono8")


def raw_padded(image: np.ndarray, row: dict[str, str]) -> Sent:
    """Rows with a gap of noise behind each, and a field of a later version."""
    height, width = image.shape
    gap = np.random.default_rng(1).integers(0, 256, (height, 40), np.uint8)
    note = _note(row, width=width, height=height, encoding="mono8", step=width + 40, schema="gripmon.frame/1", x=[1])
    return np.hstack([image, gap]).tobytes(), None, note


def png(image: np.ndarray, row: dict[str, str]) -> Sent:
    return cv2.imencode(".png", image)[1].tobytes(), zenoh.Encoding.IMAGE_PNG, _note(row)


def jpeg(image: np.ndarray, row: dict[str, str]) -> Sent:
    """Without an encoding: it is known by how it begins."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes(), None, _note(row)


FORMATS: dict[str, Callable[[np.ndarray, dict[str, str]], Sent]] = {
    each.__name__: each for each in (raw, raw_padded, png, jpeg)
}


def main(endpoint: str, folder: str, key: str, frame_format: str, prefix: str, *part: str) -> None:
    rows = list(csv.DictReader((Path(folder) / "timestamps.csv").open()))
    if part:
        rows = rows[int(part[0]) : int(part[1])]
    transforms: queue.SimpleQueue[int] = queue.SimpleQueue()

    def heard(sample: zenoh.Sample) -> None:
        transforms.put(json.loads(sample.payload.to_bytes())["stamp_ns"])

    with plain_session(connect=endpoint) as session:
        subscriber = session.declare_subscriber(f"{prefix}/transform", heard)
        publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: publisher.matching_status.matching, "a monitor that listens")
        alive = session.liveliness()
        wait_until(lambda: list(alive.get(f"{prefix}/alive", timeout=20.0)), "the monitor to be alive")
        for row in rows:
            if part:
                row["stamp_ns"] = str(time.time_ns())
            image = cv2.imread(str(Path(folder) / row["file"]), cv2.IMREAD_UNCHANGED)
            payload, encoding, attachment = FORMATS[frame_format](image, row)
            publisher.put(payload, encoding=encoding, attachment=attachment)
            # Under load a transform may be dropped on its way here: whoever called compares what the monitor wrote.
            with contextlib.suppress(queue.Empty):
                while transforms.get(timeout=WAIT_S) != int(row["stamp_ns"]):
                    pass
        subscriber.undeclare()


if __name__ == "__main__":
    main(*sys.argv[1:])
