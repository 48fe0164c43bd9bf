"""The publisher against plain Zenoh sessions that know only the contract's keys and JSON."""

from __future__ import annotations

import json
import pickle
import threading
import time
from pathlib import Path

import msgspec
import pytest
import zenoh
from support.loopback import (
    alert_record,
    ask,
    can_bind,
    frame_record,
    plain_session,
    reference_record,
    state_record,
    wait_until,
)
from support.published import Published

from gripmon.io.wire import Keys, PublishError, PublishSettings

PREFIX = "gripmon/arm/wrist"


def received(subscriber: zenoh.Subscriber, put: object) -> zenoh.Sample:
    """The first sample after ``put()``, which is repeated until the subscription has reached the publisher."""
    samples: list[zenoh.Sample] = []

    def arrived() -> bool:
        put()  # type: ignore[operator]
        while (sample := subscriber.try_recv()) is not None:
            samples.append(sample)
        return bool(samples)

    wait_until(arrived, "a sample")
    return samples[0]


def test_transform_on_the_wire(publisher: Published, session: zenoh.Session):
    record = frame_record()
    sample = received(session.declare_subscriber(f"{PREFIX}/transform"), lambda: publisher.transform(record))
    message = json.loads(sample.payload.to_bytes())
    assert message["cam_T_grip"] == {
        "translation_m": [0.011, -0.022, 0.133],
        "rotation_xyzw": [0.1, -0.2, 0.3, 0.9273618495495703],
    }
    assert message["stamp_ns"] == 1_700_000_000_123_456_796
    assert message["covariance"] == [1e-9 * (i + 1) for i in range(36)]
    assert message["verdict"] == "valid" and message["source"] == "update"
    assert {key: message["protection"][key] for key in ("position_m", "rotation_rad", "risk")} == {
        "position_m": 0.00045, "rotation_rad": 0.0055, "risk": 1e-5,
    }  # fmt: skip
    fields = (
        "seq stamp_ns verdict state source cam_T_grip covariance smoothed drift reference_id revision rms_px "
        "jaw_opening_m corners alerts latency_ns protection"
    )
    assert set(message) >= set(fields.split())
    assert message["corners"] == [
        {"id": "L_in_near", "uv_px": [12.5, 34.25], "sigma_px": 0.05, "used": True, "reason": None}
    ]
    assert sample.express and sample.priority == zenoh.Priority.REAL_TIME
    assert sample.congestion_control == zenoh.CongestionControl.DROP
    assert str(sample.encoding) == "application/json"


def test_alert_on_the_wire(publisher: Published, session: zenoh.Session):
    sample = received(session.declare_subscriber(f"{PREFIX}/alert"), lambda: publisher.event(alert_record("it moved")))
    message = json.loads(sample.payload.to_bytes())
    assert (message["kind"], message["cause"], message["text"]) == ("drift", "camera_mount_moved", "it moved")


@pytest.mark.parametrize("leaf", ["state", "reference"])
def test_late_joiners_get_the_last_one(publisher: Published, endpoint: str, leaf: str):
    records = [state_record(i) for i in (1, 2)] if leaf == "state" else [reference_record(i) for i in (1, 2)]
    for record in records:
        publisher.event(record)
    expected = json.loads(msgspec.json.encode(records[-1]))
    with plain_session(connect=endpoint) as session:
        assert ask(session, f"{PREFIX}/{leaf}") == [expected]
        assert ask(session, f"gripmon/*/*/{leaf}") == [expected]
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session, f"{PREFIX}/{leaf}", history=zenoh.ext.HistoryConfig(max_samples=10, detect_late_publishers=True)
        )
        samples: list[zenoh.Sample] = []
        wait_until(lambda: (sample := subscriber.try_recv()) is not None and not samples.append(sample), "history")
        assert [json.loads(sample.payload.to_bytes()) for sample in samples] == [expected]
        publisher.event(records[0])
        wait_until(lambda: (sample := subscriber.try_recv()) is not None and not samples.append(sample), "the next one")
        assert json.loads(samples[-1].payload.to_bytes()) == json.loads(msgspec.json.encode(records[0]))


def test_the_last_transform_can_be_asked_for(publisher: Published, session: zenoh.Session):
    for seq in (1, 2, 3):
        publisher.transform(frame_record(seq))
    expected = json.loads(msgspec.json.encode(frame_record(3)))
    assert ask(session, f"{PREFIX}/transform") == [expected]
    assert ask(session, "gripmon/*/*/transform") == [expected]


def test_a_question_before_the_first_state_is_answered_in_words(session: zenoh.Session):
    replies = list(session.get(f"{PREFIX}/state", timeout=20.0))
    assert [reply.err.payload.to_string() for reply in replies] == ["nothing published on this key yet"]


def test_close_frees_token_port_and_threads(endpoint: str):
    before = set(threading.enumerate())
    publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    with plain_session(connect=endpoint) as session:
        tokens = session.liveliness().declare_subscriber(f"{PREFIX}/alive", history=True)
        assert tokens.recv().kind == zenoh.SampleKind.PUT
        assert not can_bind(endpoint)
        publisher.close()
        publisher.close()
        assert tokens.recv().kind == zenoh.SampleKind.DELETE
    wait_until(lambda: can_bind(endpoint), "the port to be free")
    wait_until(lambda: set(threading.enumerate()) <= before, f"threads to end: {threading.enumerate()}")


def test_a_port_that_is_taken_is_said_with_its_key(publisher: Published, endpoint: str):
    with pytest.raises(PublishError) as caught:
        Published(PublishSettings(listen=(endpoint,)), "arm", "other")
    said = str(caught.value)
    assert said.startswith("publish.listen: can't open a Zenoh session: ") and "\n" not in said
    assert endpoint in said and "Address already in use" in said
    assert "each monitor on this computer listens on a port of its own, such as tcp/127.0.0.1:7448, or all" in said


def test_a_client_waits_for_its_router_without_holding_anybody_up(endpoint: str):
    settings = PublishSettings(mode="client", connect=(endpoint,), retry_first_s=0.02, retry_longest_s=0.1)
    publisher = Published(settings, "arm", "wrist")
    try:
        assert not publisher.connected
        for record in (frame_record(1), frame_record(2)):
            publisher.transform(record)
        publisher.event(state_record(1))
        publisher.event(state_record(2))
        publisher.event(reference_record(4))
        publisher.event(alert_record("first"))
        publisher.event(alert_record("second"))
        assert publisher.unsent == 2
        with plain_session(listen=endpoint, mode="router") as router:
            wait_until(lambda: publisher.connected, "the session")
            wait_until(lambda: ask(router, f"{PREFIX}/state"), "the state")
            assert ask(router, f"{PREFIX}/state")[0]["seq"] == 2
            assert ask(router, f"{PREFIX}/reference")[0]["revision"] == 4
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            alerts = zenoh.ext.declare_advanced_subscriber(router, f"{PREFIX}/alert", history=history)
            assert [json.loads(alerts.recv().payload.to_bytes())["text"] for _ in range(2)] == ["first", "second"]
            transforms = router.declare_subscriber(f"{PREFIX}/transform")
            received(transforms, lambda: publisher.transform(frame_record(3)))
        assert publisher.unsent == 2
    finally:
        publisher.close()


def test_a_client_that_never_finds_its_router_closes(endpoint: str):
    before = set(threading.enumerate())
    publisher = Published(PublishSettings(mode="client", connect=(endpoint,)), "arm", "wrist")
    publisher.close()
    wait_until(lambda: set(threading.enumerate()) <= before, "the opening thread to end")


@pytest.mark.parametrize("suffix", [".json5", ".yaml"])
def test_a_file_of_zenohs_is_accepted(tmp_path: Path, endpoint: str, suffix: str):
    path = tmp_path / f"zenoh{suffix}"
    text = {
        ".json5": "{mode: 'peer', listen: {endpoints: ['HERE']}, scouting: {multicast: {enabled: false}}} // json5",
        ".yaml": "mode: peer\nlisten:\n  endpoints: [HERE]\nscouting:\n  multicast:\n    enabled: false\n",
    }[suffix].replace("HERE", endpoint)
    path.write_text(text)
    publisher = Published(PublishSettings(zenoh_config=path.name), "arm", "wrist", relative_to=tmp_path)
    try:
        publisher.event(state_record(5))
        with plain_session(connect=endpoint) as session:
            assert ask(session, f"{PREFIX}/state")[0]["seq"] == 5
        with pytest.raises(PublishError, match=rf"^publish.zenoh_config: .*{endpoint}.*Address already in use"):
            Published(PublishSettings(zenoh_config=str(path)), "arm", "other")
    finally:
        publisher.close()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mode": "client"}, "publish.connect: a client needs a router"),
        ({"connect": ("nonsense",)}, "publish.connect: 'nonsense' is not an endpoint; protocol/host:port, e.g. tcp/"),
        ({"connect": ("127.0.0.1:1",)}, "publish.connect: '127.0.0.1:1' is not an endpoint; "),
        ({"connect": ("tcp/127.0.0.1",)}, "publish.connect: 'tcp/127.0.0.1' is not an endpoint; "),
        ({"listen": ("tcp/[::1]:65536",)}, "publish.listen: 'tcp/[::1]:65536' is not an endpoint; "),
        ({"listen": ("tcp/[::1]:7447\n",)}, "publish.listen: 'tcp/[::1]:7447\\n' is not an endpoint; "),
        ({"zenoh_config": "/nowhere.json5"}, "publish.zenoh_config: no file /nowhere.json5"),
        ({"zenoh_config": __file__}, "publish.zenoh_config: "),
        ({"zenoh_config": __file__, "connect": ("tcp/127.0.0.1:1",)}, "publish.connect: has no effect beside"),
        ({"listen": ("tcp/256.1.1.1:5",)}, "publish.listen: can't open a Zenoh session"),
    ],
)
def test_bad_settings_name_their_key(changes: dict[str, object], text: str):
    with pytest.raises(PublishError) as caught:
        Published(PublishSettings(**changes), "arm", "wrist")  # type: ignore[arg-type]
    assert str(caught.value).startswith(text)
    assert "\n" not in str(caught.value) and ".rs:" not in str(caught.value)
    elsewhere = pickle.loads(pickle.dumps(caught.value))  # as a process pool sends it
    assert (str(elsewhere), elsewhere.key) == (str(caught.value), caught.value.key)


@pytest.mark.parametrize("name", ["", "a/b", "*", "a*", "$x", "a#b", "a?b", "@adv", "a b", "a\n"])
def test_names_that_would_break_a_key_are_refused(name: str):
    for robot, camera in ((name, "wrist"), ("arm", name)):
        with pytest.raises(ValueError, match=r"name .* can't be part of a Zenoh key"):
            Published(PublishSettings(listen=()), robot, camera)


@pytest.mark.parametrize("name", ["arm", "arm-1", "Größe", "a@b", "ur10.left"])
def test_names_that_zenoh_takes_are_taken(name: str):
    assert zenoh.KeyExpr(Keys(name, name)["state"])


def test_the_newest_jaw_opening_wins(publisher: Published, session: zenoh.Session):
    assert publisher.jaw.opening_m() is None
    assert publisher.jaw.fault() == "no jaw opening received"
    for stamp_ns, opening_m in ((1, 0.010), (3, 0.020), (2, 0.030)):
        session.put(f"{PREFIX}/jaw", json.dumps({"stamp_ns": stamp_ns, "opening_m": opening_m, "more": 1}))
    wait_until(lambda: publisher.jaw.opening_m() == 0.030, "the jaw opening that was sent last")
    assert publisher.jaw.fault() == ""


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"0.02 m",
        b"\xff\xfe",
        b'{"opening_m": 0.02}',
        b'{"stamp_ns": 1, "opening_m": NaN}',
        b'{"stamp_ns": 1, "opening_m": "2"}',
    ],
)
def test_a_malformed_jaw_message_is_counted_and_said(publisher: Published, session: zenoh.Session, message: bytes):
    session.put(f"{PREFIX}/jaw", json.dumps({"stamp_ns": 1, "opening_m": 0.02}))
    session.put(f"{PREFIX}/jaw", message)
    wait_until(lambda: publisher.jaw.opening_m() is not None and publisher.jaw.malformed == 1, "the malformed message")
    assert publisher.jaw.opening_m() == 0.02
    assert publisher.jaw.fault().startswith(f"1 malformed jaw message on {PREFIX}/jaw: ")


def test_an_old_jaw_opening_is_not_used(endpoint: str):
    settings = PublishSettings(listen=(endpoint,), jaw_max_age_s=0.2)
    publisher = Published(settings, "arm", "wrist")
    try:
        with plain_session(connect=endpoint) as session:
            session.put(f"{PREFIX}/jaw", json.dumps({"stamp_ns": 1, "opening_m": 0.02}))
            wait_until(lambda: publisher.jaw.opening_m() == 0.02, "the jaw opening")
            wait_until(lambda: publisher.jaw.opening_m() is None, "the jaw opening to grow old")
            assert publisher.jaw.fault() == "no jaw opening for 0.2 s or longer"
    finally:
        publisher.close()


def test_a_jaw_opening_grows_old_though_nobody_asked(endpoint: str):
    """The camera was away for a while: what the robot said before must not look fresh."""
    settings = PublishSettings(listen=(endpoint,), jaw_max_age_s=0.2)
    publisher = Published(settings, "arm", "wrist")
    try:
        with plain_session(connect=endpoint) as session:
            putter = session.declare_publisher(f"{PREFIX}/jaw")
            reading = json.dumps({"stamp_ns": 1, "opening_m": 0.02})
            wait_until(lambda: publisher.jaw.opening_m() is not None or putter.put(reading), "the jaw opening")
            putter.put(reading)
            time.sleep(0.5)
            assert publisher.jaw.opening_m() is None
            assert publisher.jaw.fault() == "no jaw opening for 0.2 s or longer"
    finally:
        publisher.close()
