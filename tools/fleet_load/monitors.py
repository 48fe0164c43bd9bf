"""Many monitors' talk from one process: ENDPOINT FIRST COUNT RATE_HZ FILE.  Ends when its input does.

Each monitor has a session and a publisher of its own, gripmon's, and says a real record (FILE: one JSON line) at the
camera's rate, its state every second, its reference at the start, an alert every ten seconds.  Images aren't processed.
The answer at the end is one line of JSON: how many messages of each kind each monitor sent.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import msgspec

from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.records import (
    Alert,
    AlertKind,
    AlertRecord,
    Cause,
    Frame,
    FrameRecord,
    ReferenceRecord,
    Severity,
    State,
    StateRecord,
    Verdict,
)

_STATE_S, _ALERT_S = 1.0, 10.0
_CAMERA = "wrist"


class Monitor:
    """One that only talks."""

    def __init__(self, endpoint: str, number: int, record: FrameRecord) -> None:
        self.robot = f"arm{number:04d}"
        self.link = Link(PublishSettings(mode="client", connect=(endpoint,), retry_first_s=0.05))
        self.publisher = ZenohPublisher(self.link, self.robot, _CAMERA)
        self.sent = {"transform": 0, "state": 0, "alert": 0, "reference": 0}
        self._record = record
        self._start_s = time.monotonic()

    def transform(self) -> None:
        seq = self.sent["transform"]
        record = msgspec.structs.replace(self._record, seq=seq, stamp_ns=time.time_ns())
        self.publisher.frame(Frame(seq, record.stamp_ns, None), record, lambda: None)
        self.sent["transform"] += 1

    def state(self, rate_hz: float) -> None:
        frames = self.sent["transform"]
        self.publisher.event(
            StateRecord(
                robot=self.robot,
                camera=_CAMERA,
                state=State.TRACKING,
                verdict=Verdict.VALID,
                stamp_ns=time.time_ns(),
                seq=self.sent["state"],
                reference_id=self._record.reference_id,
                revision=self._record.revision,
                frames=frames,
                frames_refused=0,
                frames_dropped=0,
                frames_per_s=rate_hz,
                uptime_s=time.monotonic() - self._start_s,
                camera_connected=True,
                recording_dropped=0,
                message="",
                version="0",
            )
        )
        self.sent["state"] += 1

    def alert(self) -> None:
        text = "the camera has moved by 1.50 mm and 0.10°; cause not known yet"
        alert = Alert(AlertKind.STEP, Cause.UNKNOWN, Severity.WARNING, text)
        self.publisher.event(
            AlertRecord(
                robot=self.robot,
                camera=_CAMERA,
                seq=self.sent["alert"],
                stamp_ns=time.time_ns(),
                state=State.DRIFTING,
                reference_id=self._record.reference_id,
                revision=self._record.revision,
                **msgspec.structs.asdict(alert),
            )
        )
        self.sent["alert"] += 1

    def reference(self) -> None:
        transform = self._record.cam_T_grip
        assert transform is not None
        covariance = self._record.covariance or (0.0,) * 36
        self.publisher.event(
            ReferenceRecord("configuration", 0, time.time_ns(), "configuration", transform, covariance)
        )
        self.sent["reference"] += 1


def main() -> None:
    endpoint, first, count, rate, file = sys.argv[1:]
    record = msgspec.json.decode(Path(file).read_bytes(), type=FrameRecord)
    monitors = [Monitor(endpoint, int(first) + i, record) for i in range(int(count))]
    while not all(monitor.link.connected for monitor in monitors):
        time.sleep(0.01)
    for monitor in monitors:
        monitor.reference()
    print("ready", flush=True)
    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    _talk(monitors, float(rate), stop)
    print(json.dumps({monitor.robot: monitor.sent for monitor in monitors}), flush=True)
    sys.stdin.close()
    time.sleep(1.0)  # what is still on its way
    for monitor in monitors:
        monitor.publisher.close()


def _talk(monitors: list[Monitor], rate_hz: float, stop: threading.Event) -> None:
    """Each at its own moments, evenly spread, as cameras that know nothing of each other."""
    period_s = 1.0 / (rate_hz * len(monitors))
    start_s = time.monotonic()
    turn = 0
    while not stop.is_set():
        due_s = start_s + turn * period_s
        if (wait_s := due_s - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        round_, place = divmod(turn, len(monitors))
        monitor, before = monitors[place], (round_ - 1) / rate_hz
        now = round_ / rate_hz
        monitor.transform()
        if int(now / _STATE_S) != int(before / _STATE_S) or round_ == 0:
            monitor.state(rate_hz)
        if int(now / _ALERT_S) != int(before / _ALERT_S) and round_:
            monitor.alert()
        turn += 1


if __name__ == "__main__":
    main()
