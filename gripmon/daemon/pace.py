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
"""How long the renderers and the monitor work as fast as they can (s)."""

MARGIN = 1.5
"""By how much a machine must be faster than the pace (no unit): recording, publishing and searching come on top, and a
frame that shows a hand takes up to 1.4 times as long to render as the mean.
"""


class Pace(NamedTuple):
    """A frame rate and the rate that the trial reached, 1/s."""

    fps: float
    possible_hz: float

    def text(self) -> str:
        """One line for the user."""
        can = f"this machine renders and processes {self.possible_hz:.0f} frames/s"
        slow = "" if self.possible_hz >= self.fps else ", too few even for that"
        return f"{can}: the camera runs at {self.fps:g} frames/s{slow} (--fps sets another)"


def pace_for(possible_hz: float) -> Pace:
    """The fastest of :data:`PACES_HZ` that leaves a margin, else the slowest."""
    fits = (fps for fps in PACES_HZ if possible_hz >= MARGIN * fps)
    return Pace(next(fits, PACES_HZ[-1]), possible_hz)


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
        end_s, frames, first_s, last_s = time.monotonic() + TRIAL_S, 0, 0.0, 0.0
        while time.monotonic() < end_s:
            item = hurried.read()
            if isinstance(item, Frame):
                monitor.process(item)
                last_s = time.monotonic()
                first_s = first_s or last_s
                frames += 1
    return pace_for((frames - 1) / (last_s - first_s) if frames > 2 else 0.0)
