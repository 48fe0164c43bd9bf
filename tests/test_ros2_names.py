"""Keys, tokens, hashes and attachments: against the examples of the design document and another implementation.

The document is ``docs/design.md`` of https://github.com/ros2/rmw_zenoh (commit 99a6a2b), quoted verbatim; the other
implementation is ``zenoh-ros2-sdk``, of which only functions are used that need no network.
"""

from __future__ import annotations

import struct

import pytest
import xxhash
import zenoh
from support.ros2_definitions import DEFINITIONS
from zenoh_ros2_sdk import attachment as other_attachment
from zenoh_ros2_sdk import entity as other_entity
from zenoh_ros2_sdk import keyexpr as other_keys
from zenoh_ros2_sdk import qos as other_qos
from zenoh_ros2_sdk import utils as other_utils

from gripmon.io.ros2.names import NodeName, Qos, RosNameError, as_token, dds_type, endpoint_token, node_token, topic_key
from gripmon.io.ros2.node import attachment, gid_of, type_hash

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"

# Extracted from an installation of Jazzy by https://github.com/copper-project/copper-rs,
# components/payloads/cu_ros2_payloads/all_rihs.md (commit 8d63682).
JAZZY_HASHES = {
    "std_msgs/msg/String": STRING_HASH,
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
    ),
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "sensor_msgs/msg/Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/CompressedImage": "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
}


def test_topic_keys_of_the_design_document():
    chatter = f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert topic_key(0, "/chatter", "std_msgs/msg/String", STRING_HASH) == chatter
    in_namespace = NodeName("talker", "/robot1").expand("chatter")
    assert topic_key(0, in_namespace, "std_msgs/msg/String", STRING_HASH) == (
        f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    )
    # The example is a service; only the type's middle differs.
    service_hash = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    assert topic_key(2, "/add_two_ints", "example_interfaces/srv/AddTwoInts", service_hash) == (
        f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{service_hash}"
    )


def test_tokens_of_the_design_document():
    zid = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert node_token(2, zid, 0, NodeName("listener")) == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    )
    listener = endpoint_token(
        "MS", 2, zid, (0, 10), NodeName("listener"), "/chatter", "std_msgs/msg/String", STRING_HASH, Qos()
    )
    assert listener == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,10:,:,:,,"
    )
    zid = "8b20917502ee955ac4476e0266340d5c"
    talker = endpoint_token(
        "MP", 2, zid, (0, 10), NodeName("talker"), "/chatter", "std_msgs/msg/String", STRING_HASH, Qos(depth=7)
    )
    assert talker == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
    )


@pytest.mark.parametrize("type_name", JAZZY_HASHES)
def test_type_hashes_of_an_installation(type_name: str):
    assert type_hash(type_name) == JAZZY_HASHES[type_name]


@pytest.mark.parametrize("type_name", [name for name in JAZZY_HASHES if name in DEFINITIONS])
def test_type_hashes_of_the_other_implementation(type_name: str):
    """It computes them from the definitions, by code of its own."""
    theirs = other_utils.get_type_hash(type_name, DEFINITIONS[type_name], DEFINITIONS)
    assert type_hash(type_name) == theirs


def test_keys_and_tokens_of_the_other_implementation():
    node = NodeName("gripmon", "/arm/wrist")
    topic = node.expand("~/cam_T_grip")
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    their_type = other_utils.ros2_to_dds_type(type_name)
    assert dds_type(type_name) == their_type
    assert topic_key(7, topic, type_name, "h") == other_keys.topic_keyexpr(7, topic, their_type, "h")
    their_node = other_entity.NodeEntity(7, "4f", 3, "gripmon", "/arm/wrist")
    assert node_token(7, "4f", 3, node) == other_keys.node_liveliness_keyexpr(their_node)
    for kind, qos in (("MP", Qos(depth=100)), ("MS", Qos(reliable=False, transient_local=True))):
        theirs = other_entity.EndpointEntity(
            their_node, 5, other_entity.EntityKind(kind), topic, their_type, "h", their_qos(qos).encode()
        )
        token = endpoint_token(kind, 7, "4f", (3, 5), node, topic, type_name, "h", qos)
        assert token == other_keys.endpoint_liveliness_keyexpr(theirs)
        assert zenoh.KeyExpr(token)  # Zenoh takes it as a key


def their_qos(qos: Qos) -> other_qos.QosProfile:
    return other_qos.QosProfile(
        reliability=other_qos.QosReliability.RELIABLE if qos.reliable else other_qos.QosReliability.BEST_EFFORT,
        durability=(
            other_qos.QosDurability.TRANSIENT_LOCAL if qos.transient_local else other_qos.QosDurability.VOLATILE
        ),
        history_depth=qos.depth,
    )


@pytest.mark.parametrize("qos", [Qos(), Qos(depth=1), Qos(100, False, True), Qos(5, False), Qos(3, True, True)])
def test_qos_of_the_other_implementation(qos: Qos):
    assert str(qos) == their_qos(qos).encode()
    assert other_qos.QosProfile.decode(str(qos)) == their_qos(qos)


def test_the_depth_that_stays_unsaid():
    """42 is the default of ``rmw_zenoh`` (``qos.cpp``); the other implementation says it nevertheless."""
    assert str(Qos(depth=42)) == "::,:,:,:,,"


def test_attachment():
    gid = bytes(range(16))
    ours = attachment(5, 1_700_000_000_123_456_789, gid)
    assert ours == other_attachment.Attachment(5, 1_700_000_000_123_456_789, gid).to_bytes()
    # The layout of the design document, and Zenoh's own serialisation, which rmw_zenoh uses.
    assert len(ours) == 33 and ours[16] == 16
    fields = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    assert zenoh.ext.z_deserialize(fields, zenoh.ZBytes(ours)) == (5, 1_700_000_000_123_456_789, gid)
    values = (zenoh.ext.Int64(5), zenoh.ext.Int64(1_700_000_000_123_456_789), gid)
    assert zenoh.ext.z_serialize(values).to_bytes() == ours


def test_gids_are_the_hash_of_the_token():
    """``liveliness_utils.cpp``: ``low64``, then ``high64`` of XXH3, each copied from memory."""
    token = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    high, low = struct.unpack(">QQ", xxhash.xxh3_128_digest(token.encode()))  # canonical: the high half first
    assert gid_of(token) == struct.pack("<QQ", low, high)
    assert gid_of(token) != gid_of(token + "2")


def test_names_are_expanded_as_in_ros():
    node = NodeName("gripmon", "/arm/wrist")
    assert node.expand("~/pose") == "/arm/wrist/gripmon/pose"
    assert node.expand("pose") == "/arm/wrist/pose"
    assert node.expand("/tf") == "/tf"
    assert NodeName("gripmon").expand("~/pose") == "/gripmon/pose"
    assert NodeName("gripmon").expand("pose") == "/pose"


@pytest.mark.parametrize(
    ("name", "namespace", "topic"),
    [
        ("9gripmon", "/", "/tf"),
        ("grip-mon", "/", "/tf"),
        ("", "/", "/tf"),
        ("gripmon", "arm", "/tf"),
        ("gripmon", "/arm/", "/tf"),
        ("gripmon", "/arm/4", "/tf"),
        ("gripmon", "/", "/"),
        ("gripmon", "/", "/tf/*"),
        ("gripmon", "/", "tf/"),
        ("gripmon", "/", "~"),
    ],
)
def test_names_that_ros_does_not_allow(name: str, namespace: str, topic: str):
    with pytest.raises(RosNameError, match="; give "):
        NodeName(name, namespace).expand(topic)


@pytest.mark.parametrize(
    ("text", "token"), [("arm1", "arm1"), ("arm-1", "arm_1"), ("7axis", "_7axis"), ("ärmel.a", "_rmel_a")]
)
def test_our_names_become_tokens(text: str, token: str):
    assert as_token(text) == token
    assert NodeName(as_token(text))
