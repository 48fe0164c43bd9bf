"""A cell in a process of its own: a camera's driver and the robot's program, ENDPOINT PREFIX FOLDER [RUBBISH].

It sends the frames of a folder with stamps of now and tells each pulse after its frames, in step with the monitor: it
waits for what became of the pulse, and shows it again where frames were dropped on the way.  With RUBBISH so many
payloads that are no pulse come between.  When all is told it goes on with dark frames until its input ends.  It knows
plain Zenoh, JSON and OpenCV, nothing of gripmon.
"""

from __future__ import annotations

import csv
import json
import queue
import select
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import zenoh

from support.loopback import WAIT_S, plain_session, wait_until

PULSE_NS, MARGIN_S = 60_000_000, 0.005
NOT_PULSES = (
    b"", b"{", b"\xff\xfe", b"[]", b"null", b"x" * 100_000, b'{"stamp_ns": 1}',
    b'{"stamp_ns": "soon", "until_ns": 2, "base_T_ee": {"translation_m": [0,0,0], "rotation_xyzw": [0,0,0,1]}}',
    b'{"stamp_ns": 5, "until_ns": 2, "base_T_ee": {"translation_m": [0,0,0], "rotation_xyzw": [0,0,0,1]}}',
    b'{"stamp_ns": 1, "until_ns": 2, "base_T_ee": {"translation_m": [0,0,0], "rotation_xyzw": [0,0,0,2]}}',
    b'{"stamp_ns": 1, "until_ns": 2, "base_T_ee": {"translation_m": [500,0,0], "rotation_xyzw": [0,0,0,1]}}',
    b'{"stamp_ns": 1, "until_ns": 1e300, "base_T_ee": {"translation_m": [0,0,0], "rotation_xyzw": [0,0,0,1]}}',
    b'{"schema": "gripmon.pulse/2", "stamp_ns": 1, "until_ns": 2}',
)  # fmt: skip


class Cell:
    """Puts frames and pulses, and hears of spots."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        blocking = zenoh.CongestionControl.BLOCK
        self._newest_ns = 0
        self._spots: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(
            f"{prefix}/spot", lambda sample: self._spots.put(json.loads(sample.payload.to_bytes()))
        )
        self._images = session.declare_publisher(f"{prefix}/image", congestion_control=blocking)
        self.pulses = session.declare_publisher(f"{prefix}/pulse", congestion_control=blocking)
        wait_until(lambda: self._images.matching_status.matching, "a monitor that looks")
        wait_until(lambda: self.pulses.matching_status.matching, "a monitor that listens")
        alive = session.liveliness()
        wait_until(lambda: list(alive.get(f"{prefix}/alive", timeout=20.0)), "the monitor to be alive")

    def show(self, images: list[Any], pose: dict[str, Any]) -> dict[str, Any]:
        """One dark frame and those of a pulse: what became of it."""
        end_s = time.monotonic() + WAIT_S
        while True:
            begin_ns = max(time.time_ns(), self._newest_ns) + 30_000_000
            offsets_ns = [-15_000_000, *(20_000_000 * (k + 1) for k in range(len(images) - 1))]
            for image, offset_ns in zip(images, offsets_ns, strict=True):
                self._frame(image, begin_ns + offset_ns)
                time.sleep(0.03)
            pulse = {"stamp_ns": begin_ns, "until_ns": begin_ns + PULSE_NS, "base_T_ee": pose}
            self.pulses.put(json.dumps(pulse).encode())
            spot = self._heard(images[0], begin_ns, end_s)
            if spot["fault"] not in ("no_frame", "too_late"):
                return spot
            assert time.monotonic() < end_s, spot["reason"]

    def rest(self, dark: Any) -> None:
        """A frame with the laser off."""
        self._frame(dark, max(time.time_ns(), self._newest_ns + 10_000_000))

    def _heard(self, dark: Any, begin_ns: int, end_s: float) -> dict[str, Any]:
        """Frames go on until it is judged."""
        self._newest_ns = begin_ns + PULSE_NS
        while True:
            self.rest(dark)
            try:
                while (spot := self._spots.get(timeout=0.2))["stamp_ns"] != begin_ns:
                    pass
                return spot
            except queue.Empty:
                assert time.monotonic() < end_s, "no word of a pulse"

    def _frame(self, image: Any, stamp_ns: int) -> None:
        self._newest_ns = stamp_ns
        height, width = image.shape
        note = {"stamp_ns": stamp_ns, "width": width, "height": height, "encoding": "mono8"}
        self._images.put(image.tobytes(), attachment=json.dumps(note).encode())


def main(endpoint: str, prefix: str, folder: str, rubbish: str = "0") -> None:
    files = [row["file"] for row in csv.DictReader((Path(folder) / "images" / "timestamps.csv").open())]
    images = [cv2.imread(str(Path(folder) / "images" / name), cv2.IMREAD_UNCHANGED) for name in files]
    with plain_session(connect=endpoint) as session:
        cell = Cell(session, prefix)
        for k, row in enumerate(csv.DictReader((Path(folder) / "pulses.csv").open())):
            pose = {
                "translation_m": [float(row[key]) for key in ("tx_m", "ty_m", "tz_m")],
                "rotation_xyzw": [float(row[key]) for key in ("qx", "qy", "qz", "qw")],
            }
            if k < int(rubbish):
                cell.pulses.put(NOT_PULSES[k % len(NOT_PULSES)])
            print(json.dumps(cell.show(images[3 * k : 3 * k + 3], pose)), flush=True)
        while not select.select((sys.stdin,), (), (), 0.05)[0]:
            cell.rest(images[0])


if __name__ == "__main__":
    main(*sys.argv[1:])
