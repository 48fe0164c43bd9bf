"""The frame rate at which a machine can run the demo, measured before it begins."""

from __future__ import annotations

import contextlib
import time
from typing import NamedTuple

from gripmon.daemon.api import Monitor
from gripmon.daemon.config import Config
from gripmon.io.sources.realtime import SimulatedCamera
from gripmon.model.records import Frame
from gripmon.simulate import Simulator

PACES_HZ = (60.0, 30.0, 15.0)
"""Frame rates of usual cameras (1/s), the fastest first."""

TRIAL_S = 2.0
"""How long the renderers and the monitor work as fast as they can, from the first frame on (s): the renderers' start,
which may take longer than that on a busy machine, says nothing about the pace.
"""

MARGIN = 2.0
"""By how much a machine must be faster than the pace (no unit): for two seconds, while the hand is there, a frame takes
1.4 times as long to render as the mean frame of the scenario, and recording and publishing take 1.4 times as long on
top: two cores that were 1.9 times as fast dropped 15 of 240 frames.
"""


class Pace(NamedTuple):
    """A frame rate and the rate that the trial reached, 1/s; ``live``: whether the machine can follow a camera at all,
    otherwise each frame waits until the one before was processed.
    """

    fps: float
    possible_hz: float
    live: bool

    def text(self) -> str:
        """One line for the user."""
        many = f"{self.possible_hz:.0f}" if self.possible_hz >= 1.0 else "less than 1"
        can = f"this machine renders and processes {many} frames/s"
        if not self.live:
            return f"{can}, too few for a live camera: frames of one with {self.fps:g} frames/s come when it is ready"
        return f"{can}: the camera runs at {self.fps:g} frames/s (--fps sets another)"


def pace_for(possible_hz: float) -> Pace:
    """The fastest of :data:`PACES_HZ` that leaves a margin, else the slowest, not live."""
    for fps in PACES_HZ:
        if possible_hz >= MARGIN * fps:
            return Pace(fps, possible_hz, live=True)
    return Pace(PACES_HZ[-1], possible_hz, live=False)


def measure_pace(config: Config, simulator: Simulator, processes: int) -> Pace:
    """Render and process frames from the whole scenario as fast as they come, in as many processes as later.

    Machine code must be ready (:func:`gripmon.monitor.warm_up`).  Raises :class:`SourceError` if nothing can be
    rendered.
    """
    monitor, camera = Monitor(config), config.camera
    hurried = SimulatedCamera(
        simulator,
        size_px=(camera.width_px, camera.height_px),
        fps=max(simulator.frame_count / TRIAL_S, 4.0 * PACES_HZ[0]),
        name="trial",
        processes=processes,
    )
    with contextlib.closing(hurried):
        frames, first_s, last_s = 0, 0.0, 0.0
        while not frames or time.monotonic() < first_s + TRIAL_S:
            item = hurried.read()
            if isinstance(item, Frame):
                monitor.process(item)
                last_s = time.monotonic()
                first_s = first_s or last_s
                frames += 1
    return pace_for((frames - 1) / (last_s - first_s) if frames > 1 else 0.0)
