"""The monitor as a ROS 2 node, met by plain Zenoh sessions; its settings; and that no one suffers when it fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import pytest
import zenoh
from support import ros2_idl as idl
from support.loopback import (
    alert_record,
    frame_record,
    free_endpoint,
    plain_session,
    reference_record,
    state_record,
    wait_until,
)
from support.ros2_graph import ON, layout, tokens
from support.stand_ins import show

from gripmon.io.ros2.names import NodeName, Ros2Settings, dds_type
from gripmon.io.ros2.node import HeardTopic, Listeners, gid_of, type_hash
from gripmon.io.ros2.publisher import Ros2Publisher, inverse
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.records import AlertEvent, AlertKind, Severity, StandingAlert, Verdict

TF_KEY = "0/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
POSE_KEY = (
    "0/arm/wrist/gripmon/cam_T_grip/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/"
    "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
)
DIAGNOSTICS_KEY = (
    "0/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/"
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
)


class Bench:
    """A publisher on a link, and in another session a subscriber to everything of its domain."""

    def __init__(self, settings: Ros2Settings, session: zenoh.Session, link: Link) -> None:
        self.session = session
        self.publisher = Ros2Publisher(link, settings, layout(settings))
        self._marks = 0
        self._samples: list[zenoh.Sample] = []
        self._subscriber = session.declare_subscriber(f"{settings.domain_id}/**", self._samples.append)
        wait_until(lambda: self._mark() and self._samples, "the subscription to reach the publisher")
        self.published()

    def published(self) -> list[zenoh.Sample]:
        """All that was published since the last call.  Diagnostics have the lowest priority: what was put before the
        mark arrives before it.
        """
        mark = self._mark()
        wait_until(lambda: self._marked(mark), "the mark")
        at = next(i for i, sample in enumerate(self._samples) if mark in sample.payload.to_bytes())
        taken = self._samples[:at]
        self._samples.clear()
        return taken

    def payloads(self) -> dict[str, bytes]:
        """The same by key, where each has one at most."""
        samples = self.published()
        payloads = {str(sample.key_expr): sample.payload.to_bytes() for sample in samples}
        assert len(payloads) == len(samples)
        return payloads

    def _mark(self) -> bytes:
        self._marks += 1
        self.publisher.event(msgspec.structs.replace(state_record(), version=f"mark-{self._marks:04}"))
        return f"mark-{self._marks:04}".encode()

    def _marked(self, mark: bytes) -> bool:
        return any(mark in sample.payload.to_bytes() for sample in list(self._samples))


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,)))
    with plain_session(connect=endpoint) as session:
        yield lambda settings=ON: Bench(settings, session, link)
    link.close()


def status(payload: bytes) -> idl.DiagnosticStatus:
    (only,) = idl.DiagnosticArray.deserialize(payload).status
    return only


def values(payload: bytes) -> dict[str, str]:
    return {entry.key: entry.value for entry in status(payload).values}


def test_a_valid_frame(make_bench: Callable[..., Bench]):
    bench, record = make_bench(), frame_record()
    show(bench.publisher, record)
    bench.publisher.event(reference_record())
    payloads = bench.payloads()
    assert set(payloads) == {TF_KEY, POSE_KEY}
    (placed,) = idl.TFMessage.deserialize(payloads[TF_KEY]).transforms
    pose = idl.PoseWithCovarianceStamped.deserialize(payloads[POSE_KEY])
    assert placed.header == pose.header == idl.Header(idl.Time(1_700_000_000, 123_456_796), "wrist_optical_frame")
    assert placed.child_frame_id == "arm_wrist_gripmon"
    assert placed.transform.translation == pose.pose.pose.position == idl.Vector3(0.011, -0.022, 0.133)
    assert placed.transform.rotation == idl.Quaternion(0.1, -0.2, 0.3, 0.9273618495495703)
    assert tuple(pose.pose.covariance) == record.covariance


def test_smoothed_inverse_on_another_domain_under_other_names(make_bench: Callable[..., Bench]):
    settings = Ros2Settings(
        enabled=True, domain_id=42, node="watch", namespace="/cell_3", publish="gripper_from_camera",
        parent_frame="tcp", child_frame="corrected_camera", transform="smoothed", tf_topic="tf", pose_topic="camera",
    )  # fmt: skip
    bench, record = make_bench(settings), frame_record()
    show(bench.publisher, record)
    payloads = bench.payloads()
    tf_key, pose_key = sorted(payloads, reverse=True)
    assert tf_key.startswith("42/cell_3/tf/tf2_msgs::") and pose_key.startswith("42/cell_3/camera/geometry_msgs::")
    (placed,) = idl.TFMessage.deserialize(payloads[tf_key]).transforms
    assert (placed.header.frame_id, placed.child_frame_id) == ("tcp", "corrected_camera")
    smoothed = record.smoothed
    expected, covariance = inverse(smoothed, smoothed.covariance)
    assert placed.transform.translation == idl.Vector3(*expected.translation_m)
    assert placed.transform.rotation == idl.Quaternion(*expected.rotation_xyzw)
    pose = idl.PoseWithCovarianceStamped.deserialize(payloads[pose_key])
    assert pose.pose.covariance == covariance.tolist()
    show(bench.publisher, frame_record(smoothed=None))
    assert not bench.published()


@pytest.mark.parametrize(
    ("verdicts", "changes", "published", "why"),
    [
        (("valid",), {}, True, "yes"),
        (("valid",), {"verdict": Verdict.SUSPECT}, False, "no: verdict suspect"),
        (("valid", "suspect"), {"verdict": Verdict.SUSPECT}, True, "yes"),
        (("valid",), {"latency_ns": 490_000_000}, True, "yes"),
        (("valid",), {"latency_ns": 5_200_000_000}, False, "no: judged 5.2 s after its frame came, at most 0.5 s"),
        (("valid", "suspect"), {"verdict": Verdict.UNKNOWN}, False, "no: verdict unknown"),
        (("valid", "suspect"), {"verdict": Verdict.SUSPECT, "cam_T_grip": None, "covariance": None}, False,
         "no: no transform"),
    ],
)  # fmt: skip
def test_what_may_not_be_used_is_not_broadcast(
    make_bench: Callable[..., Bench], verdicts: tuple[str, ...], changes: dict[str, object], published: bool, why: str
):
    bench = make_bench(Ros2Settings(enabled=True, verdicts=verdicts))
    show(bench.publisher, frame_record(**changes))
    bench.publisher.event(state_record())
    payloads = bench.payloads()
    assert set(payloads) == ({TF_KEY, POSE_KEY, DIAGNOSTICS_KEY} if published else {DIAGNOSTICS_KEY})
    assert values(payloads[DIAGNOSTICS_KEY])["broadcast"] == why


def test_diagnostics_follow_the_alerts(make_bench: Callable[..., Bench]):
    bench = make_bench()
    assert values_after(bench, lambda: None)["broadcast"] == "no: no frame yet"
    raised = msgspec.structs.replace(alert_record(), event=AlertEvent.RAISED, alert_id="drift-7")
    # Said at once, not with the next state.
    bench.publisher.event(raised)
    (sample,) = bench.published()
    assert status(sample.payload.to_bytes()).level == 1 and "moved 1.5 mm" in status(sample.payload.to_bytes()).message
    worse = msgspec.structs.replace(raised, event=AlertEvent.UPDATED, severity=Severity.ERROR, text="moved 4 mm")
    bench.publisher.event(worse)
    (sample,) = bench.published()
    assert status(sample.payload.to_bytes()).level == 2
    assert values(sample.payload.to_bytes())["alerts"] == "drift (error)"
    bench.publisher.event(msgspec.structs.replace(worse, event=AlertEvent.CLEARED))
    (sample,) = bench.published()
    assert status(sample.payload.to_bytes()).level == 0 and values(sample.payload.to_bytes())["alerts"] == ""
    bench.publisher.event(alert_record())  # only noted: neither open nor over
    assert not bench.published()
    # The state knows of those, too, that were raised before this node was there.
    kept = StandingAlert("creep-2", AlertKind.CREEP, Severity.WARNING, "creeps", 5, acknowledged=False)
    bench.publisher.event(msgspec.structs.replace(state_record(), open_alerts=(kept,)))
    (sample,) = bench.published()
    assert status(sample.payload.to_bytes()).level == 1
    assert values(sample.payload.to_bytes())["alerts"] == "creep (warning)"


def values_after(bench: Bench, act: Callable[[], None]) -> dict[str, str]:
    act()
    bench.publisher.event(state_record())
    return values(bench.payloads()[DIAGNOSTICS_KEY])


def test_attachments_count_and_name_the_publisher(make_bench: Callable[..., Bench]):
    bench = make_bench()
    for seq in range(3):
        show(bench.publisher, frame_record(seq))
    samples = [sample for sample in bench.published() if str(sample.key_expr) == TF_KEY]
    fields = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    numbers, stamps_ns, gids = zip(
        *(zenoh.ext.z_deserialize(fields, sample.attachment) for sample in samples), strict=True
    )
    assert numbers == (1, 2, 3)
    assert list(stamps_ns) == sorted(stamps_ns) and stamps_ns[0] > 1_700_000_000_000_000_000
    (token,) = [token for token in tokens(bench.session) if "/%tf/" in token]
    assert set(gids) == {gid_of(token)}


def test_the_node_is_in_the_graph_until_it_closes(make_bench: Callable[..., Bench]):
    bench = make_bench()
    seen = tokens(bench.session)
    (node,) = [token for token in seen if "/NN/" in token]
    zid, node_id = node.split("/")[2:4]
    (publisher,) = map(str, [*bench.session.info.peers_zid(), *bench.session.info.routers_zid()])
    assert zid == publisher
    assert node == f"@ros2_lv/0/{zid}/{node_id}/{node_id}/NN/%/%arm%wrist/gripmon"
    endpoints = sorted(token.split("/MP/%/%arm%wrist/gripmon/")[1] for token in seen if "/MP/" in token)
    assert endpoints == [
        f"%arm%wrist%gripmon%cam_T_grip/{'/'.join(POSE_KEY.split('/')[-2:])}/::,10:,:,:,,",
        f"%diagnostics/{'/'.join(DIAGNOSTICS_KEY.split('/')[-2:])}/::,10:,:,:,,",
        f"%tf/{'/'.join(TF_KEY.split('/')[-2:])}/::,100:,:,:,,",
    ]
    ids = [token.split("/")[4] for token in seen]
    assert len(set(ids)) == len(ids) == 4
    bench.publisher.close()
    wait_until(lambda: not tokens(bench.session), "the tokens to go")
    show(bench.publisher, frame_record())  # and nothing is raised


def test_a_client_whose_router_comes_late():
    """Nothing is kept for it: an old transform would be taken for a new one."""
    endpoint = free_endpoint()
    link = Link(PublishSettings(mode="client", connect=(endpoint,), retry_longest_s=0.25))
    publisher = Ros2Publisher(link, ON, layout())
    publisher.event(state_record())
    show(publisher, frame_record())
    with plain_session(listen=endpoint, mode="router") as session:
        samples: list[zenoh.Sample] = []
        subscriber = session.declare_subscriber(TF_KEY, samples.append)
        wait_until(lambda: len(tokens(session)) == 4, "the node")

        def arrives() -> bool:
            show(publisher, frame_record(9))
            return bool(samples)

        wait_until(arrives, "a transform")
        (placed,) = idl.TFMessage.deserialize(samples[0].payload.to_bytes()).transforms
        assert placed.header.stamp.nanosec == 123_456_789 + 9
        subscriber.undeclare()
        link.close()


def test_the_node_is_back_after_a_restart_of_the_router():
    endpoint = free_endpoint()
    link = Link(PublishSettings(mode="client", connect=(endpoint,), retry_longest_s=0.25))
    publisher = Ros2Publisher(link, ON, layout())
    seen = []
    for _ in range(2):
        with plain_session(listen=endpoint, mode="router") as session:
            wait_until(lambda session=session: len(tokens(session)) == 4, "the node", 60.0)
            samples: list[zenoh.Sample] = []
            subscriber = session.declare_subscriber(TF_KEY, samples.append)

            def arrives(samples: list[zenoh.Sample] = samples) -> bool:
                show(publisher, frame_record())
                return bool(samples)

            wait_until(arrives, "a transform")
            seen.append(set(tokens(session)))
            subscriber.undeclare()
    assert seen[0] == seen[1]
    link.close()


def test_subscriptions_are_shown_in_the_graph():
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,)))
    image, joints = "sensor_msgs/msg/Image", "sensor_msgs/msg/JointState"
    name = NodeName("gripmon_input", "/arm/wrist")
    heard = [(0, "/cam/image_raw", image), (0, "/js", joints), (7, "/js", joints)]
    Listeners(link, name, [HeardTopic(*each) for each in heard])
    with plain_session(connect=endpoint) as session:
        wait_until(lambda: len(tokens(session)) == 5, "two nodes, three subscriptions")
        parts = [token.split("/") for token in tokens(session)]
        node = ("MS", "%", "%arm%wrist", "gripmon_input")
        assert sorted((p[1], *p[5:]) for p in parts if p[5] == "MS") == sorted(
            (str(domain), *node, topic.replace("/", "%"), dds_type(name), type_hash(name), "2::,5:,:,:,,")
            for domain, topic, name in heard
        )
        nodes = {p[1]: p[3] for p in parts if p[5] == "NN"}
        assert set(nodes) == {"0", "7"} and all(p[3] == nodes[p[1]] for p in parts)
        link.close()
        wait_until(lambda: not tokens(session), "the tokens to go")
