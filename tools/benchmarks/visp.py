"""ViSP's model-based edge tracker on the frames of a ring, in a process of its own that is asked frame by frame.

A small program is compiled for it where ViSP's headers are installed (Debian and Ubuntu: ``libvisp-dev``, GPL; nothing
of it becomes part of gripmon).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from benchmarks.peers import undistorting_maps
from benchmarks.scene import Ring
from gripmon.daemon.config import Config
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

_SOURCE = Path(__file__).parent / "visp_tracker.cpp"
_LIBRARIES = ("-lvisp_mbt", "-lvisp_vision", "-lvisp_me", "-lvisp_core")


def missing() -> str | None:
    """Why it can't be compared with here; None if it can."""
    if shutil.which("g++") is None or shutil.which("pkg-config") is None:
        return "no g++ or no pkg-config here (Debian: apt install g++ pkg-config libvisp-dev)"
    if subprocess.run(["pkg-config", "--exists", "visp"], check=False).returncode:
        return "ViSP isn't installed (Debian: apt install libvisp-dev)"
    return None


class VispTracker:
    """Follows the gripper from frame to frame; the jaw is taken to stand at its nominal opening."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        if self._answer() != "ready":
            raise RuntimeError("ViSP's tracker did not start")

    def track(self, place: int) -> tuple[float, Array | None]:
        """Microseconds for a frame of the ring, and the TCP (3,) in the camera frame; None where it was lost."""
        assert self._process.stdin is not None
        print(place, file=self._process.stdin, flush=True)
        first, *rest = self._answer().split()
        return (float(rest[0]), None) if first == "lost" else (float(first), np.array(rest, float))

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def tracker(config: Config, ring: Ring, cam_T_grip: Array, scratch: Path) -> Iterator[VispTracker]:
    """A tracker that starts at the ring's first frame from a pose (4, 4); ``scratch`` gets what it is made of."""
    program, model, frames = scratch / "visp_tracker", scratch / "gripper.cao", scratch / "frames.raw"
    flags = subprocess.run(["pkg-config", "--cflags", "visp"], capture_output=True, text=True, check=True)
    command = ["g++", "-O2", str(_SOURCE), "-o", str(program), *flags.stdout.split(), *_LIBRARIES]
    subprocess.run(command, check=True)
    model.write_text(model_text(config.gripper), encoding="ascii")
    # It knows no such lens: it gets images without distortion, and their making isn't in its time.
    maps = undistorting_maps(config.camera)
    with frames.open("wb") as file:
        for image in ring.images:
            file.write(np.ascontiguousarray(cv2.remap(image, *maps, cv2.INTER_LINEAR)).tobytes())
    camera = config.camera
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *np.ravel(cam_T_grip).tolist())
    arguments = [str(model), str(frames), *map(str, (len(ring), camera.width_px, camera.height_px, *numbers))]
    process = subprocess.Popen([str(program), *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield VispTracker(process)
    finally:
        process.communicate(timeout=60)


def model_text(gripper: Gripper) -> str:
    """The gripper at its nominal opening in ViSP's format CAO: points in metres, faces by points, counter-clockwise
    seen from outside.  The fingers' rear faces lie in their carriers and are left out.
    """
    points = gripper.points_grip_m(None)
    seen = [
        face.points for face in gripper.faces if np.ptp(points[face.points, 2]) > 0.0 or points[face.points[0], 2] == 0
    ]
    lines = ["V1", str(len(points)), *(" ".join(f"{x:.9f}" for x in point) for point in points), "0", "0"]
    lines += [str(len(seen)), *(" ".join(map(str, (len(loop), *loop))) for loop in seen), "0", "0"]
    return "\n".join(lines) + "\n"
