"""Faults of the frame stream, from frames alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gripmon.judge.stream import (
    StreamSettings,
    StreamWatch,
    _stands_in_large_parts,
)
from gripmon.model.records import Cause, Frame

FPS = 30.0
START_NS = 1_700_000_000_000_000_000


def picture(number: int, shape: tuple[int, ...] = (48, 64), dtype: str = "uint8") -> np.ndarray:
    """Noise of its own about a grey ramp."""
    ramp = np.linspace(40.0, 200.0, shape[1]).reshape((1, -1) + (1,) * (len(shape) - 2))
    grey = ramp + np.random.default_rng(number).normal(0.0, 3.0, shape)
    return (np.clip(grey, 0, 255)).astype(np.uint8).astype(dtype)


def frames(first: int, count: int, fps: float = FPS, start_ns: int = START_NS) -> list[Frame]:
    return [Frame(k, start_ns + round(k * 1e9 / fps), picture(k)) for k in range(first, first + count)]


def kinds(watch: StreamWatch, stream: Iterable[Frame]) -> list[set[str]]:
    return [{fault.kind for fault in watch.add(frame)} for frame in stream]


def after(well: list[Frame], count: int, fps: float = FPS, **changes: object) -> list[Frame]:
    """Frames that go on after others, at a rate, with fields replaced."""
    last = well[-1]
    return [
        replace(
            Frame(last.seq + k, last.stamp_ns + round(k * 1e9 / fps), picture(last.seq + k)),
            **changes,  # type: ignore[arg-type]
        )
        for k in range(1, count + 1)
    ]


def test_a_good_stream_has_no_faults_and_its_rate_is_known():
    watch = StreamWatch()
    assert watch.frames_per_s is None
    assert not any(kinds(watch, frames(0, 300)))
    assert watch.frames_per_s == pytest.approx(FPS, rel=1e-6)


def test_arrival_times_that_jitter_are_no_fault():
    rng = np.random.default_rng(1)
    watch = StreamWatch()
    jittered = [replace(f, stamp_ns=f.stamp_ns + int(rng.normal(0.0, 5e6))) for f in frames(0, 600)]
    assert not any(kinds(watch, jittered))
    assert watch.frames_per_s == pytest.approx(FPS, rel=0.1)


def test_dropped_frames_are_no_other_rate():
    """A slow receiver sees every third frame only: their numbers tell."""
    watch = StreamWatch()
    well = frames(0, 150)
    assert not any(kinds(watch, [*well, *after(well, 450)[::3]]))
    assert watch.frames_per_s == pytest.approx(FPS / 3.0, rel=1e-6)


@pytest.mark.parametrize("buffers", [1, 2, 4])
def test_a_camera_that_hangs_is_told_after_a_second(buffers: int):
    watch = StreamWatch()
    well = frames(0, 150)
    assert not any(kinds(watch, well))
    held = [f.image for f in well[-buffers:]]
    frozen = [replace(f, image=held[k % buffers]) for k, f in enumerate(after(well, 60))]
    found = kinds(watch, frozen)
    assert watch.repeats
    first = found.index({"frozen"})
    assert 28 <= first <= 33
    assert all(f == {"frozen"} for f in found[first:])
    assert not any(kinds(watch, after(frozen, 30)))


def test_a_frozen_camera_whose_stamps_stand_still_too():
    watch = StreamWatch()
    well = frames(0, 150)
    kinds(watch, well)
    last = well[-1]
    found = kinds(watch, [last] * 60)
    assert found[-1] == {"frozen", "clock"}


def test_a_source_that_shows_every_frame_twice_is_not_frozen():
    """A camera of 15 frames a second behind an interface of 30."""
    watch = StreamWatch(StreamSettings(frozen_frames=2, frozen_s=0.03))
    twice = [replace(f, image=picture(f.seq // 2)) for f in frames(0, 300)]
    assert not any(kinds(watch, twice))


@pytest.mark.parametrize(("buffers", "told"), [(8, True), (9, False)])
def test_a_ring_of_up_to_eight_buffers_is_recognised(buffers: int, told: bool):
    watch = StreamWatch()
    well = frames(0, 150)
    kinds(watch, well)
    held = [f.image for f in well[-buffers:]]
    found = kinds(watch, [replace(f, image=held[k % buffers]) for k, f in enumerate(after(well, 60))])
    assert ({"frozen"} in found) == told


def test_a_source_that_repeats_is_frozen_after_four_times_its_longest_repetition():
    watch = StreamWatch(StreamSettings(frozen_frames=3, frozen_s=0.03))
    thrice = [replace(f, image=picture(f.seq // 3)) for f in frames(0, 150)]
    assert not any(kinds(watch, thrice))
    found = kinds(watch, after(thrice, 20, image=picture(1000)))
    assert found.index({"frozen"}) == 4 * 2


@pytest.mark.parametrize(("inner", "told"), [(200, True), (199, False)])
def test_200_pixels_neither_black_nor_white_are_enough_to_tell_a_coder(inner: int, told: bool):
    before = np.full(1000, 128, np.uint8)
    before[inner:] = np.arange(1000 - inner) % 2 * 255
    now = before.copy()
    now[0] = 129
    assert _stands_in_large_parts(now, before) == told


def test_frames_that_repeat_for_a_moment_are_not_frozen():
    watch = StreamWatch()
    well = frames(0, 150)
    kinds(watch, well)
    assert not any(kinds(watch, after(well, 20, image=well[-1].image)))


def coded(path: Path, codec: str, count: int = 60) -> list[np.ndarray]:
    """What FFmpeg makes of a standing scene, in which something small moves, with little noise."""
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (480, 640)).astype(np.float32), (0, 0), 6.0)
    scene = cv2.normalize(scene, None, 40.0, 210.0, cv2.NORM_MINMAX)
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), FPS, (640, 480), False)
    for k in range(count):
        image = scene + rng.normal(0.0, 0.3, scene.shape)
        image[100:140, 40 + 3 * k : 80 + 3 * k] = 220.0
        out.write(np.clip(image, 0.0, 255.0).astype(np.uint8))
    out.release()
    reader = cv2.VideoCapture(str(path))
    read = [reader.read()[1][:, :, 0] for _ in range(count)]
    reader.release()
    return read


@pytest.mark.parametrize(("codec", "ending", "frozen_s"), [("mp4v", "mp4", 10.0), ("MJPG", "avi", 1.0)])
def test_a_coder_that_sends_nothing_for_what_stands_is_given_more_time(
    tmp_path: Path, codec: str, ending: str, frozen_s: float
):
    """MPEG-4 leaves out what stands still, as H.264 does; of JPEGs each is an image of its own."""
    images = coded(tmp_path / f"camera.{ending}", codec)
    watch = StreamWatch()
    well = [replace(f, image=image) for f, image in zip(frames(0, len(images)), images, strict=True)]
    assert not any(kinds(watch, well))
    found = kinds(watch, after(well, round(12 * FPS), image=well[-1].image))
    first = found.index({"frozen"})
    assert frozen_s * FPS - 2 <= first <= frozen_s * FPS + 3
    assert all(f == {"frozen"} for f in found[first:])


def test_whole_images_in_between_tell_how_long_a_coder_may_be_silent():
    """Eight seconds of the same, and an image again: so it goes on for a minute without a fault."""
    watch = StreamWatch()
    still = picture(0)
    stream = []
    for k, frame in enumerate(frames(0, round(60 * FPS))):
        if k < 30:  # something small moves, the rest stands
            still = still.copy()
            still[12, 8 + k] ^= 1
        elif k % 240 == 0:
            still = picture(k)
        stream.append(replace(frame, image=still))
    assert not any(kinds(watch, stream))


def test_a_sensors_little_noise_is_no_coder():
    """A tenth of a grey level, over- and underexposed in large parts: frozen after a second, as any other."""
    rng = np.random.default_rng(2)
    scene = np.clip(rng.uniform(-300.0, 550.0, (48, 64)), 0.0, 255.0)
    watch, stream = StreamWatch(), []
    for frame in frames(0, 300):
        noisy = np.rint(np.clip(scene + rng.normal(0.0, 0.1, scene.shape), 0.0, 255.0))
        stream.append(replace(frame, image=noisy.astype(np.uint8)))
    assert not any(kinds(watch, stream))
    assert 28 <= kinds(watch, after(stream, 60, image=stream[-1].image)).index({"frozen"}) <= 33


def test_an_even_image_is_another_fault():
    watch = StreamWatch()
    black = [replace(f, image=np.zeros((48, 64), np.uint8)) for f in frames(0, 150)]
    assert not any(kinds(watch, black))


@pytest.mark.parametrize(
    ("change_ns", "kind", "cause"),
    [(-50_000_000, "clock", Cause.CLOCK), (-(10**15), "clock", Cause.CLOCK), (60 * 10**9, "gap", Cause.UNKNOWN)],
)
def test_a_clock_that_was_set_is_told_and_forgotten(change_ns: int, kind: str, cause: Cause):
    watch = StreamWatch()
    well = frames(0, 150)
    kinds(watch, well)
    later = [replace(f, stamp_ns=f.stamp_ns + change_ns) for f in after(well, 80)]
    told = watch.add(later[0])
    assert [(f.kind, f.cause) for f in told] == [(kind, cause)]
    found = kinds(watch, later[1:])
    assert all(found[:29]) and not any(found[29:])


@pytest.mark.parametrize(
    ("fps", "pause_s", "told"), [(FPS, 4.9, False), (FPS, 5.2, True), (1.0, 49.0, False), (1.0, 51.0, True)]
)
def test_a_gap_is_fifty_periods_and_five_seconds_long(fps: float, pause_s: float, told: bool):
    watch = StreamWatch()
    well = frames(0, 100, fps)
    kinds(watch, well)
    found = kinds(watch, after(well, 1, fps=1.0 / pause_s))
    assert found == [{"gap"} if told else set()]


def test_the_rate_is_that_of_the_last_64_intervals():
    watch = StreamWatch()
    well = frames(0, 100)
    kinds(watch, well)
    slower = after(well, 34, fps=15.0)
    kinds(watch, slower[:31])
    assert watch.frames_per_s == pytest.approx(FPS, rel=1e-6)
    kinds(watch, slower[31:])
    assert watch.frames_per_s == pytest.approx(15.0, rel=1e-6)


def test_a_clock_that_stands_still_is_told_but_not_one_frame_handed_over_twice():
    watch = StreamWatch()
    well = frames(0, 150)
    assert not any(kinds(watch, [*well, well[-1], *after(well, 60)]))
    later = after(after(well, 60), 40, stamp_ns=well[-1].stamp_ns + 2 * 10**9)
    assert kinds(watch, later)[-1] == {"clock"}


def test_frames_minutes_apart_are_no_gaps():
    assert not any(kinds(StreamWatch(), frames(0, 100, fps=0.01)))


@pytest.mark.parametrize("other", [picture(1, (40, 64)), picture(1, (48, 64, 3)), picture(1, dtype="uint16")])
def test_images_of_another_size_or_type_are_another_camera(other: np.ndarray):
    watch = StreamWatch()
    well = frames(0, 20)
    kinds(watch, well)
    later = [replace(f, image=other + (f.seq % 2)) for f in after(well, 10)]
    assert [bool(k) for k in kinds(watch, later)] == [False, False] + [True] * 8
    fault = next(f for f in watch.add(later[-1]) if f.kind == "replaced")
    assert fault.cause is Cause.CAMERA_REPLACED
    assert "they were 64x48 px of type uint8" in fault.text
    assert not kinds(watch, after(later, 5))[-1]


def test_one_odd_image_is_not_another_camera():
    watch = StreamWatch()
    well = frames(0, 20)
    assert not any(kinds(watch, [*well, *after(well, 1, image=picture(1, (40, 64))), *after(well, 5)[1:]]))


@pytest.mark.parametrize("bad", [None, "no image", np.zeros(5), np.zeros((0, 0)), np.full((48, 64), np.nan)])
def test_bad_images_raise_nothing(bad: object):
    watch = StreamWatch()
    for frame in frames(0, 60):
        assert isinstance(watch.add(replace(frame, image=bad)), tuple)  # type: ignore[arg-type]
