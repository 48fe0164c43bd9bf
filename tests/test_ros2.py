"""The monitor among nodes of a real ROS 2, over DDS: a camera, joints, a listener, an operator; and what is wrong."""

from __future__ import annotations

import csv
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from support import rubbish
from support.loopback import alert_record, frame_record, state_record, wait_until
from support.network_daemon import NetworkDaemon, network_config, network_daemon
from support.ros2_nodes import (
    DOMAIN,
    OTHER_DOMAIN,
    OtherNode,
    file_message,
    image_message,
    joint_message,
    other_node,
    stamp_ns,
)
from support.stand_ins import show

from gripmon.cli import main
from gripmon.daemon.teaching.source import open_named
from gripmon.io.ros2 import output as output_module
from gripmon.io.ros2.node import RosNode
from gripmon.io.ros2.output import Ros2Output, inverse
from gripmon.io.ros2.settings import Ros2Settings
from gripmon.io.sources.base import Waiting
from gripmon.io.sources.network import Arrival
from gripmon.io.sources.payload import PayloadError
from gripmon.io.sources.ros2 import COMPRESSED_IMAGE, IMAGE, Ros2Camera, Ros2CameraSettings
from gripmon.model.camera import BrownConradyLens, make_camera
from gripmon.model.records import AlertEvent, Frame, Severity, Verdict

POSE = "/simulated/wrist/gripmon/cam_T_grip"
FRAMES = 8
SOURCE = (
    f"{{kind: ros2, image: /wrist/image, joint_states: /joint_states, domain_id: {DOMAIN}, "
    "opening: {joints: [finger], scale: 2.0}}"
)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A jaw that moves: whatever differs in the frames shows in the transforms."""
    folder = tmp_path_factory.mktemp("ros2") / "sequence"
    assert main(["simulate", "jaw_cycle", "--out", str(folder), "--seconds", str(FRAMES / 10), "--fps", "10"]) == 0
    return folder


def lines_of(path: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    own = ("latency_ns", "name", "beside")
    return [{key: value for key, value in line.items() if key not in own} for line in lines]


@contextmanager
def daemon(sequence: Path, out: Path, name: str) -> Iterator[NetworkDaemon]:
    """``gripmon run`` without Zenoh: all it has is ROS."""
    config = network_config(sequence, "{enabled: false}", source=SOURCE, name=name)
    with config.open("a") as file:
        file.write(f"ros2: {{enabled: true, domain_id: {DOMAIN}, verdicts: [valid, suspect]}}\n")
        file.write("daemon: {no_camera_alert_after_s: 60.0, state_period_s: 0.05}\n")
    with network_daemon(config, out) as started:
        yield started
        assert "Traceback" not in started.said()


def values_of(message: Any) -> dict[str, str]:
    """The values of a diagnostics' only status."""
    return {entry.key: entry.value for entry in message.status[0].values}


class Driver:
    """Sends a sequence's frames, each with its joints before it, once the last one was judged."""

    def __init__(self, node: OtherNode, folder: Path, *, files: bool = False) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from sensor_msgs.msg import CompressedImage, Image, JointState

        self._folder, self._files = folder, files
        self._rows = list(csv.DictReader((folder / "timestamps.csv").open()))
        self._images = node.publisher(CompressedImage if files else Image, "/wrist/image")
        self._joints = node.publisher(JointState, "/joint_states")
        self.poses = node.listen(PoseWithCovarianceStamped, POSE)
        self._diagnostics = node.listen(DiagnosticArray, "/diagnostics")
        wait_until(lambda: self._images.get_subscription_count() and self._hears_joints(), "the monitor to listen")

    def _hears_joints(self) -> bool:
        self._publish_joints(self._rows[0], int(self._rows[0]["stamp_ns"]))
        return bool(self._diagnostics) and "no jaw opening" not in values_of(self._diagnostics[-1])["message"]

    def _publish_joints(self, row: dict[str, str], at_ns: int) -> None:
        self._joints.publish(joint_message(at_ns, elbow=1.0, finger=0.5 * float(row["jaw_opening_m"])))

    def send(self, first: int | None = None) -> None:
        """All frames as they are; or only the first ones, with the present as their stamps."""
        for row in self._rows[:first]:
            at_ns = int(row["stamp_ns"]) if first is None else time.time_ns()
            image = cv2.imread(str(self._folder / row["file"]), cv2.IMREAD_UNCHANGED)
            png = cv2.imencode(".png", image)[1].tobytes() if self._files else b""
            before = self._seq()
            self._publish_joints(row, at_ns)
            time.sleep(0.05)  # two topics have no order between them
            self._images.publish(file_message(png, at_ns) if self._files else image_message(image, at_ns))
            wait_until(lambda seq=before: self._seq() > seq, "this frame")

    def _seq(self) -> int:
        """Of the last frame that was judged."""
        return int(values_of(self._diagnostics[-1])["seq"])


@pytest.mark.parametrize("files", [False, True])
def test_frames_and_joints_give_the_transforms_of_the_files(sequence: Path, tmp_path: Path, files: bool):
    config = network_config(sequence, "{enabled: false}", source="{kind: folder, path: .}", name="replay")
    assert main(["replay", str(sequence), "--config", str(config), "--out", str(tmp_path / "replayed.jsonl")]) == 0
    replayed = lines_of(tmp_path / "replayed.jsonl")
    with daemon(sequence, tmp_path / "out", f"ros2_{files}") as monitor, other_node("cell") as node:
        driver = Driver(node, sequence, files=files)
        driver.send()
        assert monitor.stop() == 0
    lines = lines_of(tmp_path / "out" / "estimates.jsonl")
    assert len({line["jaw_opening_m"] for line in lines}) > FRAMES // 2, "the jaw's opening comes with each frame"
    assert lines == replayed
    poses = {stamp_ns(message): message for message in driver.poses}
    # One that is ready too late, on a busy machine, isn't published.
    assert poses.keys() <= {line["stamp_ns"] for line in lines} and len(poses) > 1
    for line in (line for line in lines if line["stamp_ns"] in poses):
        message = poses[line["stamp_ns"]]
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        assert message.header.frame_id == "wrist_optical_frame"
        assert [place.x, place.y, place.z] == line["cam_T_grip"]["translation_m"]
        assert [turn.x, turn.y, turn.z, turn.w] == line["cam_T_grip"]["rotation_xyzw"]
        assert message.pose.covariance.tolist() == line["covariance"]


def test_who_is_gone_returns_and_commands_are_carried_out(sequence: Path, tmp_path: Path):
    """A camera with its listener, and the monitor itself by kill -9; and an operator's services."""
    with daemon(sequence, tmp_path / "out", "killed") as monitor:
        for count in (1, 2):
            with other_node("cell") as node:
                Driver(node, sequence).send(2)
                answer = node.call("/simulated/wrist/gripmon/undo")
                assert not answer.success and answer.message, "there is nothing to go back to"
                answer = node.call("/simulated/wrist/gripmon/recalibrate")
                assert answer.success and "as soon as the camera has stood still" in answer.message
            monitor.await_saying("no frames: /wrist/image", count + 1)
        with other_node("cell") as node:
            monitor.process.kill()
            with daemon(sequence, tmp_path / "again", "again") as returned:
                Driver(node, sequence).send(2)
                assert returned.stop() == 0


SIZE_PX = 64, 48
LENS = BrownConradyLens(width_px=64, height_px=48, fx_px=60.0, fy_px=60.0, cx_px=31.5, cy_px=23.5)
GREY = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


def read(camera: Ros2Camera, wanted: str) -> Frame | Waiting:
    """The first item that says so."""
    found: list[Frame | Waiting | None] = []

    def says() -> bool:
        found.append(item := camera.read())
        return wanted in (item.reason if isinstance(item, Waiting) else item.fault or "an image")

    wait_until(says, f"'{wanted}'")
    return found[-1]


def sending(camera: Ros2Camera, publisher: Any, message: Any, wanted: str) -> Frame | Waiting:
    """The same while a driver sends."""
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.02):
            publisher.publish(message)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        return read(camera, wanted)
    finally:
        stop.set()
        thread.join()


def test_what_a_topic_lacks_is_said_and_the_camera_waits_for_it():
    """In one line each: no publisher, another domain, another type, another encoding, rubbish; then it is right."""
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import String

    settings = Ros2CameraSettings(image="/eye/image", camera_info="/eye/info", domain_id=DOMAIN)
    camera = Ros2Camera(settings, SIZE_PX, make_camera(LENS))
    try:
        with other_node("elsewhere", OTHER_DOMAIN) as far:
            far.publisher(Image, "/eye/image")
            read(camera, f"/eye/image has no publisher in ROS domain {DOMAIN}; images there: none")
            with other_node("other") as node:
                node.publisher(Image, "/other/image")
                read(camera, f"/eye/image has no publisher in ROS domain {DOMAIN}; images there: /other/image")
        with other_node("text") as node:
            node.publisher(String, "/eye/image")
            read(camera, f"/eye/image in ROS domain {DOMAIN} is std_msgs/msg/String; sensor_msgs/msg/Image or Compr")
        with other_node("eye") as node:
            publisher, infos = node.publisher(Image, "/eye/image"), node.publisher(CameraInfo, "/eye/info")
            depth = image_message(np.zeros((48, 64), np.uint64), 5, encoding="64UC1")
            frame = sending(camera, publisher, depth, "encoding '64UC1'; one of mono8,")
            assert frame.image is None and camera.malformed
            sending(camera, publisher, image_message(GREY[:24], 5), "64x24 pixels; 64x48 as the camera's calibration")
            frame = sending(camera, publisher, image_message(GREY, 5), "an image")
            np.testing.assert_array_equal(frame.image, GREY)
            assert frame.stamp_ns == 5 and camera.connected
            with other_node("twin") as twin:
                twin.publisher(Image, "/eye/image")
                wait_until(lambda: "/eye/image has 2 publishers, whose images" in camera.fault(), "the second one")
            wait_until(lambda: "publishers" not in camera.fault(), "its end")
            info = CameraInfo(width=64, height=48, distortion_model="plumb_bob")
            info.k = np.array([60.0, 0.0, 39.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0])
            far = "/eye/info: the frames have a camera calibration that is up to 8 px from the configuration's"
            wait_until(lambda: infos.publish(info) or far in camera.fault(), "the wrong calibration")
            info.k[2] -= 8.0  # right, but another one
            wait_until(
                lambda: infos.publish(info) or "/eye/info isn't that of the start" in camera.fault(), "the change"
            )
        read(camera, "/eye/image has no publisher")
        assert not camera.connected
    finally:
        camera.close()
    assert camera.read() is None


def test_the_newest_image_wins_and_what_it_replaced_is_counted(monkeypatch: pytest.MonkeyPatch):
    """By the text that names a camera for teaching, in the environment's domain."""
    from sensor_msgs.msg import Image

    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    camera = open_named("ros2:64x48:/eye/image", "arm", "wrist")
    try:
        with other_node("eye") as node:
            publisher = node.publisher(Image, "/eye/image")
            wait_until(publisher.get_subscription_count, "the camera to listen")
            last_ns = time.time_ns()
            for k in range(20):
                publisher.publish(image_message(GREY, last_ns + k))
                time.sleep(0.005)
            wait_until(lambda: getattr(camera.read(), "stamp_ns", 0) == last_ns + 19, "the last one")
            assert camera.dropped > 0
    finally:
        camera.close()


def test_whatever_comes_is_an_image_or_refused_in_one_line():
    """CDR that is cut, flipped, with other lengths, or nothing of the kind; and files that are no image."""
    from rclpy.serialization import serialize_message

    camera = Ros2Camera(Ros2CameraSettings(image="/eye/image", domain_id=DOMAIN), rubbish.SIZE_PX)
    png = cv2.imencode(".png", rubbish.image())[1].tobytes()
    try:
        for kind, good, said in (
            (IMAGE, image_message(rubbish.image(), 5), ""),
            (COMPRESSED_IMAGE, file_message(png, 5), ""),
            (COMPRESSED_IMAGE, file_message(png, 5, "16UC1; compressedDepth"), "JPEG or PNG"),
            (COMPRESSED_IMAGE, file_message(b"GIF89a", 5, "gif"), "format 'gif', first 474946383961; JPEG or PNG"),
            (IMAGE, image_message(rubbish.image(), -1), "header.stamp: -1 s and 999999999 ns isn't a time"),
        ):
            payload = bytes(serialize_message(good))
            refused = lines = 0
            for each in rubbish.ros(3, 1000, payload):
                try:
                    camera._content(Arrival((kind, each), 7, 0.0))
                except Exception as error:  # noqa: BLE001  the middleware has its own, and read takes any
                    refused, lines = refused + 1, lines + str(error).count("\n")
            assert refused > 500 and not lines
            if said:
                with pytest.raises(PayloadError, match=said):
                    camera._content(Arrival((kind, payload), 7, 0.0))
            else:
                assert camera._content(Arrival((kind, payload), 7, 0.0)).stamp_ns == 5
    finally:
        camera.close()


def test_what_drivers_send_beside_plain_pixels():
    """Luma planes, and a mosaic in a file."""
    from rclpy.serialization import serialize_message

    camera = Ros2Camera(Ros2CameraSettings(image="/eye/image", domain_id=DOMAIN), SIZE_PX)
    try:
        planes = image_message(np.concatenate([GREY, GREY[::2]]), 5, encoding="nv21")
        planes.height = 48
        content = camera._content(Arrival((IMAGE, bytes(serialize_message(planes))), 7, 0.0))
        assert content.image.shape == (48, 64)
        mosaic = np.tile(np.array([[40, 120], [120, 200]], np.uint8), (24, 32))  # red, green; green, blue
        file = file_message(cv2.imencode(".png", mosaic)[1].tobytes(), 5, "bayer_rggb8; png compressed ")
        content = camera._content(Arrival((COMPRESSED_IMAGE, bytes(serialize_message(file))), 7, 0.0))
        np.testing.assert_array_equal(content.image[4:-4, 4:-4], np.full((40, 56, 3), [200, 120, 40]))
    finally:
        camera.close()


@pytest.fixture
def listener() -> Iterator[OtherNode]:
    with other_node("listener") as node:
        yield node


class Bench:
    """An output, and a node that hears it."""

    def __init__(self, node: OtherNode, **settings: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped

        self.output = Ros2Output(Ros2Settings(enabled=True, domain_id=DOMAIN, **settings), "arm", "wrist")
        topic = "/arm/wrist/gripmon/" + ("grip_T_cam" if "publish" in settings else "cam_T_grip")
        self.poses = node.listen(PoseWithCovarianceStamped, topic)
        self.diagnostics = node.listen(DiagnosticArray, "/diagnostics")
        wait_until(lambda: self._mark() and self.poses and self.diagnostics, "the listener to be known")
        self.heard()

    def _mark(self) -> bool:
        show(self.output, frame_record(0, stamp_ns=1))
        self.output.event(state_record())
        return True

    def heard(self) -> tuple[list[Any], list[Any]]:
        """Poses and diagnostics since the last call, without the marks."""
        mark = f"mark {time.monotonic_ns()}"
        self.output.event(msgspec.structs.replace(state_record(), version=mark))
        wait_until(lambda: any(values_of(each)["version"] == mark for each in list(self.diagnostics)), "the mark")
        said = self.diagnostics[: [values_of(each)["version"] for each in self.diagnostics].index(mark)]
        poses = [pose for pose in self.poses if stamp_ns(pose) != 1]
        self.poses.clear()
        self.diagnostics.clear()
        return poses, said


def test_transforms_and_diagnostics(listener: OtherNode):
    bench = Bench(listener)
    try:
        for changes, why in (
            ({}, "yes"),
            ({"verdict": Verdict.SUSPECT}, "no: verdict suspect"),
            ({"latency_ns": 490_000_000}, "yes"),
            ({"latency_ns": 5_200_000_000}, "no: ready 5.2 s after its frame came, at most 0.5 s"),
            ({"verdict": Verdict.UNKNOWN}, "no: verdict unknown"),
            ({"cam_T_grip": None, "covariance": None}, "no: no transform"),
        ):
            show(bench.output, frame_record(**changes))
            bench.output.event(state_record())
            poses, (said,) = bench.heard()
            assert values_of(said)["broadcast"] == why
            assert [pose.header.frame_id for pose in poses] == ["wrist_optical_frame"] * (why == "yes")
        raised = msgspec.structs.replace(alert_record(), event=AlertEvent.RAISED, alert_id="drift-7")
        worse = msgspec.structs.replace(raised, event=AlertEvent.UPDATED, severity=Severity.ERROR, text="moved 4 mm")
        for alert, level, cause in (
            (raised, b"\1", str(raised.cause)),
            (worse, b"\2", str(raised.cause)),
            (msgspec.structs.replace(worse, event=AlertEvent.CLEARED), b"\0", ""),
        ):
            bench.output.event(alert)  # said at once, not with the next state
            _, (said,) = bench.heard()
            (status,) = said.status
            assert (status.level, values_of(said)["cause"]) == (level, cause)
            assert (alert.text in status.message) == (level != b"\0")
        bench.output.event(alert_record())  # only noted: neither open nor over
        assert bench.heard() == ([], [])
    finally:
        bench.output.close()


def test_the_smoothed_inverse_of_a_suspect_frame(listener: OtherNode):
    bench = Bench(
        listener, publish="gripper_from_camera", parent_frame="tcp", transform="smoothed", verdicts=("valid", "suspect")
    )
    try:
        record = frame_record(verdict=Verdict.SUSPECT)
        show(bench.output, record)
        show(bench.output, frame_record(smoothed=None))
        (pose,), _ = bench.heard()
        expected, covariance = inverse(record.smoothed, record.smoothed.covariance)
        place = pose.pose.pose.position
        assert (place.x, place.y, place.z) == expected.translation_m
        assert pose.header.frame_id == "tcp"
        assert pose.pose.covariance.tolist() == covariance.tolist()
    finally:
        bench.output.close()


def test_a_node_that_fails_is_opened_again_until_it_is_there():
    opened: list[str] = []

    def set_up(node: Any) -> None:
        opened.append(node.get_fully_qualified_name())
        if len(opened) < 3:
            raise RuntimeError("the middleware\nfails")

    node = RosNode("phoenix", "/", DOMAIN, set_up)
    try:
        wait_until(lambda: opened and node.fault() == "ROS 2 fails: the middleware fails", "the fault, in one line")
        wait_until(lambda: len(opened) == 3 and not node.fault(), "the node")
        node.failed(RuntimeError("gone"))
        wait_until(lambda: len(opened) == 4 and not node.fault(), "another node")
    finally:
        node.close()


def test_a_transform_goes_to_tf_where_tf2_msgs_is(monkeypatch: pytest.MonkeyPatch):
    """Which the wheels lack: a stand-in takes what would be published, and a middleware that blocks."""
    sent: list[Any] = []
    free = threading.Event()

    class Topic:
        msg_type = SimpleNamespace

        def publish(self, message: Any) -> None:
            sent.append(message)
            free.wait(60.0)

    monkeypatch.setattr(output_module, "RosNode", lambda *_: SimpleNamespace(fault=str, close=bool))
    output = Ros2Output(Ros2Settings(enabled=True), "arm", "wrist")
    try:
        output._topics = (Topic(), Topic(), Topic())
        show(output, frame_record(0))
        wait_until(lambda: sent, "the pose, which the middleware keeps")
        begun_s = time.process_time()
        for k in range(10_000):
            show(output, frame_record(1 + k))
        assert time.process_time() - begun_s < 5.0, "nobody waits for the middleware"
        free.set()
        wait_until(lambda: stamp_ns_of(sent[-1]) == frame_record(10_000).stamp_ns, "the newest")
        assert len(sent) <= 2 * 18, "and what waits is bounded"
        (placed,) = sent[1].transforms
        assert (placed.header.frame_id, placed.child_frame_id) == ("wrist_optical_frame", "arm_wrist_gripmon")
        place, expected = placed.transform.translation, frame_record(0).cam_T_grip
        assert (place.x, place.y, place.z) == expected.translation_m
        turn = placed.transform.rotation
        assert (turn.x, turn.y, turn.z, turn.w) == expected.rotation_xyzw
    finally:
        free.set()
        output.close()


def stamp_ns_of(message: Any) -> int:
    return stamp_ns(message.transforms[0] if hasattr(message, "transforms") else message)
