"""What real recordings have beside good messages: cropped sensors, wrong stamps, turned pictures, byte orders."""

from __future__ import annotations

import dataclasses
import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PilImage
from support.episode_files import NS, STORE, Shots, write_mcap, write_rosbag2, write_video
from support.foreign_files import read_camera
from test_episode_sources import BEGIN_NS, FINGERS, LENS, frames_of, shots

from gripmon.io.sources import BagSettings, FolderSettings, SourceError, VideoSettings, settings_for_path
from gripmon.io.sources.bags import BagSource
from gripmon.io.sources.stamps import JUMP_NS, Stamped, rising
from gripmon.model.camera import LensSettings, make_camera

REGION = STORE.types["sensor_msgs/msg/RegionOfInterest"]


def source_of(path: Path, change, written: Shots | None = None, **how) -> BagSource:
    """A recording whose messages are changed on the way."""
    write_mcap(path / "a.mcap", written or shots(2), change, **how)
    return BagSource(BagSettings(path=str(path / "a.mcap")))


def lens_with(path: Path, topic: str = "/wrist/image", **fields: object) -> LensSettings | None:
    """The lens of a recording whose CameraInfo has these fields."""
    change = lambda m: dataclasses.replace(m, **fields) if hasattr(m, "binning_x") else m  # noqa: E731
    return source_of(path, change, topic=topic).camera


@pytest.mark.parametrize(
    ("roi", "binning", "size"),
    [
        ((8, 6, 36, 48), (0, 0), (48, 36)),  # x, y, height, width
        ((8, 6, 36, 48), (2, 2), (24, 18)),
        ((0, 0, 0, 0), (2, 3), (32, 16)),
    ],
)
def test_a_region_and_binning_move_the_lens_as_they_move_the_pixels(tmp_path: Path, roi, binning, size):
    """A point's pixel on the whole sensor, cropped and binned by hand, is where the recording's lens projects it."""
    lens = lens_with(tmp_path, roi=REGION(*roi, False), binning_x=binning[0], binning_y=binning[1])
    assert lens is not None and (lens.width_px, lens.height_px) == size
    points_cam_m = np.array([[0.0, 0.0, 1.0], [0.1, -0.05, 0.9], [-0.06, 0.04, 1.1]])
    sensor_px = make_camera(LENS).project(points_cam_m)
    by = np.maximum(binning, 1)
    # Pixel k of the image covers by x k to by x k + by - 1 of the region: its middle is by x k + (by - 1)/2.
    image_px = (sensor_px - roi[:2] - (by - 1) / 2) / by
    np.testing.assert_allclose(make_camera(lens).project(points_cam_m), image_px, atol=1e-9)


def test_a_region_that_is_no_part_of_the_sensor_is_refused(tmp_path: Path):
    """Width and height are the image's here; whether K is the sensor's or the image's, nobody can tell."""
    with pytest.raises(SourceError, match=r"camera_info: roi: 64 x 48 px at 8, 6 isn't part of the 64 x 48 px that K"):
        lens_with(tmp_path, roi=REGION(8, 6, 48, 64, False))


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/wrist/image_rect", True),
        ("/wrist/image_rect_color", True),
        ("/wrist/color/image_rect_raw", True),
        ("/wrist/rect/compressed", True),
        ("/wrist/rectified", True),
        ("/wrist/image_raw", False),
        ("/wrist/direct/image", False),
        ("/wrist/image_unrectified", False),
        ("/rectangle/image", False),
    ],
)
def test_images_that_are_rectified_have_the_camera_of_p(tmp_path: Path, topic: str, rectified: bool):
    lens = lens_with(tmp_path, topic, p=np.array([70.0, 0, 30, 0, 0, 71, 23, 0, 0, 0, 1, 0]))
    assert lens is not None
    assert (lens.fx_px, any(lens.coefficients)) == ((70.0, False) if rectified else (LENS.fx_px, True))


def test_rectified_images_without_p_have_no_known_camera(tmp_path: Path):
    """K and D are of the image before it was rectified; without distortion it is the same."""
    with pytest.raises(SourceError, match="P is empty, and D isn't; for rectified images P, the camera without dist"):
        lens_with(tmp_path, "/wrist/image_rect")
    lens = lens_with(tmp_path, "/wrist/image_rect", d=np.zeros(5))
    assert lens is not None and (lens.fx_px, any(lens.coefficients)) == (LENS.fx_px, False)


def test_a_lens_that_cannot_be_used_is_fatal_to_nobody_who_brings_his_own(tmp_path: Path, capfd):
    from gripmon.cli import main
    from gripmon.daemon.config import builtin_config

    source = source_of(tmp_path, lambda m: dataclasses.replace(m, distortion_model="None") if hasattr(m, "k") else m)
    assert isinstance(source.read().image, np.ndarray)
    with pytest.raises(SourceError, match="distortion_model: 'None' is not a model"):
        _ = source.camera
    main(["replay", str(tmp_path / "a.mcap"), "--config", str(builtin_config("demo.yaml")), "--out", "-"])
    told = capfd.readouterr()
    assert told.out.count("\n") == 2 and "camera calibration can't be used (camera: " in told.err


@pytest.mark.parametrize(
    ("model", "coefficients", "read"),
    [
        ("plumb_bob", (-0.1, 0.02, 0.001, 0, 0.3, 0, 0, 0), (-0.1, 0.02, 0.001, 0, 0.3)),
        ("plumb_bob", (0.0,) * 8, (0.0,) * 5),
        ("plumb_bob", (-0.1, 0.02, 0.001, 0, 0.3, 0.01, 0, 0), (-0.1, 0.02, 0.001, 0, 0.3, 0.01, 0, 0)),
        ("rational_polynomial", (-0.1, 0.02, 0.001, 0, 0.3, 0.01, *[0.0] * 8), (-0.1, 0.02, 0.001, 0, 0.3, 0.01, 0, 0)),
        ("equidistant", (0.01, 0.002, 0, 0, 0), (0.01, 0.002, 0, 0)),
        ("equidistant", (0.01, 0.002, 0, 0, 0.1), "holds 5 values; of equidistant 4 values"),
    ],
)
def test_zeros_after_the_coefficients_are_none(tmp_path: Path, model: str, coefficients, read):
    info = {"distortion_model": model, "d": np.array(coefficients, float)}
    if isinstance(read, str):
        with pytest.raises(SourceError, match=read):
            lens_with(tmp_path, **info)
        return
    lens = lens_with(tmp_path, **info)
    assert lens is not None and lens.coefficients[: len(read)] == read and not any(lens.coefficients[len(read) :])


def test_a_camera_info_file_reads_likewise():
    text = (
        b"{image_width: 64, image_height: 48, distortion_model: plumb_bob, camera_matrix: {rows: 3, cols: 3, data: "
        b"[80, 0, 31, 0, 81, 24, 0, 0, 1]}, distortion_coefficients: "
        b"{rows: 1, cols: 8, data: [0.1, 0, 0, 0, 0, 0, 0, 0]}}"
    )
    assert read_camera(text, "x").camera.coefficients == (0.1, 0.0, 0.0, 0.0, 0.0)


DAY = 86_400 * NS


def judged(off_ns: dict[int, int], count: int = 12, from_then_on: bool = False) -> list[tuple[int, int, str | None]]:
    """Messages at 10/s, logged 3 to 5 ms later, whose stamps are ``off_ns``: number, error of the time, fault."""

    def off(i: int) -> int:
        return sum(ns for first, ns in off_ns.items() if i == first or (from_then_on and i >= first))

    true_ns = [BEGIN_NS + i * NS // 10 for i in range(count)]
    sent = [(i, Stamped(t + off(i), t + 3_000_000 + 1_000_000 * (i % 3))) for i, t in enumerate(true_ns)]
    return [(i, ns - true_ns[i], fault) for i, ns, fault in rising(sent)]


@pytest.mark.parametrize("wrong", [0, 1, 5, 10, 11])
@pytest.mark.parametrize("off_ns", [DAY, -DAY, 2 * JUMP_NS, -NS // 2, NS // 2])
def test_one_wrong_stamp_costs_one_message(wrong: int, off_ns: int):
    found = judged({wrong: off_ns})
    faulty = [i for i, _, fault in found if fault is not None]
    # At the ends a stamp that keeps the order, and isn't far off, can't be told from a pause.
    assert faulty in ([wrong], []) if abs(off_ns) < JUMP_NS and wrong in (0, 11) else faulty == [wrong]
    assert all(error_ns == 0 for i, error_ns, _ in found if i != wrong)
    times = [BEGIN_NS + i * NS // 10 + error_ns for i, error_ns, fault in found if fault is None]
    assert times == sorted(set(times))


@pytest.mark.parametrize("step_ns", [-4 * NS, 9 * NS, -DAY])
def test_a_clock_that_was_set_costs_one_message_and_time_goes_on_by_the_log(step_ns: int):
    found = judged({5: step_ns}, from_then_on=True)
    assert [i for i, _, fault in found if fault is not None] == [5]
    assert "its clock was set: " in str(found[5][2])
    assert all(abs(error_ns) <= 3_000_000 for i, error_ns, _ in found if i != 5), "as far as the log's jitter"


def test_messages_that_were_logged_twice_move_no_others():
    """A relay's copies, a millisecond later by the log: each is refused, and the others are as they were sent."""
    seconds_ns = [(1000 + k) * 10**9 for k in range(50)]
    sent = [Stamped(at_ns, at_ns + late_ns) for at_ns in seconds_ns for late_ns in (0, 1_000_000)]
    told = [(ns, fault) for _, ns, fault in rising(list(enumerate(sent)))]
    assert [ns for ns, fault in told if fault is None] == seconds_ns
    assert {fault for _, fault in told[1::2]} == {"its time stamp is that of the message before"}


def test_stamps_in_order_stay_as_they_are_however_late_they_are_logged():
    late_ns = [0, 3 * NS, 3 * NS, 1 * NS, 0, 2 * NS]
    sent = [(i, Stamped(BEGIN_NS + i * NS // 10, BEGIN_NS + i * NS // 10 + late)) for i, late in enumerate(late_ns)]
    assert [(ns, fault) for _, ns, fault in rising(sent)] == [(each.stamp_ns, None) for _, each in sent]


def test_a_wrong_stamp_in_a_recording_costs_one_frame_and_no_opening(tmp_path: Path):
    written = shots(12)
    stamps_ns = [stamp_ns + DAY * (i == 0) for i, stamp_ns in enumerate(written.stamps_ns)]

    def change(message):
        if not hasattr(message, "format") and not hasattr(message, "position"):
            return message
        number = written.stamps_ns.index(message.header.stamp.sec * NS + message.header.stamp.nanosec)
        stamp = dataclasses.replace(message.header.stamp, sec=stamps_ns[number] // NS)
        return dataclasses.replace(message, header=dataclasses.replace(message.header, stamp=stamp))

    write_mcap(tmp_path / "a.mcap", written, change)
    first, *others = frames_of(BagSettings(path=str(tmp_path / "a.mcap"), opening=FINGERS))
    assert first.image is None and "its time stamp is wrong: 86400 s later" in first.fault
    assert [frame.fault for frame in others] == [None] * 11
    assert [frame.stamp_ns for frame in others] == written.stamps_ns[1:]
    np.testing.assert_allclose([frame.jaw_opening_m for frame in others], written.openings_m[1:], atol=1e-8)


@pytest.mark.parametrize("orientation", [3, 6])
def test_pictures_are_as_the_sensor_has_them_in_every_container(tmp_path: Path, orientation: int):
    """EXIF says which way up to show a picture; the lens is of the sensor."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (6, 8), np.uint8), (64, 48))
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    PilImage.fromarray(image).save(file := io.BytesIO(), "JPEG", quality=95, exif=exif)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.jpg").write_bytes(file.getvalue())
    data = np.frombuffer(file.getvalue(), np.uint8)
    source = source_of(
        tmp_path, lambda m: dataclasses.replace(m, data=data) if hasattr(m, "format") else m, encode=".jpg"
    )
    (in_folder,) = frames_of(FolderSettings(path=str(tmp_path / "images")))
    in_message = source.read()
    assert np.array_equal(in_folder.image, in_message.image) and in_message.image.shape == image.shape
    assert np.abs(in_message.image.astype(float) - image).mean() < 3.0


def test_a_video_that_is_to_be_shown_upright_is_read_as_the_sensor_has_it(tmp_path: Path):
    """A phone held upright writes a rotation into the track's header (ISO 14496-12, tkhd)."""
    image = np.zeros((48, 64), np.uint8)
    image[:24, :32] = 200
    write_video(tmp_path / "a.mp4", [image] * 3, 10, "libx264")
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # version 0: the matrix is 40 bytes after the name
    assert struct.unpack(">9i", data[matrix : matrix + 36])[::4] == (1 << 16, 1 << 16, 1 << 30)
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    (tmp_path / "a.mp4").write_bytes(data)
    first, *_ = frames_of(VideoSettings(path=str(tmp_path / "a.mp4")))
    assert np.abs(first.image[:, :, 0].astype(float) - image).mean() < 3.0


@pytest.mark.parametrize(
    ("encoding", "dtype"), [("16UC1", "u2"), ("mono16", "u2"), ("bayer_rggb16", "u2"), ("32FC1", "f4"), ("mono8", "u1")]
)
def test_both_byte_orders_give_the_same_image(tmp_path: Path, encoding: str, dtype: str):
    levels = np.linspace(0, 200, 64 * 48).reshape(48, 64)
    found = []
    for order, is_bigendian in (("<", 0), (">", 1)):
        data = np.frombuffer(levels.astype(f"{order}{dtype}").tobytes(), np.uint8)
        fields = {"encoding": encoding, "is_bigendian": is_bigendian, "step": 64 * int(dtype[1]), "data": data}
        source = source_of(
            tmp_path, lambda m, f=fields: dataclasses.replace(m, **f) if hasattr(m, "encoding") else m, raw=True
        )
        found.append(source.read().image)
    assert np.array_equal(found[0], found[1])
    if "bayer" not in encoding:
        np.testing.assert_array_equal(found[0], levels.astype(dtype))


def test_a_bare_file_of_sqlite(tmp_path: Path):
    written = shots(3)
    write_rosbag2(tmp_path / "bag", written)
    (file,) = (tmp_path / "bag").glob("*.db3")
    bare = file.rename(tmp_path / "a.db3")
    assert settings_for_path(bare) == BagSettings(path=str(bare))
    frames = frames_of(BagSettings(path=str(bare), opening=FINGERS))
    assert [frame.stamp_ns for frame in frames] == written.stamps_ns
