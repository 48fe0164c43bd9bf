"""``tools/bench frames`` in small: every frame of every format arrives and is timed.  No speed is asserted."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"
FRAMES = 30


@pytest.mark.slow("10 s: a benchmark in small; what comes over the network is tested with the source")
@pytest.mark.parametrize(("frame_format", "shared"), [("raw", True), ("jpeg", False)])
def test_a_row_in_small(frame_format: str, shared: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TOOLS), str(TOOLS.parent), *sys.path]))
    from benchmarks import frames_in

    row = frames_in.measure((96, 64, 1), frame_format, shared=shared, frames=FRAMES)
    assert 2 <= row.frames <= FRAMES - frames_in._LEFT_OUT
    assert 0.0 < row.median <= row.most
    assert row.payload_bytes == 96 * 64 if frame_format == "raw" else row.payload_bytes < 96 * 64 + 2000
