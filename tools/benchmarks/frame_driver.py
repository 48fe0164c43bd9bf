"""A camera's driver in a process of its own: CONFIG KEY FORMAT WIDTH HEIGHT CHANNELS FRAMES HZ.

Its stamps are monotonic, a clock that all processes of a machine share: when the image was at hand, before it was
packed.
"""

from __future__ import annotations

import sys
import time

import cv2
import numpy as np
import zenoh

from gripmon.io.publish.feeding import FramePublisher

_WAIT_S = 20.0


def main(config: str, key: str, frame_format: str, *numbers: str) -> None:
    width, height, channels, frames, fps = map(int, numbers)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    shape = (height, width) if channels == 1 else (height, width, channels)
    smooth = cv2.GaussianBlur(rng.integers(0, 256, shape, np.uint8), (0, 0), 8.0)
    # Like a camera's: structure that compresses, and a little noise that doesn't.
    image = np.clip(4.0 * (smooth.astype(float) - 128.0) + 128.0 + rng.normal(0.0, 1.5, shape), 0, 255).astype(np.uint8)
    with zenoh.open(zenoh.Config.from_file(config)) as session:
        publisher = FramePublisher(session, key, frame_format)  # type: ignore[arg-type]
        time.sleep(1.0)  # subscriptions and shared memory are set up meanwhile
        start_s = time.monotonic()
        for index in range(frames):
            time.sleep(max(start_s + index / fps - time.monotonic(), 0.0))
            publisher.put(image, stamp_ns=time.monotonic_ns())
        time.sleep(0.5)


if __name__ == "__main__":
    main(*sys.argv[1:])
