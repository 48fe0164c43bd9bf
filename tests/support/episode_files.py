"""Files of episodes as other programs write them: MCAP, rosbag2, LeRobot datasets of formats 2.1 and 3.0.

Paths and columns of LeRobot's are those of ``lerobot.datasets.utils`` 0.4.4, written here by hand.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from gripmon.model.camera import BrownConradyLens
from gripmon.model.records import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from benchmarks.dataset_set import write_video

STORE, STORE1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
NS = 1_000_000_000
WRIST = "observation.images.wrist"


@dataclass(frozen=True)
class Shots:
    """Images (grey), when they were taken (Unix ns), and how far the jaws were open (m)."""

    images: Sequence[Image]
    stamps_ns: Sequence[int]
    openings_m: Sequence[float]
    lens: BrownConradyLens | None = None


def _header(stamp_ns: int):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // NS, nanosec=stamp_ns % NS)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id="wrist")


def ros_messages(
    shots: Shots, *, raw: bool = False, topic: str = "/wrist/image", calibrated: bool = True, encode: str = ".png"
):
    """(topic, type, log time, message): each image after the joint state of its time, which is logged 3 ms later."""
    types = STORE.types
    if shots.lens is not None:
        lens = shots.lens
        k = np.array([lens.fx_px, 0, lens.cx_px, 0, lens.fy_px, lens.cy_px, 0, 0, 1.0]) * calibrated
        region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        d, size = np.array(lens.coefficients), (lens.height_px, lens.width_px)
        header = _header(shots.stamps_ns[0])
        info = types["sensor_msgs/msg/CameraInfo"](
            header, *size, "plumb_bob", d, k, np.eye(3).ravel(), np.zeros(12), 0, 0, region
        )
        yield "/wrist/camera_info", "sensor_msgs/msg/CameraInfo", shots.stamps_ns[0], info
    for image, stamp_ns, opening_m in zip(shots.images, shots.stamps_ns, shots.openings_m, strict=True):
        position, none = np.array([0.3, opening_m / 2, opening_m / 2]), np.empty(0)
        names = ["elbow", "left", "right"]
        joints = types["sensor_msgs/msg/JointState"](_header(stamp_ns), names, position, none, none)
        yield "/joint_states", "sensor_msgs/msg/JointState", stamp_ns, joints
        if raw:
            height, width = image.shape[:2]
            kind, of = "sensor_msgs/msg/Image", (height, width, "mono8", 0, width, image.ravel())
        else:
            kind, of = "sensor_msgs/msg/CompressedImage", (encode[1:], cv2.imencode(encode, image)[1].ravel())
        yield topic, kind, stamp_ns + 3_000_000, types[kind](_header(stamp_ns), *of)


def write_mcap(
    path: Path, shots: Shots, change=lambda message: message, kinds: Sequence[str] = ("",), **how
) -> None:
    """As ``ros2 bag record -s mcap`` does, in chunks of some frames; each message as ``change`` makes it, and of types
    that end with one of ``kinds``.
    """
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=20_000)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for topic, kind, log_ns, sent in ros_messages(shots, **how):
            if not kind.endswith(tuple(kinds)):
                continue
            message = change(sent)
            if topic not in channels:
                definition = STORE.generate_msgdef(kind)[0].encode()
                schema = writer.register_schema(kind, "ros2msg", definition)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], log_ns, bytes(STORE.serialize_cdr(message, kind)), log_ns)
        writer.finish()


def write_rosbag2(path: Path, shots: Shots, **how) -> None:
    """A folder with SQLite."""
    with BagWriter(path, version=9) as writer:
        connections = {}
        for topic, kind, log_ns, message in ros_messages(shots, **how):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log_ns, STORE.serialize_cdr(message, kind))


def _as_ros1(value):
    """ROS 1 numbers its headers, and has capitals in CameraInfo."""
    if not hasattr(value, "__msgtype__"):
        return value
    type_of = STORE1.types[value.__msgtype__]
    names = {name: getattr(value, name, getattr(value, name.lower(), 0)) for name in type_of.__dataclass_fields__}
    return type_of(**{name: _as_ros1(each) for name, each in names.items() if name != "__msgtype__"})


def write_ros1(path: Path, shots: Shots, *, mcap: bool = False, **how) -> None:
    """A .bag of ROS 1, or what ``mcap convert`` makes of it."""
    messages = [
        (topic, kind, log_ns, bytes(STORE1.serialize_ros1(_as_ros1(message), kind)))
        for topic, kind, log_ns, message in ros_messages(shots, **how)
    ]
    channels: dict = {}
    if not mcap:
        with Bag1Writer(path) as bag:
            for topic, kind, log_ns, data in messages:
                if topic not in channels:
                    channels[topic] = bag.add_connection(topic, kind, typestore=STORE1)
                bag.write(channels[topic], log_ns, data)
        return
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros1")
        for topic, kind, log_ns, data in messages:
            if topic not in channels:
                definition = STORE1.generate_msgdef(kind, ros_version=1)[0].encode()
                schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", definition)
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()


def write_foxglove(path: Path, shots: Shots, *, video: bool = False) -> None:
    """Protobuf messages of Foxglove's schemas; ``video``: H.264 instead of PNGs."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
    from mcap_protobuf.writer import Writer as ProtobufWriter

    packets = encoded(shots.images, "libx264") if video else None
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for i, (image, stamp_ns) in enumerate(zip(shots.images, shots.stamps_ns, strict=True)):
            if packets is None:
                message = CompressedImage(format="png", data=cv2.imencode(".png", image)[1].tobytes())
            else:
                message = CompressedVideo(format="h264", data=packets[i])
            message.timestamp.FromNanoseconds(stamp_ns)
            writer.write_message("/wrist/image", message, stamp_ns + 5, stamp_ns + 5)
        if (lens := shots.lens) is not None:
            k = [lens.fx_px, 0, lens.cx_px, 0, lens.fy_px, lens.cy_px, 0, 0, 1]
            camera = CameraCalibration(width=lens.width_px, height=lens.height_px, distortion_model="plumb_bob", K=k)
            camera.D.extend(lens.coefficients)
            writer.write_message("/wrist/calibration", camera, shots.stamps_ns[0])


def write_video_at(path: Path, images: Sequence[Image], times_s: Sequence[float], codec: str) -> None:
    """A video (grey) whose frames are at these times, in the container that the name ends with."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"crf": "8"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, 90_000)
        for image, time_s in zip(images, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(90_000 * time_s), Fraction(1, 90_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def encoded(images: Sequence[Image], codec: str) -> list[bytes]:
    """One packet an image, without pictures that look ahead."""
    height, width = images[0].shape[:2]
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt, context.time_base = width, height, "yuv420p", Fraction(1, 30)
    context.options = {"bf": "0", "tune": "zerolatency", "crf": "10"}
    frames = [av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p") for image in images]
    for i, frame in enumerate(frames):
        frame.pts = i
    packets = [packet for frame in [*frames, None] for packet in context.encode(frame)]
    return [bytes(packet) for packet in packets]


def write_lerobot(
    root: Path, episodes: Sequence[Shots], *, fps: int, version: str = "v3.0", per_file: int = 4, codec="libsvtav1"
) -> None:
    """A dataset of format ``v3.0``, ``per_file`` episodes in a file, or ``v2.1``; the state is elbow, gripper, where
    the gripper is 1 at 80 mm of opening.
    """
    height, width = episodes[0].images[0].shape[:2]
    new = version == "v3.0"
    info = {
        "codebase_version": version, "fps": fps, "chunks_size": 1000, "total_episodes": len(episodes),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        if new else "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if new else "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {
            WRIST: {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"]},
            "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["elbow", "gripper"]}},
        },
    }  # fmt: skip
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    places = []
    for first in range(0, len(episodes), per_file if new else 1):
        group = episodes[first : first + (per_file if new else 1)]
        file_index, begin_s, tables = first // per_file, 0.0, []
        for number, shots in enumerate(group, first):
            count = len(shots.images)
            tables.append(_rows(number, shots, fps))
            places.append(
                {"episode_index": number, "length": count}
                | (
                    {
                        "data/chunk_index": 0, "data/file_index": file_index, f"videos/{WRIST}/chunk_index": 0,
                        f"videos/{WRIST}/file_index": file_index, f"videos/{WRIST}/from_timestamp": begin_s,
                        f"videos/{WRIST}/to_timestamp": begin_s + count / fps, "stats/index/mean": [0.0],
                    }
                    if new else {}
                )
            )  # fmt: skip
            begin_s += count / fps
        at = {"chunk_index": 0, "file_index": file_index, "episode_chunk": 0, "episode_index": first}
        table = root / info["data_path"].format(**at)
        table.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables(tables), table)
        images = [image for shots in group for image in shots.images]
        video = root / info["video_path"].format(**at, video_key=WRIST)
        write_video(video, images, fps, codec, key_every=5, crf=8)
    if new:
        (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(places), root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    else:
        (root / "meta" / "episodes.jsonl").write_text("".join(json.dumps(place) + "\n" for place in places))


def _rows(number: int, shots: Shots, fps: int) -> pa.Table:
    count = len(shots.images)
    state = np.stack([np.full(count, 0.3), np.array(shots.openings_m) / 0.08], axis=1).astype(np.float32)
    return pa.table(
        {
            "observation.state": pa.array(state.tolist(), pa.list_(pa.float32(), 2)),
            "timestamp": pa.array(np.arange(count, dtype=np.float32) / fps),
            "episode_index": pa.array([number] * count),
        }
    )
