"""Folder and video: what is read is what was written, and what is broken says so."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from support.episode_files import write_video_at

from gripmon.io.sources import (
    FolderSettings,
    FolderSource,
    LiveSettings,
    Source,
    SourceError,
    SourceSettings,
    VideoSettings,
    VideoSource,
    open_source,
    settings_for_path,
)
from gripmon.io.sources.files import by_opencv
from gripmon.model.images import grey_image, natural_key, read_image
from gripmon.model.records import Frame


def picture(seed: int, shape: tuple[int, ...] = (48, 64), dtype: type = np.uint8) -> np.ndarray:
    top = 65535 if dtype is np.uint16 else 255
    return np.random.default_rng(seed).integers(0, top, shape).astype(dtype)


def write(folder: Path, name: str, image: np.ndarray) -> bytes:
    done, data = cv2.imencode(Path(name).suffix, image)
    assert done
    (folder / name).write_bytes(data.tobytes())
    return data.tobytes()


def read_all(source: Source) -> list[Frame]:
    frames = []
    while (frame := source.read()) is not None:
        assert isinstance(frame, Frame)
        frames.append(frame)
    assert source.read() is None
    return frames


def folder_frames(folder: Path, **settings) -> list[Frame]:
    return read_all(open_source(FolderSettings(path=str(folder), **settings)))


# --- settings ---


@pytest.mark.parametrize(
    ("plain", "expected"),
    [
        ({"kind": "folder", "path": "x"}, FolderSettings(path="x")),
        ({"kind": "video", "path": "x.mp4", "fps": 30.0}, VideoSettings(path="x.mp4", fps=30.0)),
        ({"kind": "live", "device": 0}, LiveSettings(device=0)),
        ({"kind": "live", "device": "rtsp://a/b", "width_px": 640}, LiveSettings(device="rtsp://a/b", width_px=640)),
    ],
)
def test_kind_selects_the_settings(plain: dict, expected: object):
    assert msgspec.convert(plain, SourceSettings) == expected


@pytest.mark.parametrize(
    "plain",
    [
        {"kind": "tape", "path": "x"},
        {"kind": "folder", "path": ""},
        {"kind": "folder", "path": "x", "fps": 0},
        {"kind": "simulator", "fps": 0},
        {"kind": "simulator", "processes": 9},
        {"kind": "simulator", "seed": -1},
        {"kind": "simulator", "speed": 2},
        {"kind": "simulator", "scenario": ""},
        {"kind": "video", "path": "x", "speed": 2},
        {"kind": "live"},
        {"kind": "live", "device": 0, "retry_first_s": -1.0},
        {"kind": "live", "device": 0, "fourcc": "MJPEG"},
    ],
)
def test_bad_settings_are_refused(plain: dict):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(plain, SourceSettings)


def test_settings_need_no_opencv():
    code = "import sys, gripmon.io.sources; assert not {'cv2', 'multiprocessing'} & set(sys.modules), 'heavy import'"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent.parent)


# --- folder ---


def test_natural_order():
    names = ["b1.png", "a10.png", "a9.png", "a.png", "a010.png", "10.png", "9.png", "a9b2.png", "a9b10.png"]
    expected = ["9.png", "10.png", "a9.png", "a9b2.png", "a9b10.png", "a010.png", "a10.png", "a.png", "b1.png"]
    assert sorted(names, key=natural_key) == expected


def test_folder_gives_every_image_in_order_with_stamps_from_fps(tmp_path: Path):
    for i in (10, 9, 2):
        write(tmp_path, f"frame{i}.png", picture(i))
    (tmp_path / "truth.json").write_text("{}")
    frames = folder_frames(tmp_path, fps=30.0)
    assert [f.name for f in frames] == ["frame2.png", "frame9.png", "frame10.png"]
    assert [f.seq for f in frames] == [0, 1, 2]
    assert [f.stamp_ns for f in frames] == [0, 33_333_333, 66_666_667]
    for frame, i in zip(frames, (2, 9, 10), strict=True):
        np.testing.assert_array_equal(frame.image, picture(i))
        assert frame.fault is None and frame.jaw_opening_m is None


@pytest.mark.parametrize(
    ("name", "shape", "dtype"),
    [
        ("grey.png", (48, 64), np.uint8),
        ("grey16.png", (48, 64), np.uint16),
        ("colour.png", (48, 64, 3), np.uint8),
        ("colour.bmp", (48, 64, 3), np.uint8),
        ("grey.pgm", (48, 64), np.uint8),
        ("grey.tif", (48, 64), np.float32),
    ],
)
def test_pixels_arrive_unchanged(tmp_path: Path, name: str, shape: tuple[int, ...], dtype: type):
    image = picture(3, shape, dtype)
    write(tmp_path, name, image)
    read = folder_frames(tmp_path)[0].image
    assert read is not None and read.dtype == dtype and read.flags.c_contiguous
    np.testing.assert_array_equal(read, image)


def test_alpha_is_left_out_and_double_becomes_single(tmp_path: Path):
    image = picture(3, (48, 64, 4))
    write(tmp_path, "a.png", image)
    write(tmp_path, "b.tif", picture(4).astype(np.float64) / 255.0)
    first, second = folder_frames(tmp_path)
    np.testing.assert_array_equal(first.image, image[:, :, :3])
    assert second.image is not None and second.image.dtype == np.float32
    np.testing.assert_allclose(second.image, picture(4) / 255.0, atol=1e-7)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".pgm"])
def test_a_truncated_file_is_a_fault_and_the_sequence_goes_on(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
):
    whole = [write(tmp_path, f"{i}{suffix}", picture(i)) for i in range(4)]
    (tmp_path / f"1{suffix}").write_bytes(whole[1][: len(whole[1]) // 2])
    cut = 5 if suffix == ".tif" else 1  # libtiff pads the end of its directory
    (tmp_path / f"2{suffix}").write_bytes(whole[2][:-cut])
    frames = folder_frames(tmp_path)
    assert [f.image is None for f in frames] == [False, True, True, False]
    assert [f.fault is None for f in frames] == [True, False, False, True]
    assert [f.seq for f in frames] == [0, 1, 2, 3]
    if suffix == ".png":
        assert capfd.readouterr().err == ""  # the fault says it, in one line


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n", bytes(1000)])
def test_what_is_no_image_is_a_fault(tmp_path: Path, content: bytes):
    (tmp_path / "0.png").write_bytes(content)
    write(tmp_path, "1.png", picture(1))
    broken, good = folder_frames(tmp_path)
    assert broken.image is None and broken.fault
    assert good.image is not None


def test_time_stamps_and_jaw_openings_from_the_table(tmp_path: Path):
    for i in range(3):
        write(tmp_path, f"{i}.png", picture(i))
    (tmp_path / "timestamps.csv").write_text(
        "\ufefffile,stamp_ns,jaw_opening_m\n2.png,1700000000000000002,0.034\n0.png,1700000000000000000,\n\n1.png,1700000000000000001,0\n"
    )
    frames = folder_frames(tmp_path)
    assert [f.name for f in frames] == ["0.png", "1.png", "2.png"]
    assert [f.stamp_ns - 1_700_000_000_000_000_000 for f in frames] == [0, 1, 2]
    assert [f.jaw_opening_m for f in frames] == [None, 0.0, 0.034]


@pytest.mark.parametrize(
    ("first", "step", "rate"),
    [
        (1_700_000_000, 33, "10,000"),
        (1_700_000_000, 33_333, "10,000"),
        pytest.param(1_700_000_000_000_000, 200_000, "1,000", id="microseconds of our days, at any camera's rate"),
    ],
)
def test_stamps_of_another_unit_are_refused(tmp_path: Path, first: int, step: int, rate: str):
    for i in range(4):
        write(tmp_path, f"{i}.png", picture(i))
    rows = "".join(f"{i}.png,{first + i * step}\n" for i in range(4))
    (tmp_path / "timestamps.csv").write_text(f"file,stamp_ns\n{rows}")
    with pytest.raises(SourceError, match=rf"stamp_ns rises by {step} .* more than {rate} frames/s; nanoseconds"):
        FolderSource(FolderSettings(path=str(tmp_path)), Path())


def test_pixels_of_a_big_tiff_in_the_other_byte_order_are_as_the_sensor_has_them(tmp_path: Path):
    """Pillow writes none: one strip of 6 x 8 grey pixels, turned by its tag."""
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    tags = [(256, 8), (257, 6), (258, 8), (259, 1), (262, 1), (273, 16), (274, 3), (277, 1), (278, 6), (279, 48)]
    entries = b"".join(struct.pack(">HHQ", tag, 3, 1) + struct.pack(">H6x", value) for tag, value in tags)
    directory = struct.pack(">Q", len(tags)) + entries + struct.pack(">Q", 0)
    data = b"MM" + struct.pack(">HHHQ", 43, 8, 0, 16 + 48) + image.tobytes() + directory
    (tmp_path / "a.tif").write_bytes(data)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[0], image)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("turn", [2, 3, 6, 8])
def test_pixels_of_a_tiff_are_as_the_sensor_has_them(tmp_path: Path, turn: int, big: bool):
    """OpenCV turns a TIFF by its tag of orientation, whatever it is asked, and fails for some."""
    from PIL import Image

    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    Image.fromarray(image).save(tmp_path / "a.tif", tiffinfo={274: turn}, big_tiff=big)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[0], image)
    np.testing.assert_array_equal(grey_image((tmp_path / "a.tif").read_bytes())[0], image)
    data = (tmp_path / "a.tif").read_bytes()
    for cut in range(0, len(data), 7):  # whatever is left of it
        grey_image(data[:cut])


def test_a_listed_file_that_is_missing_is_a_fault(tmp_path: Path):
    write(tmp_path, "0.png", picture(0))
    (tmp_path / "timestamps.csv").write_text("file,stamp_ns\n0.png,5\n1.png,6\n")
    frames = folder_frames(tmp_path)
    assert [f.fault for f in frames] == [None, "the file is missing"]
    assert [f.stamp_ns for f in frames] == [5, 6]


def test_table_beside_the_folder(tmp_path: Path):
    (tmp_path / "images").mkdir()
    write(tmp_path / "images", "0.png", picture(0))
    (tmp_path / "stamps.csv").write_text("file,stamp_ns\n0.png,77\n")
    source = open_source(FolderSettings(path="images", timestamps="stamps.csv"), tmp_path)
    assert [f.stamp_ns for f in read_all(source)] == [77]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "line 1 is ''"),
        ("name,time\n0.png,1\n", "line 1 is 'name,time'"),
        ("file,stamp_ns\n0.png\n", "line 2 has 1 values"),
        ("file,stamp_ns\n0.png,1,0.03\n", "line 2 has 3 values"),
        ("file,stamp_ns\n0.png,1.5\n", r"line 2: stamp_ns is '1.5'; a whole number"),
        ("file,stamp_ns\n0.png,-1\n", "line 2: stamp_ns is -1"),
        ("file,stamp_ns\n0.png,99999999999999999999\n", "line 2: stamp_ns is 9"),
        ("file,stamp_ns\n0.png,1\n0.png,2\n", "line 3: 0.png is there twice"),
        ("file,stamp_ns\n../0.png,1\n", "line 2: '../0.png' is not a file name"),
        ("file,stamp_ns,jaw_opening_m\n0.png,1,wide\n", "line 2: jaw_opening_m is 'wide'; metres"),
        ("file,stamp_ns,jaw_opening_m\n0.png,1,34\n", "line 2: jaw_opening_m is '34'; metres"),
        ("file,stamp_ns,jaw_opening_m\n0.png,1,nan\n", "line 2: jaw_opening_m is 'nan'; metres"),
        ("file,stamp_ns\n0.png,1\n", "no row for 1.png"),
        ("file,stamp_ns\n0.png,2\n1.png,2\n", "doesn't rise from 0.png to 1.png"),
        (b"file,stamp_ns\n\xff\xfe,1\n", "UTF-8"),
    ],
)
def test_a_malformed_table_is_refused_at_the_start(tmp_path: Path, text: str | bytes, complaint: str):
    for i in range(2):
        write(tmp_path, f"{i}.png", picture(i))
    (tmp_path / "timestamps.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SourceError, match=complaint) as refused:
        FolderSource(FolderSettings(path=str(tmp_path)), Path())
    assert "timestamps.csv" in str(refused.value) and "; " in str(refused.value) and "\n" not in str(refused.value)


def test_a_folder_without_images_or_none_at_all_is_refused(tmp_path: Path):
    with pytest.raises(SourceError, match="path: no image in"):
        open_source(FolderSettings(path=str(tmp_path)))
    with pytest.raises(SourceError, match="path: there is no folder"):
        open_source(FolderSettings(path="nowhere"), tmp_path)
    write(tmp_path, "0.png", picture(0))
    with pytest.raises(SourceError, match="timestamps: there is no file"):
        open_source(FolderSettings(path=str(tmp_path), timestamps="absent.csv"), tmp_path)


def test_a_closed_folder_is_finished(tmp_path: Path):
    write(tmp_path, "0.png", picture(0))
    source = open_source(FolderSettings(path=str(tmp_path)))
    source.close()
    source.close()
    assert source.read() is None


# --- video ---


def make_video(path: Path, frames: int = 12, fps: float = 25.0, codec: str = "MJPG") -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (64, 48))
    assert writer.isOpened()
    for i in range(frames):
        writer.write(np.full((48, 64, 3), 20 * (i % 12), np.uint8))
    writer.release()


@pytest.mark.parametrize(
    ("name", "codec", "rounding_ns"), [("a.avi", "MJPG", 1), ("a.mp4", "mp4v", 1), ("a.mkv", "MJPG", 500_000)]
)
def test_video_gives_every_frame_with_the_containers_stamps(tmp_path: Path, name: str, codec: str, rounding_ns: int):
    make_video(tmp_path / name, fps=29.97, codec=codec)
    source = open_source(VideoSettings(path=name), tmp_path)
    frames = read_all(source)
    source.close()
    assert not source.live
    assert [f.seq for f in frames] == list(range(12))
    np.testing.assert_allclose([f.stamp_ns for f in frames], np.arange(12) / 29.97 * 1e9, rtol=0, atol=rounding_ns)
    for i, frame in enumerate(frames):
        assert frame.image is not None and frame.image.shape == (48, 64, 3)
        assert abs(float(frame.image.mean()) - 20 * i) < 6  # compressed
        assert frame.name == name


def test_fps_replaces_the_containers_stamps(tmp_path: Path):
    make_video(tmp_path / "a.avi", fps=25.0)
    frames = read_all(open_source(VideoSettings(path="a.avi", fps=50.0), tmp_path))
    assert [f.stamp_ns for f in frames] == [20_000_000 * i for i in range(12)]


class TornCapture:
    """Stands for a file whose container has no usable time stamps and whose third frame doesn't decode."""

    def __init__(self) -> None:
        self.count = 0

    def grab(self) -> bool:
        self.count += 1
        return self.count <= 4

    def get(self, _prop: int) -> float:
        return [0.0, 40.0, 40.0, float("nan")][self.count - 1]

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        return (self.count != 2, picture(0) if self.count != 2 else None)

    def release(self) -> None:
        pass


def test_video_frames_without_a_stamp_or_picture_are_faults(tmp_path: Path):
    make_video(tmp_path / "a.avi")
    source = VideoSource(VideoSettings(path="a.avi"), tmp_path)
    source._frames.close()
    source._first, source._frames = None, by_opencv(TornCapture())
    frames = read_all(source)
    assert [f.fault is None for f in frames] == [True, False, False, False]
    assert [f.stamp_ns for f in frames] == [0, 40_000_000, 40_000_000, 40_000_000]
    assert "decoded" in str(frames[1].fault) and "fps" in str(frames[2].fault)
    assert all(f.image is None for f in frames[1:])


def test_a_truncated_video_ends_early_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    make_video(tmp_path / "a.avi", frames=60)
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data[: len(data) // 2])
    frames = read_all(open_source(VideoSettings(path="a.avi"), tmp_path))
    assert 10 < len(frames) < 40
    assert "of 2.32 s; is it truncated?" in caplog.text  # when the last but one of 60 at 25 a second is due


def test_a_whole_video_of_a_rate_that_varies_is_not_said_to_be_truncated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """Matroska has no number of frames: OpenCV makes one of the length and the first frames' rate."""
    times_s = np.cumsum([0.0, 0.04, 0.04, 0.04, *[0.2] * 8])
    write_video_at(tmp_path / "a.mkv", [picture(i) for i in range(12)], times_s, "libx264")
    frames = read_all(open_source(VideoSettings(path="a.mkv"), tmp_path))
    np.testing.assert_allclose([f.stamp_ns for f in frames], 1e9 * times_s, atol=1e6)
    assert not caplog.text


def test_a_video_that_opencv_can_not_decode_is_read_by_pyav(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """AV1, as LeRobot's: opened, and then without a frame and without a word."""
    times_s = 5.0 + np.arange(8) / 25.0
    shades = [np.full((48, 64), 40 + 20 * i, np.uint8) for i in range(8)]
    write_video_at(tmp_path / "a.mp4", shades, times_s, "libsvtav1")
    frames = read_all(open_source(VideoSettings(path="a.mp4"), tmp_path))
    assert [f.stamp_ns for f in frames] == [40_000_000 * i for i in range(8)]
    for frame, shade in zip(frames, shades, strict=True):
        assert frame.fault is None and frame.image is not None and frame.image.shape == (*shade.shape, 3)
        assert np.abs(frame.image.mean(axis=2) - shade).mean() < 2.0
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SourceError, match=r"OpenCV can't decode this 'AV01', PyAV may \(.* package av; pip install"):
        open_source(VideoSettings(path="a.mp4"), tmp_path)


def test_a_video_that_is_damaged_on_the_way_says_why_it_ends(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    times_s = np.arange(60) / 25.0
    noise = np.random.default_rng(1).integers(0, 255, (60, 48, 64), np.uint8)
    write_video_at(tmp_path / "a.mp4", list(noise), times_s, "libsvtav1")
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    damaged = slice(3 * len(data) // 10, 3 * len(data) // 10 + 20_000)
    data[damaged] = np.random.default_rng(2).bytes(20_000)
    (tmp_path / "a.mp4").write_bytes(data)
    frames = read_all(open_source(VideoSettings(path="a.mp4"), tmp_path))
    assert 0 < len(frames) < 60
    assert re.search(r"the video ends after [\d.]+ s: .*a\.mp4 can't be decoded \(.+\); is it truncated\?", caplog.text)


@pytest.mark.parametrize("content", [None, b"", b"no video at all" * 100])
def test_what_is_no_video_is_refused_at_the_start(tmp_path: Path, content: bytes | None):
    if content is not None:
        (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(SourceError, match=r"^path: .*; .*"):
        open_source(VideoSettings(path="a.mp4"), tmp_path)


def test_settings_for_an_input_from_the_command_line(tmp_path: Path):
    assert settings_for_path(tmp_path) == FolderSettings(path=str(tmp_path))
    assert settings_for_path(tmp_path / "a.mp4") == VideoSettings(path=str(tmp_path / "a.mp4"))
