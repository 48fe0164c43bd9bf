"""Episodes out of MCAP, rosbag2 and LeRobot files: images, stamps, openings and cameras as they were written."""

from __future__ import annotations

import json
import os
import shutil
import threading
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.episode_files import (
    NS,
    WRIST,
    Shots,
    encoded,
    write_foxglove,
    write_lerobot,
    write_mcap,
    write_ros1,
    write_rosbag2,
)

import gripmon
from gripmon.io.sources import BagSettings, LeRobotSettings, SourceError, open_source, settings_for_path
from gripmon.io.sources.bags import BagSource
from gripmon.io.sources.episodes import find_episodes
from gripmon.model.camera import BrownConradyLens
from gripmon.model.jaw import JointOpening
from gripmon.model.records import Frame

LENS = BrownConradyLens(
    width_px=64,
    height_px=48,
    fx_px=80.0,
    fy_px=81.0,
    cx_px=31.0,
    cy_px=24.0,
    coefficients=(-0.1, 0.02, 0.001, 0.0, 0.0),
)
FINGERS = JointOpening(joints=("left", "right"))
GRIPPER = JointOpening(joints=("gripper",), scale=0.08)
BEGIN_NS = 1_790_000_000 * NS


def shots(count: int = 12, fps: float = 20.0, first: int = 0) -> Shots:
    """Grey images, each with its number in the brightness of its halves; jaws that open."""
    images = [np.full((48, 64), 40, np.uint8) for _ in range(count)]
    for i, image in enumerate(images):
        image[:, 32:] = 60 + 5 * (first + i)
    stamps = [BEGIN_NS + round(i * NS / fps) for i in range(count)]
    return Shots(images, stamps, [0.01 + 0.002 * i for i in range(count)], LENS)


def frames_of(settings) -> list[Frame]:
    source = open_source(settings)
    return [frame for frame in iter(source.read, None) if isinstance(frame, Frame)]


def assert_as_written(frames: list[Frame], written: Shots, *, openings: bool = True, lossy_dn: float = 0.0) -> None:
    assert [frame.fault for frame in frames] == [None] * len(written.images)
    assert [frame.seq for frame in frames] == list(range(len(written.images)))
    for frame, image in zip(frames, written.images, strict=True):
        assert np.abs(frame.image.astype(float) - image).mean() <= lossy_dn
    if openings:
        np.testing.assert_allclose([frame.jaw_opening_m for frame in frames], written.openings_m, atol=1e-8)


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("write", [write_mcap, write_rosbag2])
def test_messages_of_ros(tmp_path: Path, write, raw: bool):
    """The stamp is the header's, not the log's, which is 3 ms later; the opening is the sum of both fingers'."""
    path = tmp_path / ("a.mcap" if write is write_mcap else "bag")
    written = shots()
    write(path, written, raw=raw)
    assert settings_for_path(path) == BagSettings(path=str(path))
    source = BagSource(BagSettings(path=str(path), opening=FINGERS))
    frames = list(iter(source.read, None))
    assert_as_written(frames, written)
    assert [frame.stamp_ns for frame in frames] == written.stamps_ns
    assert source.camera == LENS


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("mcap", [False, True])
def test_messages_of_ros_1(tmp_path: Path, mcap: bool, raw: bool):
    path, written = tmp_path / ("a.mcap" if mcap else "a.bag"), shots()
    write_ros1(path, written, mcap=mcap, raw=raw)
    assert settings_for_path(path) == BagSettings(path=str(path))
    assert [episode.name for episode in find_episodes(str(tmp_path))] == [path.name]
    source = BagSource(BagSettings(path=str(path), opening=FINGERS))
    frames = list(iter(source.read, None))
    assert_as_written(frames, written)
    assert [frame.stamp_ns for frame in frames] == written.stamps_ns
    assert source.camera == LENS


@pytest.mark.parametrize("swapped", [False, True])
def test_types_that_only_the_bag_defines(tmp_path: Path, swapped: bool):
    """Foxglove's, as CDR in SQLite; another version's fields, by the same name, were read in another order before."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    name, store = "foxglove_msgs/msg/CompressedImage", get_typestore(Stores.ROS2_JAZZY)
    fields = ("string frame_id", "uint8[] data", "string format")
    text = "builtin_interfaces/Time timestamp\n" + "\n".join(fields[::-1] if swapped else fields) + "\n"
    store.register(get_types_from_msg(text, name))
    written = shots(3)
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/wrist/image", name, typestore=store)
        for image, stamp_ns in zip(written.images, written.stamps_ns, strict=True):
            stamp = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NS))
            content = ["wrist", cv2.imencode(".png", image)[1].ravel(), "png"]
            message = store.types[name](stamp, *(content[::-1] if swapped else content))
            writer.write(connection, stamp_ns, store.serialize_cdr(message, name))
    assert_as_written(frames_of(BagSettings(path=str(tmp_path / "bag"))), written, openings=False)


def compressed(data: bytes, said: str):
    """A change of messages: that content, under that format."""

    def change(message):
        if hasattr(message, "format"):
            message.format, message.data = said, np.frombuffer(data, np.uint8)
        return message

    return change


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (bytes(12) + cv2.imencode(".png", np.zeros((48, 64), np.uint16))[1].tobytes(), "16UC1; compressedDepth png"),
        (b"\x80theora", "theora"),
        (b"", "jpeg"),
    ],
)
def test_what_is_no_picture_is_said_by_its_format(tmp_path: Path, data: bytes, said: str):
    write_mcap(tmp_path / "a.mcap", shots(2), compressed(data, said))
    frames = frames_of(BagSettings(path=str(tmp_path / "a.mcap")))
    words = f"truncated, damaged or not an image: format '{said}'; JPEG, PNG, WebP or h264, h265, hevc, vp9, av1"
    assert [frame.fault for frame in frames] == [words] * 2


def test_a_compressed_mosaic_and_h264_in_a_message_of_ros(tmp_path: Path):
    mosaic = np.tile(np.array([[40, 120], [120, 200]], np.uint8), (24, 32))  # red, green; green, blue
    write_mcap(
        tmp_path / "a.mcap", shots(1),
        compressed(cv2.imencode(".png", mosaic)[1].tobytes(), "bayer_rggb8; png compressed "),
    )  # fmt: skip
    (frame,) = frames_of(BagSettings(path=str(tmp_path / "a.mcap")))
    np.testing.assert_array_equal(frame.image[4:-4, 4:-4], np.full((40, 56, 3), [200, 120, 40]))
    written = shots()
    packets = iter(encoded(written.images, "libx264"))
    write_mcap(
        tmp_path / "b.mcap", written,
        lambda message: compressed(next(packets), "h264")(message) if hasattr(message, "format") else message,
    )  # fmt: skip
    assert_as_written(frames_of(BagSettings(path=str(tmp_path / "b.mcap"))), written, openings=False, lossy_dn=2.0)


def test_a_bag_without_images_names_its_topics(tmp_path: Path):
    write_mcap(tmp_path / "a.mcap", shots(1), kinds=("CameraInfo", "JointState"))
    words = r"no topic with images \(Image, .*\); its topics: /joint_states .*, /wrist/camera_info \(.*/CameraInfo\)"
    with pytest.raises(SourceError, match=words):
        open_source(BagSettings(path=str(tmp_path / "a.mcap")))


@pytest.mark.parametrize("video", [False, True])
def test_messages_of_foxglove(tmp_path: Path, video: bool):
    written = shots()
    write_foxglove(tmp_path / "a.mcap", written, video=video)
    source = BagSource(BagSettings(path=str(tmp_path / "a.mcap")))
    frames = list(iter(source.read, None))
    assert_as_written(frames, written, openings=False, lossy_dn=2.0 if video else 0.0)
    assert [frame.stamp_ns for frame in frames] == written.stamps_ns
    assert source.camera == LENS


def test_openings_between_reports_are_linear_and_stand_still_in_pauses(tmp_path: Path):
    from gripmon.io.sources.stored import openings_at

    stamps, openings = np.array([0, NS // 20, NS]), np.array([0.01, 0.02, 0.03])
    assert openings_at(stamps, openings, NS // 40) == pytest.approx(0.015)
    assert openings_at(stamps, openings, NS // 2) == 0.02
    assert openings_at(stamps, openings, NS - NS // 20) == pytest.approx(0.025)
    assert openings_at(stamps, openings, -5) == 0.01 and openings_at(stamps, openings, 2 * NS) == 0.03


def test_camera_that_was_never_calibrated_is_none(tmp_path: Path):
    write_mcap(tmp_path / "a.mcap", shots(2), calibrated=False)
    assert BagSource(BagSettings(path=str(tmp_path / "a.mcap"))).camera is None


def test_cut_mcap_gives_what_is_there_and_says_so(tmp_path: Path):
    rng = np.random.default_rng(1)
    written = shots(40)
    noisy = Shots([rng.integers(0, 255, (48, 64), np.uint8) for _ in range(40)], written.stamps_ns, written.openings_m)
    write_mcap(tmp_path / "a.mcap", noisy)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: len(data) // 2])
    frames = frames_of(BagSettings(path=str(tmp_path / "a.mcap"), opening=FINGERS))
    assert 3 < len(frames) < 30
    assert frames[-1].image is None and f"cut short or damaged after {len(frames) - 1} frames" in frames[-1].fault
    for frame, image in zip(frames[:-1], noisy.images, strict=False):
        assert np.array_equal(frame.image, image)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"camera": "/front"}, "camera: .* has no images on /front; one of its topics with images: /wrist/image"),
        ({"opening": JointOpening(joints=("jaw",))}, "opening.joints: .* jaw; of its joints: elbow, left, right"),
    ],
)
def test_what_is_missing_in_messages_is_named(tmp_path: Path, settings: dict, words: str):
    write_mcap(tmp_path / "a.mcap", shots(2))
    with pytest.raises(SourceError, match=words):
        open_source(BagSettings(path=str(tmp_path / "a.mcap"), **settings))


def test_file_that_is_no_mcap(tmp_path: Path):
    (tmp_path / "a.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(SourceError, match=r"a.mcap can't be read .*; a whole .mcap file"):
        open_source(BagSettings(path=str(tmp_path / "a.mcap")))


def change(file: Path) -> None:
    """As one that was written again in the same size."""
    stat = file.stat()
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns + NS))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_changes_with_its_own_files_and_its_place_alone(tmp_path: Path, version: str):
    """What was measured of it stands until then, also while others are recorded."""
    root, made = tmp_path / "set", [shots(2, first=k) for k in (0, 10, 20)]

    def versions(count: int = 3) -> list[str]:
        found = find_episodes(str(root))
        assert len(found) == count
        return [episode.version for episode in found]

    write_lerobot(root, made, fps=10, version=version, per_file=1, codec="libx264")
    before = versions()
    assert len(set(before)) == 3 and versions() == before
    changed = []
    for file in (sorted(root.glob("data/*/*.parquet"))[1], sorted(root.glob("videos/**/*.mp4"))[2]):
        change(file)
        changed.append([new != old for new, old in zip(versions(), before, strict=True)])
    assert changed == [[False, True, False], [False, True, True]]
    (root / "videos").rename(tmp_path / "elsewhere")  # as where a cache holds the files
    (root / "videos").symlink_to(tmp_path / "elsewhere")
    table = sorted(root.glob("data/*/*.parquet"))[0]
    table.symlink_to(table.rename(tmp_path / "table"))
    before = versions()
    for file in (table.resolve(), sorted((tmp_path / "elsewhere").glob("**/*.mp4"))[1]):
        change(file)
    assert [new != old for new, old in zip(versions(), before, strict=True)] == [True, True, False]
    before = versions()
    more = tmp_path / "more"
    write_lerobot(more, [*made, shots(2, first=30)], fps=10, version=version, per_file=1, codec="libx264")
    for file in more.glob("meta/**/*"):
        if file.is_file():
            shutil.copyfile(file, root / file.relative_to(more))
    assert versions(4)[:3] == before, "a fourth came"


@pytest.mark.parametrize(("version", "codec"), [("v3.0", "libsvtav1"), ("v2.1", "libsvtav1"), ("v3.0", "libx264")])
def test_episodes_of_lerobot(tmp_path: Path, version: str, codec: str):
    """Each episode's own frames out of a video that holds several, AV1 too."""
    episodes = [shots(7, 10.0, 0), shots(9, 10.0, 7), shots(8, 10.0, 16)]
    write_lerobot(tmp_path / "set", episodes, fps=10, version=version, per_file=2, codec=codec)
    assert settings_for_path(tmp_path / "set") == LeRobotSettings(path=str(tmp_path / "set"))
    for number, written in enumerate(episodes):
        frames = frames_of(LeRobotSettings(path=str(tmp_path / "set"), episode=number, opening=GRIPPER))
        assert_as_written(frames, written, lossy_dn=1.5)
        np.testing.assert_allclose([1e-9 * frame.stamp_ns for frame in frames], np.arange(len(frames)) / 10, atol=1e-7)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, r"episode: .* has 2; one of: 0, 1"),
        ({"episode": 2}, r"episode: .* has no episode 2; one of: 0, 1"),
        ({"episode": 0, "camera": "front"}, f"camera: .* has no camera front; one of: {WRIST}"),
        ({"episode": 0, "opening": FINGERS}, r"opening.joints: .* has no left, right; of its .*: elbow, gripper"),
    ],
)
def test_what_is_missing_in_lerobot_is_named(tmp_path: Path, settings: dict, words: str):
    write_lerobot(tmp_path / "set", [shots(3), shots(3)], fps=10)
    with pytest.raises(SourceError, match=words):
        open_source(LeRobotSettings(path=str(tmp_path / "set"), **settings))


def test_cut_video_of_lerobot_is_frames_that_say_so(tmp_path: Path):
    rng = np.random.default_rng(2)
    written = shots(20, 10.0)
    noisy = Shots([rng.integers(0, 255, (48, 64), np.uint8) for _ in range(20)], written.stamps_ns, written.openings_m)
    write_lerobot(tmp_path / "set", [noisy], fps=10)
    (video,) = (tmp_path / "set").rglob("*.mp4")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    frames = frames_of(LeRobotSettings(path=str(tmp_path / "set")))
    assert len(frames) == 20
    assert frames[0].image is not None and frames[-1].image is None
    assert "truncated?" in frames[-1].fault or "has no frame at" in frames[-1].fault
    video.write_bytes(b"")
    assert all(frame.image is None and frame.fault for frame in frames_of(LeRobotSettings(path=str(tmp_path / "set"))))


def test_format_of_tomorrow_is_refused(tmp_path: Path):
    write_lerobot(tmp_path / "set", [shots(2)], fps=10)
    info = tmp_path / "set" / "meta" / "info.json"
    info.write_text(info.read_text().replace("v3.0", "v4.0"))
    with pytest.raises(SourceError, match=r"format v4\.0; v2\.1 or v3\.0"):
        open_source(LeRobotSettings(path=str(tmp_path / "set")))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data_path": "../secret"}, "data_path: '../secret' leads out of it"),
        ({"data_path": "/etc/passwd"}, "data_path: '/etc/passwd' leads out of it"),
        ({"data_path": "http://127.0.0.1:9/stolen"}, "leads out of it"),
        ({"data_path": "{episode_index:2147483647}"}, "{episode_index} of width 2147483647"),
        ({"data_path": "{episode_index:0999d}"}, "of width 0999d; a path of"),
        ({"data_path": "{evil}"}, "data_path: {evil} of width any"),
        ({"data_path": "{episode_index.__class__}"}, "{episode_index.__class__} of width any"),
        ({"data_path": "{episode_index!r}"}, "data_path: "),
        ({"data_path": "{"}, "data_path: "),
        ({"data_path": [1]}, "isn't a LeRobot dataset (Expected `str`"),
        ({"data_path": "pipe"}, "is not a regular file"),
        ({"video_path": "{video_key}/../../x"}, "leads out of it"),
        ({"video_path": None}, "video_path: "),
        ({"chunks_size": 0}, "isn't a LeRobot dataset (Expected `int` >= 1"),
        ({"fps": 0}, "isn't a LeRobot dataset (Expected `float` > 0"),
        ({"features": [1, 2]}, "isn't a LeRobot dataset (Expected `object`"),
        ({"features": {WRIST: {}}}, "isn't a LeRobot dataset (Object missing required field `dtype`"),
        ({"features": {"../../x": {"dtype": "video"}}}, "video_path: 'videos/chunk-000/../../x/"),
        ("[" * 100_000, "isn't a LeRobot dataset ("),
        ('{"codebase_version": NaN}', "isn't a LeRobot dataset ("),
        (["episodes", '{"length": 5}'], "isn't a LeRobot dataset (Object missing required field `episode_index`"),
        (["episodes", '{"episode_index": -1}'], "isn't a LeRobot dataset ("),
        (["episodes", '{"episode_index": %s}' % ("9" * 5000)], "isn't a LeRobot dataset ("),
        (["episodes", "[1]"], "isn't a LeRobot dataset ("),
    ],
)  # fmt: skip
def test_a_dataset_of_a_stranger_is_read_inside_itself_or_refused_in_one_line(tmp_path: Path, change, words: str):
    """Its description may say anything; what it says of paths and numbers is checked before it is used."""
    root = tmp_path / "set"
    write_lerobot(root, [shots(3)], fps=10, version="v2.1", codec="libx264")
    (tmp_path / "secret").write_text("kept")
    os.mkfifo(root / "pipe")
    info = root / "meta" / "info.json"
    if isinstance(change, dict):
        info.write_text(json.dumps(json.loads(info.read_text()) | change))
    elif isinstance(change, str):
        info.write_text(change)
    else:
        (root / "meta" / "episodes.jsonl").write_text(change[1])
    try:
        fault = str(frames_of(LeRobotSettings(path=str(root)))[-1].fault)
    except SourceError as error:
        fault = str(error)
    assert words in fault and "\n" not in fault and "secret can" not in fault


def test_from_a_store_of_objects(tmp_path: Path):
    """By URL, here into fsspec's own store in memory."""
    import fsspec

    write_lerobot(tmp_path / "set", [shots(4, 10.0)], fps=10)
    write_mcap(tmp_path / "a.mcap", shots(4))
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "set"), "/episodes/set", recursive=True)
    memory.put(str(tmp_path / "a.mcap"), "/episodes/a.mcap")
    assert_as_written(frames_of(LeRobotSettings(path="memory://episodes/set", opening=GRIPPER)), shots(4), lossy_dn=1.5)
    assert_as_written(frames_of(BagSettings(path="memory://episodes/a.mcap", opening=FINGERS)), shots(4))


def test_tables_are_read_in_the_callers_thread_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A thread of Arrow's that still holds a Python file when the process ends aborts it (apache/arrow#34314)."""
    import fsspec
    from fsspec.implementations.memory import MemoryFile

    write_lerobot(tmp_path / "set", [shots(4, 10.0), shots(3, 10.0, 4)], fps=10)
    fsspec.filesystem("memory").put(str(tmp_path / "set"), "/watched/set", recursive=True)
    threads = set()

    def read(file: MemoryFile, size: int = -1) -> bytes:
        threads.add(threading.get_ident())
        return super(MemoryFile, file).read(size)

    monkeypatch.setattr(MemoryFile, "read", read, raising=False)
    open_source(LeRobotSettings(path="memory://watched/set", episode=1, opening=GRIPPER)).close()
    assert threads == {threading.get_ident()}


def test_from_s3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Over the protocol itself, from a server on this machine: what is listed is what is read."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
        s3fs.S3FileSystem.clear_instance_cache()
        write_lerobot(tmp_path / "set", [shots(4, 10.0), shots(3, 10.0, 4)], fps=10)
        write_mcap(tmp_path / "a.mcap", shots(4))
        store = s3fs.S3FileSystem()
        store.mkdir("episodes")
        store.put(str(tmp_path / "set"), "episodes/all/set", recursive=True)
        store.put(str(tmp_path / "a.mcap"), "episodes/all/a.mcap")
        found = find_episodes("s3://episodes/all")
        assert [episode.name for episode in found] == ["a.mcap", "set#000000", "set#000001"]
        assert_as_written(frames_of(found[0].source), shots(4), openings=False)
        assert_as_written(frames_of(found[2].source), shots(3, 10.0, 4), openings=False, lossy_dn=1.5)
        with pytest.raises(SourceError, match="can't be listed"):
            find_episodes("s3://there-is-no-such-bucket/x")
    finally:
        server.stop()
        s3fs.S3FileSystem.clear_instance_cache()


def test_replay_takes_them(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """The opening comes by the configuration's source, its camera is held against the one in the file."""
    from gripmon.cli import main

    made = gripmon.simulate_images("demo", tmp_path / "images", duration_s=0.5, fps=10.0)
    folder = list(gripmon.open_source(made.folder))
    lens = BrownConradyLens(
        width_px=768,
        height_px=576,
        fx_px=962.0,
        fy_px=962.0,
        cx_px=383.5,
        cy_px=287.5,
        coefficients=(-0.17, 0, 0, 0),
    )
    written = Shots(
        [f.image if f.image.ndim == 2 else f.image[:, :, 0] for f in folder],
        [f.stamp_ns for f in folder], [f.jaw_opening_m for f in folder], lens,
    )  # fmt: skip
    write_mcap(tmp_path / "a.mcap", written)
    text = (made.folder / "config.yaml").read_text().partition("source:\n  kind")[0]
    config = made.folder / "mcap.yaml"
    config.write_text(text + "source:\n  kind: bag\n  path: x\n  opening: {joints: [left, right]}\n")
    outs = []
    for name, given in (("folder", made.folder), ("mcap", tmp_path / "a.mcap")):
        out = tmp_path / f"{name}.jsonl"
        assert main(["replay", str(given), "--config", str(config), "--out", str(out)]) == 0
        lines = [msgspec.json.decode(line) for line in out.read_bytes().splitlines()]
        outs.append([{k: v for k, v in line.items() if k not in ("latency_ns", "name")} for line in lines])
    assert outs[0] == outs[1]
    assert "camera calibration that is up to" in capfd.readouterr().err


def test_replay_names_options_that_do_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    from gripmon.cli import main
    from gripmon.daemon.config import builtin_config

    write_mcap(tmp_path / "a.mcap", shots(2))
    demo = str(builtin_config("demo.yaml"))
    assert main(["replay", str(tmp_path / "a.mcap"), "--config", demo, "--out", "-", "--episode", "1"]) == 2
    assert "a.mcap is one episode; leave it out" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        ("episode_index", ["0"] * 12, "can't be read .* no kernel matching .*; a whole table"),
        ("timestamp", [None, *range(1, 12)], "time stamps that don't rise; seconds from its beginning"),
        ("timestamp", [*range(11), None], "time stamps that don't rise; seconds from its beginning"),
        ("timestamp", [i * 10**17 for i in range(12)], "seconds from its beginning"),
        ("observation.state", [[0.3, float("nan")]] * 12, ""),
    ],
)
def test_a_table_with_values_that_are_none(tmp_path: Path, column: str, values: list, words: str):
    write_lerobot(tmp_path / "set", [shots()], fps=20, version="v2.1")
    path = next((tmp_path / "set").glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, pa.array(values)), path)
    settings = LeRobotSettings(path=str(tmp_path / "set"), opening=GRIPPER)
    if not words:
        assert [frame.jaw_opening_m for frame in frames_of(settings)] == [None] * 12
        return
    with pytest.raises(SourceError, match=words):
        open_source(settings)
