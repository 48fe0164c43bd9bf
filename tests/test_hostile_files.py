"""Files that would hang, crash or fill the stack of whoever reads them: one line each."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from gripmon.cli import main
from gripmon.io.sources import FolderSettings, FolderSource, SourceError

DEEP = 100_000


def folder_with(folder: Path, table: str | None = None) -> Path:
    assert cv2.imwrite(str(folder / "0.png"), np.zeros((4, 4), np.uint8))
    if table is not None:
        (folder / "timestamps.csv").write_text(table)
    return folder


@pytest.mark.parametrize("kind", ["pipe", "link to a device", "socketless link"])
def test_what_is_no_file_among_images_becomes_a_frame_with_a_fault(tmp_path: Path, kind: str):
    folder_with(tmp_path, "file,stamp_ns\n0.png,0\n1.png,1\n")
    match kind:
        case "pipe":
            os.mkfifo(tmp_path / "1.png")
        case "link to a device":
            (tmp_path / "1.png").symlink_to("/dev/zero")
        case _:
            (tmp_path / "1.png").symlink_to(tmp_path / "nowhere.png")
    source = FolderSource(FolderSettings(path="."), tmp_path)
    frames = [source.read(), source.read()]
    assert frames[0] is not None and frames[0].fault is None
    assert frames[1] is not None and frames[1].image is None
    unreadable = "the file can't be read: it is not a regular file"
    expected = "the file is missing" if kind == "socketless link" else unreadable
    assert frames[1].fault == expected


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path):
    folder_with(tmp_path)
    with (tmp_path / "1.png").open("wb") as file:
        file.truncate(2 << 30)  # without any blocks on the disk
    source = FolderSource(FolderSettings(path="."), tmp_path)
    source.read()
    frame = source.read()
    assert frame is not None and frame.fault == "the file can't be read: it is larger than 1024 MiB"


def test_a_small_file_of_very_many_pixels_is_not_decoded(tmp_path: Path):
    """1.3 MB took 2.8 GB."""
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(1 + 6 * 15_000)) for _ in range(15_000)) + packer.flush()
    header = struct.pack(">IIBBBBB", 15_000, 15_000, 16, 2, 0, 0, 0)
    (tmp_path / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b""))
    ))  # fmt: skip
    # Of its own memory: getrusage counts that of the process that it was forked from.
    asked = "import sys; from gripmon.cli import main; done = main(sys.argv[1:]); "
    asked += "print(done, [int(x.split()[1]) // 1024 for x in open('/proc/self/status') if 'VmHWM' in x][0])"
    said = subprocess.run(
        [
            sys.executable, "-c", asked, "calibrate", "intrinsics", str(tmp_path / "0.png"),
            "--target", "circles:8x8:0.008:0.004", "--out", str(tmp_path / "camera.yaml"),
        ],
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    code, megabytes = map(int, said.stdout.split())
    assert "0.png: an image of more pixels than OPENCV_IO_MAX_IMAGE_PIXELS; an image file" in said.stderr
    assert code == 2 and megabytes < 400


def test_a_table_that_is_a_pipe_is_refused(tmp_path: Path):
    folder_with(tmp_path)
    os.mkfifo(tmp_path / "timestamps.csv")
    said = r"timestamps.csv: can't be read \(it is not a regular file\); a table in UTF-8"
    with pytest.raises(SourceError, match=said):
        FolderSource(FolderSettings(path="."), tmp_path)


def test_an_open_quote_in_a_table_is_one_line(tmp_path: Path):
    folder_with(tmp_path, 'file,stamp_ns\n"0.png,0\n' + "x" * 140_000)
    with pytest.raises(SourceError, match=r"timestamps.csv: line 3: field larger than .*\(an open quote\?\)") as caught:
        FolderSource(FolderSettings(path="."), tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["a: " + "[" * 20_000, "{a:" * 5_000, "robot: " + "{a: " * 20_000])
def test_a_configuration_that_is_nested_too_deeply_is_one_line(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "deep.yaml"
    path.write_text(text)
    assert main(["check", str(path)]) == 2
    said = capsys.readouterr().err
    assert said == f"{path}: is nested too deeply; `key: value` lines; see configs/demo.yaml\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yml", "%YAML:1.0\n---\na: " + "[" * DEEP),
        ("f.xml", '<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * DEEP + "</a>" * DEEP + "</opencv_storage>"),
        ("g.json", '{"a":' * DEEP + "1" + "}" * DEEP),
    ],
)
def test_a_camera_file_that_is_nested_too_deeply_is_one_line(
    tmp_path: Path, name: str, text: str, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / name).write_text(text)
    assert main(["calibrate", "import", str(tmp_path / name), "--out", str(tmp_path / "camera.yaml")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{name}: is nested too deeply" in said
