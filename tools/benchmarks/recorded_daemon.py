"""A daemon that records, in a process of its own: RING DIRECTORY FRAMES.

Says ``recording PID`` (of its recording process) on standard output, then the number of each frame whose transform has
been published; what it has printed has been delivered, whatever happens to it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cv2

from benchmarks import harness, kit, scene
from benchmarks.switched import SwitchedRecorder
from gripmon.model.outputs import Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord


class _Said(Output):
    """An output that writes to standard output."""

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        os.write(1, b"%d\n" % record.seq)


def main(ring_path: str, directory: str, frames: str) -> None:
    cv2.setNumThreads(1)
    ring = scene.Ring.load(Path(ring_path))
    config = scene.config_for(ring.size)
    recorder = SwitchedRecorder(config, Path(directory))
    recorder.on = True
    kit.until(lambda: recorder.process_id is not None, "no recording process began")  # it starts beside the loop
    os.write(1, b"recording %d\n" % recorder.process_id)
    harness.run_loop(config, harness.RingSource(ring, int(frames), paced=True), _Said(), recorder)


if __name__ == "__main__":
    main(*sys.argv[1:])
