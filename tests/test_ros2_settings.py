"""ROS 2's part of a configuration, and a node that fails: neither stops the loop."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import pytest
from support.loopback import (
    frame_record,
    free_endpoint,
)
from support.ros2_graph import ON, layout, tokens
from support.stand_ins import show

from gripmon.daemon.config import ConfigError, builtin_config, load_config
from gripmon.io.ros2.names import Layout, NodeName, Ros2Fault, Ros2Settings, fault_of, layout_of, network_of
from gripmon.io.ros2.publisher import Ros2Publisher
from gripmon.io.wire import Link, PublishSettings


def test_one_line_turns_it_on(tmp_path: Path):
    text = (
        builtin_config("demo.yaml")
        .read_text()
        .replace("gripper: grippers", f"gripper: {builtin_config('demo.yaml').parent}/grippers")
    )
    path = tmp_path / "demo.yaml"
    path.write_text(text)
    assert not load_config(path).settings.ros2.enabled
    path.write_text(text + "ros2: {enabled: true}\n")
    settings = load_config(path).settings
    assert layout_of(settings.ros2, settings.robot, settings.camera_name) == Layout(
        0, NodeName("gripmon", "/demo/wrist"), "wrist_optical_frame", "demo_wrist_gripmon", "/tf",
        "/demo/wrist/gripmon/cam_T_grip",
    )  # fmt: skip
    joined = network_of(settings.publish, settings.ros2)
    assert (joined.mode, joined.connect) == ("client", ("tcp/127.0.0.1:7447",))
    path.write_text(text + "ros2: {enabled: true, child_frame: wrist_optical_frame}\n")
    with pytest.raises(ConfigError, match=r"demo.yaml: ros2.child_frame: is wrist_optical_frame, the parent's name"):
        load_config(path)


def test_what_the_configuration_says_of_the_network_holds():
    for said in (
        PublishSettings(listen=("tcp/127.0.0.1:7777",)),
        PublishSettings(connect=("tcp/127.0.0.1:7777",)),
        PublishSettings(mode="client", connect=("tcp/127.0.0.1:7777",)),
        PublishSettings(zenoh_config="zenoh.json5"),
    ):
        assert network_of(said, ON) is said
    plain = PublishSettings(jaw_max_age_s=3.0)
    assert network_of(plain, Ros2Settings()) is plain
    assert network_of(plain, Ros2Settings(enabled=True, router=None)) is plain
    elsewhere = network_of(plain, Ros2Settings(enabled=True, router="tcp/10.0.0.1:7447"))
    assert (elsewhere.mode, elsewhere.connect, elsewhere.jaw_max_age_s) == ("client", ("tcp/10.0.0.1:7447",), 3.0)


def test_names_of_ours_that_ros_does_not_allow():
    made = layout_of(ON, "arm-1", "left wrist")
    assert made.node.namespace == "/arm_1/left_wrist"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"publish": "gripper_from_camera"}, "parent_frame"),
        ({"parent_frame": "a", "child_frame": "a"}, "child_frame"),
        ({"node": "grip-mon"}, "node"),
        ({"namespace": "arm"}, "namespace"),
        ({"tf_topic": "/tf/"}, "tf_topic"),
        ({"pose_topic": "~/cam T grip"}, "pose_topic"),
    ],
)
def test_settings_that_can_not_be(changes: dict[str, str], key: str):
    settings = Ros2Settings(enabled=True, **changes)
    with pytest.raises(Ros2Fault) as caught:
        layout(settings)
    assert caught.value.key == key and caught.value.wrong and caught.value.right
    assert fault_of(settings, PublishSettings(), "arm", "wrist").key == key
    assert fault_of(msgspec.structs.replace(settings, enabled=False), PublishSettings(), "arm", "wrist") is None


def test_without_publishing_there_is_no_node():
    assert fault_of(ON, PublishSettings(enabled=False), "arm", "wrist").key == "enabled"


# --- failures ---


def test_a_node_that_can_not_be_declared_says_so_with_every_record():
    """Others wait for the same session."""
    link = Link(PublishSettings(listen=(free_endpoint(),)))
    named = dataclasses.replace(layout(), tf_topic="/not a topic")
    publisher = Ros2Publisher(link, ON, named)
    reached = []
    link.attach(reached.append)
    assert reached
    with pytest.raises(RuntimeError, match="could not be declared: topic '/not a topic'"):
        show(publisher, frame_record())
    assert not tokens(reached[0])  # nor is half a node in the graph
    link.close()
