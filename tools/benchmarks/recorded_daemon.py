"""A daemon that records, in a process of its own: RING DIRECTORY FRAMES.

Says ``recording PID`` (of its recording process) on standard output, then the number of each frame whose transform has
been published; what it has printed has been delivered, whatever happens to it.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import cv2

from benchmarks import harness, scene
from benchmarks.switched import SwitchedRecorder
from gripmon.model.outputs import Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord

_START_WITHIN_S = 60.0


class _Said(Output):
    """An output that writes to standard output."""

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        os.write(1, b"%d\n" % record.seq)


def _process_of(recorder: SwitchedRecorder) -> int:
    """It starts beside the loop; RuntimeError if it doesn't within a minute."""
    end_s = time.monotonic() + _START_WITHIN_S
    while recorder.process_id is None:
        if time.monotonic() > end_s:
            raise RuntimeError("no recording process began")
        time.sleep(0.01)
    return recorder.process_id


def main(ring_path: str, directory: str, frames: str) -> None:
    cv2.setNumThreads(1)
    ring = scene.Ring.load(Path(ring_path))
    height_px, width_px = ring.images.shape[1:]
    config = scene.config_for((width_px, height_px))
    recorder = SwitchedRecorder(config, Path(directory))
    recorder.on = True
    os.write(1, b"recording %d\n" % _process_of(recorder))
    harness.run_loop(config, harness.RingSource(ring, int(frames), paced=True), _Said(), recorder)


if __name__ == "__main__":
    main(*sys.argv[1:])
