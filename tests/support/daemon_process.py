"""A daemon in a process of its own, monitor and camera stood in for, the publisher real: ENDPOINT KIND [FILE]."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from gripmon.daemon.running import run
from gripmon.daemon.service import log_to_stderr
from gripmon.daemon.watch import DaemonSettings
from gripmon.io.wire import PublishSettings
from gripmon.model.geometry import make_transform, to_record
from gripmon.model.stopping import signals_exit
from support.loopback import WAIT_S, state_record
from support.published import Published
from support.stand_ins import Listener, ScriptedMonitor, SilentSource, TickingSource

# A third of a turn about (1, 1, 1) after a turn about x: no component of its quaternion is like another.
ROTATION = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) @ np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]]
)
TRANSLATION_M = (0.011, -0.022, 0.133)
FRAMES_PER_S = 60.0

if __name__ == "__main__":
    endpoint, kind, *rest = sys.argv[1:]
    log_to_stderr()
    transform = to_record(make_transform(ROTATION, np.array(TRANSLATION_M)))
    with signals_exit() as stop:
        publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
        if kind == "forgetful":
            raise SystemExit(5)  # without closing the publisher
        if kind == "starting":
            publisher.event(state_record())
            time.sleep(WAIT_S)
        sys.exit(
            run(
                ScriptedMonitor(lambda _: {"cam_T_grip": transform}),
                source=SilentSource(FRAMES_PER_S) if kind == "silent" else TickingSource(FRAMES_PER_S),
                outputs=(publisher,),
                recorder=Listener(),
                settings=DaemonSettings(no_camera_alert_after_s=0.5),
                robot="arm",
                camera="wrist",
                estimates=Path(rest[0]) if rest else None,
                stop=stop,
            )
        )
