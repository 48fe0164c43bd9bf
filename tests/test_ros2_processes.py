"""`gripmon run` with one line of configuration for ROS 2, a router as ROS 2 has one, and nodes in other processes.

One of them is on plain Zenoh, one of another implementation of the protocol.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
import zenoh
from support import ros2_idl as idl
from support.loopback import free_endpoint, plain_session, wait_until
from test_ros2_names import JAZZY_HASHES

from gripmon.daemon.config import builtin_config

HERE = Path(__file__).resolve().parent
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
TF_KEY = f"0/tf/tf2_msgs::msg::dds_::TFMessage_/{JAZZY_HASHES['tf2_msgs/msg/TFMessage']}"
POSE_KEY = (
    "0/demo/wrist/gripmon/cam_T_grip/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/"
    + JAZZY_HASHES["geometry_msgs/msg/PoseWithCovarianceStamped"]
)
DIAGNOSTICS_KEY = (
    f"0/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/{JAZZY_HASHES['diagnostic_msgs/msg/DiagnosticArray']}"
)
JSON_KEY = "gripmon/demo/wrist/transform"


def configuration(folder: Path, ros2: dict[str, object]) -> Path:
    """The demo's camera, which stands still; no network settings but those of ``ros2``."""
    demo = builtin_config("demo.yaml")
    settings = yaml.safe_load(demo.read_text())
    settings["gripper"] = str(demo.parent / settings["gripper"])
    settings["source"] |= {"scenario": "static", "fps": 20.0, "duration_s": 2.0}
    settings["recording"] = {"enabled": False}
    del settings["publish"]
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(settings | {"ros2": ros2}))
    return path


@contextmanager
def process(*command: str, **pipes: object) -> Iterator[subprocess.Popen[str]]:
    """It is killed at the end if it still runs."""
    started = subprocess.Popen([sys.executable, *command], text=True, env=ENVIRONMENT, **pipes)
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


@pytest.fixture
def router() -> Iterator[tuple[str, zenoh.Session]]:
    """In place of ``rmw_zenohd``."""
    endpoint = free_endpoint()
    with plain_session(listen=endpoint, mode="router") as session:
        yield endpoint, session


@contextmanager
def daemon(endpoint: str, folder: Path, *, survives: bool = True) -> Iterator[subprocess.Popen[str]]:
    """``gripmon run`` at work."""
    path = configuration(folder, {"enabled": True, "router": endpoint})
    with process("-m", "gripmon", "run", str(path)) as started:
        yield started
        assert not survives or started.poll() is None


@dataclass(frozen=True)
class Heard:
    """What a node wrote down, in order, by key."""

    path: Path

    def lines(self, key: str) -> list[dict[str, str]]:
        # The last line may not be complete yet.
        lines = [json.loads(line) for line in self.path.read_text().split("\n")[:-1]]
        return [line for line in lines if line["key"] == key]

    def payloads(self, key: str) -> list[bytes]:
        return [bytes.fromhex(line["payload"]) for line in self.lines(key)]


@contextmanager
def node(endpoint: str, folder: Path, *keys: str) -> Iterator[Heard]:
    """A node on plain Zenoh that listens."""
    out = folder / "heard.jsonl"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with process(str(HERE / "support" / "ros2_node.py"), endpoint, str(out), *keys, **pipes) as started:
        assert started.stdout.readline() == "listening\n"
        yield Heard(out)


def test_tf_is_the_json_transform_of_the_same_stamp(router: tuple[str, zenoh.Session], tmp_path: Path):
    endpoint, _ = router
    keys = (TF_KEY, POSE_KEY, DIAGNOSTICS_KEY, JSON_KEY)
    with node(endpoint, tmp_path, *keys) as heard, daemon(endpoint, tmp_path):
        wait_until(lambda: len(heard.lines(TF_KEY)) >= 60 and len(heard.lines(DIAGNOSTICS_KEY)) >= 3, "tf", 120.0)
    records = {record["stamp_ns"]: record for record in map(json.loads, heard.payloads(JSON_KEY))}
    placed = [idl.TFMessage.deserialize(payload).transforms[0] for payload in heard.payloads(TF_KEY)]
    poses = [idl.PoseWithCovarianceStamped.deserialize(payload) for payload in heard.payloads(POSE_KEY)]
    # A machine that is slow drops some; the last one's JSON may not have come yet.
    both = [each for each in placed if stamp_ns(each.header) in records]
    assert len(both) >= 40
    for each in both:
        record = records[stamp_ns(each.header)]
        assert record["verdict"] == "valid"
        translation, rotation = each.transform.translation, each.transform.rotation
        assert [translation.x, translation.y, translation.z] == record["cam_T_grip"]["translation_m"]
        assert [rotation.x, rotation.y, rotation.z, rotation.w] == record["cam_T_grip"]["rotation_xyzw"]
        assert (each.header.frame_id, each.child_frame_id) == ("wrist_optical_frame", "demo_wrist_gripmon")
    poses = [pose for pose in poses if stamp_ns(pose.header) in records]
    assert len(poses) >= 40
    for pose in poses:
        assert pose.pose.covariance == records[stamp_ns(pose.header)]["covariance"]
    for key in (TF_KEY, POSE_KEY, DIAGNOSTICS_KEY):
        fields = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
        attachments = [bytes.fromhex(line["attachment"]) for line in heard.lines(key)]
        numbers = [zenoh.ext.z_deserialize(fields, zenoh.ZBytes(attachment))[0] for attachment in attachments]
        assert numbers[0] >= 1 and all(b > a for a, b in itertools.pairwise(numbers))
    said = [idl.DiagnosticArray.deserialize(payload).status[0] for payload in heard.payloads(DIAGNOSTICS_KEY)]
    assert said[-1].name == "gripmon: demo/wrist" and said[-1].level == 0
    assert {entry.key: entry.value for entry in said[-1].values}["broadcast"] == "yes"


def stamp_ns(header: idl.Header) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def test_another_implementation_knows_the_node_and_decodes_tf(router: tuple[str, zenoh.Session], tmp_path: Path):
    endpoint, session = router
    records: dict[int, dict[str, object]] = {}

    def remember(sample: zenoh.Sample) -> None:
        record = json.loads(sample.payload.to_bytes())
        records[record["stamp_ns"]] = record

    subscriber = session.declare_subscriber(JSON_KEY, remember)
    with daemon(endpoint, tmp_path):
        command = [sys.executable, str(HERE / "support" / "ros2_other_node.py"), endpoint.rsplit(":", 1)[1], "5"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120.0, env=ENVIRONMENT, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        *topics, first, second, third, fourth, fifth = map(json.loads, done.stdout.splitlines())
        placed = [first, second, third, fourth, fifth]
        wait_until(lambda: all(each["stamp_ns"] in records for each in placed), "the same transforms in JSON")
    subscriber.undeclare()
    for each in placed:
        transform = records[each["stamp_ns"]]["cam_T_grip"]
        assert each["translation_m"] == transform["translation_m"]
        assert each["rotation_xyzw"] == transform["rotation_xyzw"]
        assert each["frames"] == ["wrist_optical_frame", "demo_wrist_gripmon"]
    expected = {
        "/tf": ("tf2_msgs/msg/TFMessage", "::,100:,:,:,,"),
        "/demo/wrist/gripmon/cam_T_grip": ("geometry_msgs/msg/PoseWithCovarianceStamped", "::,10:,:,:,,"),
        "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "::,10:,:,:,,"),
    }
    assert [topic["topic_name"] for topic in topics] == list(expected)
    for topic in topics:
        type_name, qos = expected[topic["topic_name"]]
        assert topic["topic_types"] == [type_name]
        (publisher,) = topic["publishers"]
        del publisher["gid"]  # not in a token, and it doesn't compute it
        assert publisher == {
            "node_name": "gripmon",
            "node_namespace": "/demo/wrist",
            "topic_type": type_name,
            "type_hash": JAZZY_HASHES[type_name],
            "qos": qos,
        }


def test_topics_that_it_listens_to_are_shown_in_the_graph(router: tuple[str, zenoh.Session], tmp_path: Path):
    """Whatever `ros2.enabled` says: drivers want to know."""
    endpoint, session = router
    path = configuration(tmp_path, {"enabled": False})
    settings = yaml.safe_load(path.read_text())
    settings["source"] = {"kind": "zenoh", "topic": "/camera/image_raw", "format": "ros2_image"}
    settings["jaw"] = {
        "source": "ros2_joint_state", "topic": "/joint_states", "opening": {"joints": ["left_finger", "right_finger"]},
    }  # fmt: skip
    settings["publish"] = {"mode": "client", "connect": [endpoint]}
    path.write_text(yaml.safe_dump(settings))
    with process("-m", "gripmon", "run", str(path)) as started:
        wait_until(lambda: started.poll() is not None or len(tokens(session)) == 3, "the subscriptions", 60.0)
        seen = [token.split("/")[5:] for token in tokens(session)]
    types = {"%camera%image_raw": "sensor_msgs/msg/Image", "%joint_states": "sensor_msgs/msg/JointState"}
    for topic, type_name in types.items():
        (one,) = [token for token in seen if topic in token]
        assert one[:4] == ["MS", "%", "%demo%wrist", "gripmon_input"] and one[6] == JAZZY_HASHES[type_name]


def tokens(session: zenoh.Session) -> list[str]:
    replies = session.liveliness().get("@ros2_lv/0/**", timeout=5.0)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok]


def test_the_node_leaves_the_graph_when_the_daemon_is_killed(router: tuple[str, zenoh.Session], tmp_path: Path):
    endpoint, session = router
    with daemon(endpoint, tmp_path, survives=False) as started:
        wait_until(lambda: len(tokens(session)) == 4, "the node and its publishers", 60.0)
        started.kill()
        wait_until(lambda: not tokens(session), "the tokens to go")


def test_without_rosbags_it_says_what_to_install(tmp_path: Path):
    path = configuration(tmp_path, {"enabled": True, "router": free_endpoint()})
    (tmp_path / "rosbags.py").write_text("raise ImportError('no such package', name='rosbags')")
    paths = os.pathsep.join([str(tmp_path), str(HERE.parent)])
    done = subprocess.run(
        [sys.executable, "-m", "gripmon", "run", str(path)],
        capture_output=True, text=True, timeout=60.0, env=os.environ | {"PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 2
    assert "ros2.enabled: needs the package rosbags; pip install -e '.[ros2]' in gripmon's checkout" in done.stderr
    assert "Traceback" not in done.stderr
