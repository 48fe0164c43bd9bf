"""Old pixels beside the edges, in images that are new elsewhere."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support.watched import Watched, new_monitor, reference_of, rendered

from gripmon.judge import repeats
from gripmon.judge.repeats import FEWEST_TILES, NEW, OLD, SILENT, TEXT, TILE_PX, repeated_edges
from gripmon.judge.stream import StreamSettings
from gripmon.model.records import Alert, AlertKind, Cause, Frame, FrameRecord, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import Bump, Sensor

FPS = 15.0
QUIET = Sensor(read_noise_dn=0.2, shot_noise_dn=0.001)


def scene(duration_s: float, sensor: Sensor | None = None, mount: tuple[Bump, ...] = ()) -> Scenario:
    return Scenario(name="repeats", duration_s=duration_s, fps=FPS, sensor=sensor or Sensor(), mount=mount)


def with_old_rows(frames: Sequence[Frame], first: int, kept_share: float, buffers: int) -> list[Frame]:
    """From frame ``first`` on only the upper rows arrive; below stands what was in the decoder's buffer, of which it
    has several in turn.
    """
    pool: deque[np.ndarray] = deque([frame.image for frame in frames[first - buffers : first]], maxlen=buffers)
    out = list(frames[:first])
    for frame in frames[first:]:
        image = pool.popleft().copy()
        rows = TILE_PX * round(kept_share * len(image) / TILE_PX)
        image[:rows] = frame.image[:rows]
        pool.append(image)
        out.append(replace(frame, image=image))
    return out


def watched(monitor: Monitor, frames: Sequence[Frame]) -> list[FrameRecord]:
    return [monitor.process(frame) for frame in frames]


@pytest.mark.parametrize("buffers", [1, 3])
@pytest.mark.parametrize("knocked", [False, True])
def test_rows_that_are_left_from_before_are_never_valid(knocked: bool, buffers: int):
    """Whether the mount was knocked meanwhile can't be known then; afterwards it is."""
    mount = (Bump(at_s=2.0, tcp_shift_m=(0.003, 0.003)),) if knocked else ()
    frames, _ = rendered(scene(5.0, mount=mount))
    first, until = 30, 60
    damaged = with_old_rows(frames[:until], first, 0.15, buffers)
    records = watched(new_monitor(), [*damaged, *frames[until:]])
    assert all(record.verdict is Verdict.VALID for record in records[2:first])
    assert [record.verdict for record in records[first:until]] == [Verdict.SUSPECT] * (until - first)
    assert {record.reason for record in records[first : first + 15]} == {TEXT}
    raised = [alert for record in records[first:until] for alert in record.alerts if alert.kind is AlertKind.STREAM]
    assert [(alert.cause, alert.text) for alert in raised] == [(Cause.CAMERA_FROZEN, TEXT)]
    assert sum(record.verdict is Verdict.VALID for record in records[until:]) >= 10


def h264(frames: Sequence[Frame], path: Path, key_frame_s: float) -> list[Frame]:
    """What a camera's H.264 makes of the frames: it leaves out what stands still, from key frame to key frame."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=round(FPS))
        stream.height, stream.width = frames[0].image.shape
        stream.pix_fmt = "yuv420p"
        gop = round(key_frame_s * FPS)
        stream.options = {"g": f"{gop}", "keyint_min": f"{gop}", "crf": "28", "tune": "zerolatency", "threads": "1"}
        for frame in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="gray8")))
        out.mux(stream.encode())
    with av.open(str(path)) as back:
        images = [picture.to_ndarray(format="gray") for picture in back.decode(video=0)]
    return [replace(frame, image=image) for frame, image in zip(frames, images, strict=True)]


def test_a_still_robot_as_h264_stays_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Eight seconds without a key frame, in which most pixels beside the edges are never sent."""
    frames, _ = rendered(scene(9.0, QUIET))
    states: list[np.ndarray] = []

    def spied(*args: object) -> np.ndarray:
        states.append(repeated_edges(*args))
        return states[-1]

    monkeypatch.setattr(repeats, "repeated_edges", spied)
    records = watched(new_monitor(), h264(frames, tmp_path / "still.mp4", 8.0))
    old = np.array([bool((state == OLD).any()) for state in states])
    assert old.sum() > 30  # else it would show nothing
    assert [record.seq for record in records[5:] if record.verdict is not Verdict.VALID] == []


@pytest.mark.parametrize("quality", [None, 90, 40])
@pytest.mark.parametrize("sensor", [Sensor(), QUIET])
def test_jpegs_of_a_still_robot_are_new_each_time(sensor: Sensor, quality: int | None):
    """Down to a noise of 0.2 grey levels and strong compression."""
    frames, _ = rendered(scene(2.0, sensor))
    if quality is not None:
        files = [cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for frame in frames]
        frames = tuple(
            replace(frame, image=cv2.imdecode(file, cv2.IMREAD_GRAYSCALE))
            for frame, file in zip(frames, files, strict=True)
        )
    records = watched(new_monitor(), frames)
    assert all(record.verdict is Verdict.VALID for record in records[2:])
