"""Pictures of a recording: how they look, and frames that have none."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.recorded import (
    HEIGHT_PX,
    OVERLAY,
    WIDTH_PX,
    Recorded,
    decoded,
    frame,
    image,
    record,
    recorder,
    trace,
)

from gripmon.model.records import (
    MeasurementTrace,
    Origin,
    State,
    Verdict,
)


def test_jpeg_looks_like_the_frame(tmp_path: Path) -> None:
    writer = recorder(tmp_path)
    writer.frame(frame(0), record(0), lambda: None)
    writer.close(60.0)
    (path,) = tmp_path.glob("*.rrd")
    told = Recorded(path)
    (cell,) = told.timed(OVERLAY)
    assert cell.values["media_type"] == ["image/jpeg"]
    difference = decoded(cell.values["blob"]).astype(float) - image(0)
    assert np.abs(difference).max() < 12.0


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((3, 4, 5, 6), np.uint8),
        np.zeros((0, 4), np.uint8),
        np.zeros((HEIGHT_PX, WIDTH_PX, 7), np.uint8),
        np.zeros((10 * HEIGHT_PX, 10 * WIDTH_PX), np.float32),
        np.array(["no", "image"], dtype=object),
    ],
)
def test_what_is_no_image_is_recorded_without_one(tmp_path: Path, picture: np.ndarray) -> None:
    refused = record(1, State.LOST, Verdict.UNKNOWN, corners=(), reason="not_an_image", source=Origin.HELD)
    writer = recorder(tmp_path)
    writer.frame(frame(0), record(0), partial(trace, 0))
    writer.frame(frame(1, picture), refused, lambda: None)
    writer.close(60.0)
    (path,) = tmp_path.glob("*.rrd")
    told = Recorded(path)
    assert (told.seqs(), set(told.by_seq(OVERLAY, "blob"))) == ([0, 1], {0})
    overlay = told.by_seq(f"{OVERLAY}/edges/used", "positions")
    assert overlay[0] != [] and overlay[1] == []


def test_an_empty_trace_is_recorded(tmp_path: Path) -> None:
    none = np.empty((0, 2))
    empty = MeasurementTrace(none, np.empty(0, bool), np.empty(0, np.intp), np.empty(0), (), np.full((8, 2), np.nan))
    writer = recorder(tmp_path)
    writer.frame(frame(0), record(0, corners=()), lambda: empty)
    writer.close(60.0)
    assert writer.failure is None and writer.dropped == 0
    (path,) = tmp_path.glob("*.rrd")
    assert Recorded(path).by_seq("quality/edge_points", "scalars") == {0: [0.0, 0.0]}
