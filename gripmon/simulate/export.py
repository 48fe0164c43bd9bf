"""Writes a simulated sequence as files: images, ``timestamps.csv`` and ``truth.jsonl``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2

from gripmon.simulate.sequence import Simulator

PNG_COMPRESSION = 1  # noise doesn't compress; time matters more


def write_sequence(simulator: Simulator, out_dir: Path, progress: Callable[[int, int], None] | None = None) -> int:
    """Write all frames of a scenario into a folder (made if missing); returns their number.

    ``timestamps.csv`` has the columns ``file,stamp_ns,jaw_opening_m`` (what the robot reports; empty where it doesn't),
    ``truth.jsonl`` one line a frame.  ``progress(done, total)`` is called after each frame.  Raises OSError when a
    file can't be written, FileExistsError when the folder already holds a sequence.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    total = simulator.frame_count
    digits = max(len(str(total - 1)), 6)
    # Mode "x": an older sequence is never mixed with this one.
    stamps_path, truth_path = out_dir / "timestamps.csv", out_dir / "truth.jsonl"
    with stamps_path.open("x", encoding="utf-8") as stamps, truth_path.open("xb") as truths:
        stamps.write("file,stamp_ns,jaw_opening_m\n")
        for index in range(total):
            file = f"{index:0{digits}d}.png"
            image, truth = simulator.render(index), simulator.truth(index)
            if not cv2.imwrite(str(out_dir / file), image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]):
                raise OSError(f"can't write {out_dir / file}")
            opening = "" if truth.jaw_reported_m is None else repr(truth.jaw_reported_m)
            stamps.write(f"{file},{truth.stamp_ns},{opening}\n")
            truths.write(truth.to_json(file) + b"\n")
            if progress is not None:
                progress(index + 1, total)
    return total
