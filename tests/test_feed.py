"""``gripmon feed``: what it sends of a folder, a video, a damaged file, and what it says when it can't."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.loopback import free_endpoint, wait_until

from gripmon.cli import main
from gripmon.io.sources import NetworkCamera, NetworkSettings
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.records import Frame

SIZE_PX = (48, 32)
KEY = "gripmon/arm/wrist/image"


class Heard:
    """Every frame that comes to a monitor's end, in a thread of its own."""

    def __init__(self, endpoint: str, key: str = KEY) -> None:
        self.endpoint = endpoint
        self.frames: list[Frame] = []
        self._link = Link(PublishSettings(listen=(endpoint,)))
        self.camera = NetworkCamera(NetworkSettings(key=key), self._link, key, SIZE_PX)
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while (item := self.camera.read()) is not None:
            if isinstance(item, Frame):
                self.frames.append(item)

    def close(self) -> None:
        self.camera.close()
        self._thread.join()
        self._link.close()


@pytest.fixture
def heard() -> Iterator[Heard]:
    made = Heard(free_endpoint())
    yield made
    made.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = tmp_path / "images"
    images.mkdir()
    rows = ["file,stamp_ns,jaw_opening_m"]
    for index in range(4):
        cv2.imwrite(str(images / f"{index}.png"), image_of(index))
        rows.append(f"{index}.png,{index * 50_000_000},{0.01 * index}")
    (images / "timestamps.csv").write_text("\n".join(rows))
    return images


def image_of(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, SIZE_PX[::-1], np.uint8)


def feed(heard: Heard, source: Path | str, *options: str) -> int:
    return main(["feed", str(source), "--robot", "arm", "--connect", heard.endpoint, *options])


@pytest.mark.parametrize("frame_format", ["raw", "png"])
def test_a_folder_is_sent_with_its_openings_and_stamps(
    heard: Heard, folder: Path, frame_format: str, capsys: pytest.CaptureFixture[str]
):
    assert feed(heard, folder, "--format", frame_format, "--recorded-stamps", "--fps", "5") == 0
    assert f"feed: 4 frames sent on {KEY}" in capsys.readouterr().err
    wait_until(lambda: len(heard.frames) + heard.camera.dropped >= 4, "the frames")
    for frame in heard.frames:
        index = round(frame.stamp_ns / 50_000_000)
        np.testing.assert_array_equal(frame.image, image_of(index))
        assert frame.jaw_opening_m == pytest.approx(0.01 * index)


def test_stamps_are_those_of_sending_and_the_pace_is_the_inputs(heard: Heard, folder: Path):
    before_ns = time.time_ns()
    assert feed(heard, folder) == 0
    took_ns = time.time_ns() - before_ns
    assert took_ns > 150_000_000, "four frames, 50 ms apart"
    wait_until(lambda: heard.frames, "a frame")
    stamps = [frame.stamp_ns for frame in heard.frames]
    assert stamps == sorted(stamps) and before_ns < stamps[0] and stamps[-1] < before_ns + took_ns


def test_it_waits_for_a_monitor_that_starts_later(folder: Path):
    endpoint = free_endpoint()
    codes: list[int] = []
    command = ["feed", str(folder), "--robot", "arm", "--connect", endpoint, "--key", "cell/camera", "--fps", "4"]
    driver = threading.Thread(target=lambda: codes.append(main(command)))
    driver.start()
    time.sleep(0.3)
    late = Heard(endpoint, "cell/camera")
    try:
        driver.join(60.0)
        assert codes == [0]
        wait_until(lambda: late.frames, "a frame")
    finally:
        late.close()


def test_damaged_files_are_left_out_and_counted(heard: Heard, folder: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "1.png").write_bytes(b"no image")
    assert feed(heard, folder) == 0
    assert "3 frames sent" in (said := capsys.readouterr().err)
    assert "1 not (1.png: truncated, damaged or not an image)" in said


def test_nothing_to_send_is_a_failure(heard: Heard, folder: Path, capsys: pytest.CaptureFixture[str]):
    for path in folder.glob("*.png"):
        path.write_bytes(b"no image")
    assert feed(heard, folder) == 3
    assert "0 frames sent" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["nowhere.mp4", "--robot", "arm"],
            "feed: nowhere.mp4: there is no such folder or file; a folder of images, a video",
        ),
        (["{folder}", "--robot", "a/b"], "robot name 'a/b' can't be part of a Zenoh key"),
        (["{folder}", "--robot", "arm", "--connect", "localhost"], "feed: --connect: 'localhost' is not an endpoint; "),
        (["{folder}", "--robot", "arm", "--zenoh-config", "/nowhere.json5"], "feed: --zenoh-config: no file /nowhere"),
        (
            ["{folder}", "--robot", "arm", "--zenoh-config", "x.json5", "--connect", "tcp/127.0.0.1:1"],
            "feed: --connect has no effect beside --zenoh-config",
        ),
        (["{empty}", "--robot", "arm"], "no image in"),
        (["{folder}", "--robot", "arm", "--key", "cell//camera"], "feed: key 'cell//camera' isn't a key"),
        (["{folder}", "--robot", "arm", "--key", "gripmon/**"], "feed: key 'gripmon/**' isn't a key"),
        (["{folder}", "--robot", "arm", "--key", ""], "feed: key '' isn't a key"),
    ],
)
def test_what_cant_be_sent_is_said_in_one_line(
    folder: Path, tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "empty").mkdir()
    assert main(["feed", *(a.format(folder=folder, empty=tmp_path / "empty") for a in arguments)]) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1, text


@pytest.mark.parametrize("options", [["--quality", "0"], ["--fps", "0"], ["--format", "bmp"], []])
def test_wrong_usage_ends_at_once(options: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["feed", "images", *(["--robot", "arm", *options] if options else [])])
    assert ended.value.code == 2
    assert "gripmon feed: error: " in capsys.readouterr().err
