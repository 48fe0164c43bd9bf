"""Monitor a folder of images: where does the camera stand against the gripper, and may a controller use it?

It simulates the images first, so it needs no hardware.  With your own, begin at ``load_config``:
``config.yaml`` describes your camera, gripper and calibration (its keys: Reference, Configuration).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import gripmon


def main(folder: Path) -> None:
    """Simulate a camera that a cable pulls aside, and watch it."""
    gripmon.simulate_images("creep", folder, duration_s=3.0, fps=10.0, seed=2)

    config = gripmon.load_config(folder / "config.yaml")
    expected = gripmon.forecast(config)
    print(f"{expected.in_view.corners} corners in view; {expected.promise}")

    monitor = gripmon.Monitor(config)  # no network, no files
    for frame in gripmon.open_source(folder):
        record = monitor.process(frame)
        if record.drift is None:
            print(f"{frame.name}: {record.verdict}, {record.reason}")
            continue
        x, y, z = (1e3 * shift for shift in record.drift.tcp_shift_m)
        print(f"{frame.name}: {record.verdict}, the TCP has moved by ({x:+.3f}, {y:+.3f}, {z:+.3f}) mm")
        for alert in record.alerts:
            print(f"    {alert.severity}: {alert.text}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
