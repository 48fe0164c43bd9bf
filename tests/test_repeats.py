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
from support.watched import new_monitor, rendered

from gripmon.judge import repeats
from gripmon.judge.repeats import TEXT, TILE_PX, repeated_edges
from gripmon.judge.stream import StreamSettings
from gripmon.model.records import AlertEvent, AlertKind, Cause, Frame, FrameRecord, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import Background, Bump, Sensor

FPS = 15.0
SILENT, NEW, OLD = "silent", "new", "old"
QUIET = Sensor(read_noise_dn=0.2, shot_noise_dn=0.001)


def scene(duration_s: float, sensor: Sensor | None = None, mount: tuple[Bump, ...] = ()) -> Scenario:
    """The robot stands still, and with it all that a wrist camera sees."""
    still = Background(motion="still")
    return Scenario(
        name="repeats", duration_s=duration_s, fps=FPS, sensor=sensor or Sensor(), mount=mount, background=still
    )


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


@pytest.mark.parametrize(("knocked", "buffers"), [(False, 3), (True, 1)])
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


def test_once_nothing_is_measured_a_repetition_isnt_told_on():
    """What an earlier frame repeated says nothing about those in which the gripper isn't seen."""
    frames, _ = rendered(scene(6.0))
    until = 50
    noise = np.random.default_rng(0).integers(60, 120, frames[0].image.shape, dtype=np.uint8)
    elsewhere = [replace(frame, image=np.roll(noise, k)) for k, frame in enumerate(frames[until:])]
    records = watched(new_monitor(), [*with_old_rows(frames[:until], 30, 0.15, 1), *elsewhere])
    assert all(record.source.value != "update" for record in records[until:])
    stream = [alert for record in records for alert in record.alerts if alert.kind is AlertKind.STREAM]
    assert [alert.event for alert in stream] == [AlertEvent.RAISED, AlertEvent.CLEARED]


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


@pytest.mark.parametrize(("frozen_coded_s", "stays"), [(10.0, True), (2.0, False)])
def test_a_still_robot_as_h264_stays_valid_for_as_long_as_a_coder_may_leave_it_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frozen_coded_s: float, stays: bool
):
    """Eight seconds without a key frame, in which most pixels beside the edges are never sent."""
    frames, _ = rendered(scene(9.0, QUIET))
    old: list[bool] = []

    def spied(*args: object) -> tuple[np.ndarray, np.ndarray]:
        found = repeated_edges(*args)
        old.append(bool(found[1].any()))
        return found

    monkeypatch.setattr(repeats, "repeated_edges", spied)
    monitor = new_monitor(MonitorSettings(stream=StreamSettings(frozen_coded_s=frozen_coded_s)))
    records = watched(monitor, h264(frames, tmp_path / "still.mp4", 8.0))
    assert sum(old) > 30  # else it would show nothing
    doubted = [record for record in records[5:] if record.verdict is not Verdict.VALID]
    assert (not doubted) == stays
    assert all(record.reason == TEXT or "frozen" in record.reason for record in doubted[:1])


@pytest.mark.parametrize(("sensor", "quality"), [(Sensor(), 40), (QUIET, None)])
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


class Edges:
    """Three edges with points every four pixels: along the rows 40 and 104, and a short one down a column; some image
    types.
    """

    def __init__(self, dtype: str, channels: int) -> None:
        self.white = {"uint8": 255, "uint16": 65535, "float32": 1.0}[dtype]
        self.dtype, self.shape = dtype, (128, 160) + (() if channels == 1 else (channels,))
        along = [(x, y, e) for e, y in enumerate((40, 104)) for x in range(10, 150, 4)]
        points = np.array([*along, (80, 66, 2), (80, 70, 2)], float)
        self.uv_px, self.edge = points[:, :2], points[:, 2].astype(np.intp)
        self.ring, self.slot = np.zeros((9, 80), np.uint64), 0

    def noise(self, seed: int) -> np.ndarray:
        share = np.random.default_rng(seed).uniform(0.1, 0.9, self.shape)
        return (share * self.white).astype(self.dtype)

    def states(self, image: np.ndarray) -> list[str]:
        self.slot = (self.slot + 1) % len(self.ring)
        bits = {"uint8": 255, "uint16": 65535, "float32": 0x3F800000}[self.dtype]
        pixels = np.ascontiguousarray(image).view(np.uint8).reshape(len(image), -1)
        count, none = len(self.edge), np.zeros((len(self.edge), 2))
        each = np.arange(count, dtype=np.intp), np.zeros(count), np.ones(count)
        sizes = image.itemsize, pixels.shape[1] // image.shape[1]
        new, old = repeated_edges(pixels, *sizes, bits, self.uv_px, none, *each, self.edge, self.ring, self.slot, 3)
        assert not (new & old).any()
        return [NEW if n else OLD if o else SILENT for n, o in zip(new, old, strict=True)]


@pytest.mark.parametrize(("dtype", "channels"), [("uint8", 1), ("uint8", 3), ("uint16", 1), ("float32", 1)])
def test_which_edges_lie_among_old_pixels(dtype: str, channels: int):
    edges = Edges(dtype, channels)
    before, now = edges.noise(0), edges.noise(1)
    assert edges.states(before) == [NEW, NEW, SILENT]  # the third lies in one tile, which is too little to tell
    assert edges.states(now) == [NEW, NEW, SILENT]
    mixed = np.concatenate([edges.noise(2)[:64], before[64:]])
    assert edges.states(mixed) == [NEW, OLD, SILENT]
    mixed = mixed.copy()
    mixed[100, 100] = now[100, 100]
    mixed[:64] = edges.noise(3)[:64]
    assert edges.states(mixed) == [NEW, NEW, SILENT]  # one pixel, of those that are looked at
    # What is cut off says nothing: the tiles of an edge that are white, and black, for more than a half.
    cut_off = edges.noise(4)
    cut_off[96:104], cut_off[104:106] = 0, edges.white
    assert edges.states(cut_off) == [NEW, SILENT, SILENT]


@pytest.mark.parametrize(("ago", "state"), [(1, OLD), (8, OLD), (9, NEW)])
def test_up_to_eight_frames_are_remembered(ago: int, state: str):
    edges = Edges("uint8", 1)
    images = [edges.noise(k) for k in range(ago)]
    for image in images:
        edges.states(image)
    assert edges.states(np.concatenate([edges.noise(99)[:64], images[0][64:]])) == [NEW, state, SILENT]


def test_tiles_of_different_frames_are_no_earlier_frame():
    """Of a strongly compressed JPEG each tile may be that of some frame before by chance."""
    edges = Edges("uint8", 1)
    images = [edges.noise(k) for k in range(2)]
    for image in images:
        edges.states(image)
    assert edges.states(np.concatenate([images[0][:, :80], images[1][:, 80:]], axis=1)) == [NEW, NEW, SILENT]
