"""What a controller is told, and by which messages it can't be fooled: the client's rules without a network."""

from __future__ import annotations

import json
import logging
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.loopback import frame_record
from support.timely import TimelyInbox as Inbox

from gripmon.client import MonitorName, NotUsable, Policy, Reading, TransformClient, Unusable
from gripmon.client.inbox import PRESENT_KEPT
from gripmon.client.reading import judge
from gripmon.model.records import FrameRecord, Transform, Verdict, to_json

WRIST, ELBOW = MonitorName("arm", "wrist"), MonitorName("arm", "elbow")
VARIANCES_M2 = (1e-10, 4e-8, 9e-10)


def payload(**changes: object) -> bytes:
    return to_json(frame_record(**({"alerts": ()} | changes)))  # type: ignore[arg-type]


def reading(inbox: Inbox, policy: Policy | None = None, now_s: float = 100.0, wall_ns: int = 0) -> Reading:
    return judge(inbox.heard, inbox.heard.entry, policy or Policy(), now_s, wall_ns, lambda: "")


def heard(now_s: float = 100.0, **changes: object) -> Inbox:
    """An inbox with one message."""
    inbox = Inbox()
    inbox.appeared(WRIST)
    inbox.take(WRIST, payload(**changes), now_s)
    assert inbox.unreadable == 0
    return inbox


def test_a_valid_transform_is_given_as_it_came():
    record = frame_record(41, latency_ns=2_500_000)
    got = reading(heard(seq=41, latency_ns=2_500_000), now_s=100.125)
    assert got.usable and got.why is None and got.reason == ""
    assert got.verdict is Verdict.VALID and got.monitor == WRIST
    for name in (
        "covariance",
        "smoothed",
        "protection",
        "state",
        "source",
        "stamp_ns",
        "seq",
        "reference_id",
        "revision",
    ):
        assert getattr(got, name) == getattr(record, name), name
    assert got.transform == record.cam_T_grip
    assert got.age_s == pytest.approx(0.125 + 0.0025, abs=1e-12)  # since it arrived, and what the monitor needed
    with pytest.raises(AttributeError):
        got.usable = False  # type: ignore[misc]


@pytest.mark.parametrize(
    ("changes", "policy", "later_s", "why", "said"),
    [
        ({}, Policy(), 0.19, None, ""),
        ({}, Policy(), 0.3, Unusable.STALE, "the newest transform is 0.3 s old, at most 0.2 s is allowed"),
        ({}, Policy(max_age_s=2.0), 0.3, None, ""),
        ({"latency_ns": 150_000_000}, Policy(), 0.1, Unusable.STALE, "the newest transform is 0.25 s old"),
        ({"verdict": Verdict.SUSPECT, "reason": "held"}, Policy(), 0.0, Unusable.SUSPECT,
         "the transform is suspect: held"),
        ({"verdict": Verdict.SUSPECT}, Policy(), 0.0, Unusable.SUSPECT, "the transform is suspect: tracking"),
        ({"verdict": Verdict.SUSPECT}, Policy(accept_suspect=True), 0.0, None, ""),
        ({"verdict": Verdict.SUSPECT}, Policy(accept_suspect=True), 0.3, Unusable.STALE, "the newest transform is"),
        ({"verdict": Verdict.UNKNOWN, "reason": "black"}, Policy(accept_suspect=True), 0.0, Unusable.UNKNOWN,
         "the monitor has no transform: black"),
        ({}, Policy(max_sigma_m=2.1e-4), 0.0, None, ""),
        ({}, Policy(max_sigma_m=1.9e-4), 0.0, Unusable.UNCERTAIN,
         "the transform has a standard deviation of 0.2 mm, at most 0.19 mm is allowed"),
        ({}, Policy(max_protection_m=4.5e-4), 0.0, None, ""),
        ({}, Policy(max_protection_m=4.4e-4), 0.0, Unusable.UNPROTECTED,
         "the TCP may be 0.45 mm off, at most 0.44 mm is allowed"),
        ({"protection": None}, Policy(), 0.0, None, ""),
        ({"protection": None}, Policy(max_protection_m=1.0), 0.0, Unusable.UNPROTECTED,
         "the monitor states no protection level"),
        ({"verdict": Verdict.SUSPECT}, Policy(accept_suspect=True, max_protection_m=1e-3), 0.0, None, ""),
    ],
)  # fmt: skip
def test_the_policy_refuses(
    changes: dict[str, object], policy: Policy, later_s: float, why: Unusable | None, said: str
):
    covariance = np.diag([*VARIANCES_M2, 1.0, 1.0, 1.0]).ravel().tolist()  # rotations don't count as metres
    got = reading(heard(covariance=tuple(covariance), **changes), policy, 100.0 + later_s)
    assert (got.usable, got.why) == (why is None, why)
    assert got.reason.startswith(said) and bool(got.reason) == (why is not None)
    unknown = why in (Unusable.STALE, Unusable.UNKNOWN)
    assert (got.verdict is Verdict.UNKNOWN) == unknown
    for value in (got.transform, got.covariance, got.smoothed, *([] if "protection" in changes else [got.protection])):
        assert (value is None) == unknown
    assert got.sigma_m() == (math.inf if unknown else pytest.approx(2e-4))


def test_with_clocks_that_agree_what_was_held_up_on_the_way_is_old():
    inbox, stamp_ns = heard(), frame_record().stamp_ns
    for wall_ns, age_s in ((stamp_ns + 3_000_000_000, 3.0), (stamp_ns + 10_000_000, 0.05), (0, 0.05)):
        assert reading(inbox, Policy(clocks_agree=True), 100.05, wall_ns).age_s == pytest.approx(age_s)
        assert reading(inbox, Policy(), 100.05, wall_ns).age_s == pytest.approx(0.05)


def test_with_clocks_that_agree_a_stamp_of_the_future_is_refused():
    inbox, stamp_ns = heard(), frame_record().stamp_ns
    for ahead_s, usable in ((0.09, True), (0.11, False), (3600.0, False)):
        wall_ns = stamp_ns - round(1e9 * ahead_s)
        got = reading(inbox, Policy(clocks_agree=True), 100.05, wall_ns)
        assert got.usable is usable and (got.transform is not None) is usable
        assert reading(inbox, Policy(), 100.05, wall_ns).usable  # no one says that they agree
        if not usable:
            assert got.why is Unusable.CLOCKS
            assert got.reason == (
                f"the transform's stamp is {ahead_s:.3g} s ahead of this machine's clock: clocks_agree does not hold"
            )


def test_a_vanished_monitor_is_gone_until_it_sends_again():
    inbox = heard()
    before = reading(inbox)
    inbox.vanished(ELBOW)
    assert reading(inbox).usable
    inbox.vanished(WRIST)
    assert reading(inbox).why is Unusable.GONE and reading(inbox).transform is None
    inbox.appeared(WRIST)
    assert reading(inbox).why is Unusable.RESTARTED  # what it said before its end is not true of what it sees now
    assert reading(inbox).reason == "the monitor was gone and is back, but has sent no transform yet"
    inbox.take(WRIST, payload(seq=0, revision=4), 100.0)
    after = reading(inbox)
    assert after.usable and after.seq == 0
    assert not after.same_revision_as(before) and not before.same_revision_as(after)


def test_two_monitors_are_told_apart_by_tokens_or_messages():
    for second in ("appeared", "take"):
        inbox = heard()
        inbox.appeared(ELBOW) if second == "appeared" else inbox.take(ELBOW, payload(), 100.0)
        got = reading(inbox)
        assert got.why is Unusable.SEVERAL and got.transform is None
        assert got.reason == "more than one monitor is there: arm/elbow, arm/wrist; name the camera"
        inbox.vanished(ELBOW)
        assert reading(inbox).why is (None if second == "appeared" else Unusable.GONE)
        inbox.take(WRIST, payload(), 100.0)
        assert reading(inbox).usable


def test_names_that_a_stranger_makes_up_fill_neither_memory_nor_log(caplog: pytest.LogCaptureFixture):
    inbox, message = heard(), payload()
    for number in range(100):
        inbox.take(MonitorName("arm", f"camera-{number}"), message, 100.0)
        inbox.appeared(MonitorName("arm", f"other-{number}"))
    assert len(inbox.heard.present) == PRESENT_KEPT and WRIST in inbox.heard.present
    assert reading(inbox).why is Unusable.SEVERAL
    assert len(caplog.messages) == 1 and caplog.messages[0].startswith("more than one monitor is there: ")


def test_same_revision():
    first, again = reading(heard(seq=1)), reading(heard(seq=2))
    assert first.same_revision_as(again)
    for changes in ({"revision": 4}, {"reference_id": "plate-3"}):
        assert not first.same_revision_as(reading(heard(**changes)))
    other = Inbox()
    other.take(ELBOW, payload(), 100.0)
    assert not first.same_revision_as(reading(other))
    assert not reading(Inbox()).same_revision_as(reading(Inbox()))


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 0.1))
def test_the_matrix_is_scipys(quaternion: list[float]):
    rotation = Rotation.from_quat(quaternion)
    transform = Transform((0.1, -0.2, 0.3), tuple(rotation.as_quat().tolist()))
    matrix = reading(heard(cam_T_grip=transform)).matrix()
    np.testing.assert_allclose(matrix[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:, 3], (0.1, -0.2, 0.3, 1.0))
    averaged = reading(heard(cam_T_grip=transform)).matrix(smoothed=True)
    np.testing.assert_array_equal(averaged[:3, 3], frame_record().smoothed.translation_m)
    np.testing.assert_array_equal(reading(heard(cam_T_grip=transform, smoothed=None)).matrix(smoothed=True), matrix)
    with pytest.raises(NotUsable, match=r"^no transform came yet"):
        reading(Inbox()).matrix()


POSE = {"translation_m": [0.0, 0.0, 0.1], "rotation_xyzw": [0.0, 0.0, 0.0, 1.0]}
BOUNDS = {"position_m": 4e-4, "rotation_rad": 5e-3, "risk": 1e-5}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("schema", "gripmon.transform/3"),
        ("schema", "gripmon.state/1"),
        ("verdict", "certainly"),
        ("seq", -1),
        ("seq", 10**30),
        ("stamp_ns", 10**400),
        ("stamp_ns", "now"),
        ("latency_ns", -5),
        ("revision", None),
        ("cam_T_grip", None),
        ("cam_T_grip", POSE | {"rotation_xyzw": [0.0, 0.0, 0.0, 0.0]}),
        ("cam_T_grip", POSE | {"rotation_xyzw": [0.0, 0.0, 0.0, 2.0]}),
        ("cam_T_grip", POSE | {"rotation_xyzw": [0.0, 0.0, 1.0]}),
        ("cam_T_grip", POSE | {"translation_m": [0.0, 0.0, "1e999"]}),
        ("cam_T_grip", POSE | {"translation_m": [0.0, 0.0, math.nan]}),
        ("cam_T_grip", POSE | {"translation_m": [0.0, 0.0, math.inf]}),
        ("covariance", None),
        ("covariance", [1.0] * 35),
        ("covariance", [-1.0] + [1.0] * 35),
        ("smoothed", POSE | {"rotation_xyzw": [1.0, 1.0, 0.0, 0.0], "covariance": [1.0] * 36}),
        ("smoothed", POSE | {"covariance": [1.0] * 35 + [-1.0]}),
        ("protection", BOUNDS | {"position_m": -1e-3}),
        ("protection", BOUNDS | {"rotation_rad": math.nan}),
        ("protection", BOUNDS | {"risk": 0.0}),
        ("protection", {"position_m": 1e-3}),
    ],
)
def test_a_message_that_is_none_is_counted_said_once_and_changes_nothing(
    field: str, value: object, caplog: pytest.LogCaptureFixture
):
    inbox = heard(now_s=100.0)
    broken = json.dumps(json.loads(payload()) | {field: value}).encode()
    with caplog.at_level(logging.WARNING):
        for count in (1, 2, 3):
            inbox.take(WRIST, broken, 100.1)
            assert inbox.unreadable == count
    (said,) = caplog.messages
    assert said.startswith("malformed transform on ") and "from arm/wrist, " in said and "\n" not in said
    assert reading(inbox, now_s=100.1).usable
    stale = reading(inbox, now_s=101.0)
    assert stale.why is Unusable.STALE and "; what came since can't be read: " in stale.reason
    inbox.take(WRIST, payload(), 101.0)
    assert reading(inbox, now_s=101.0).usable and inbox.unreadable == 3


def test_a_flood_of_broken_messages_each_broken_in_its_own_way_does_not_fill_the_log(caplog: pytest.LogCaptureFixture):
    inbox, whole = heard(), payload()
    with caplog.at_level(logging.WARNING):
        for number in range(2, len(whole)):
            inbox.take(MonitorName(f"arm{'x' * (number % 7)}", "wrist"), whole[:number], 100.0)
            inbox.take(WRIST, whole.replace(b'"valid"', b'"v%s"' % whole[number : number + 1].hex().encode()), 100.0)
    assert inbox.unreadable == 2 * (len(whole) - 2)
    assert 1 < len(caplog.messages) <= 9  # the first kinds, and "any other"


def test_an_older_monitor_has_no_protection_level_and_is_read():
    told = json.loads(payload())
    assert told.pop("protection") is not None
    older = Inbox()
    older.take(WRIST, json.dumps(told).encode(), 100.0)
    got = reading(older)
    assert got.usable and got.protection is None
    assert not reading(older, Policy(max_protection_m=0.01)).usable


def test_a_newer_monitor_is_named_as_the_reason_and_additions_are_passed_over():
    told = json.loads(payload())
    newer = Inbox()
    newer.take(WRIST, json.dumps(told | {"schema": "gripmon.transform/3"}).encode(), 0.0)
    got = reading(newer)
    assert got.why is Unusable.UNREADABLE
    assert "'gripmon.transform/3'" in got.reason and "'gripmon.transform/2'; update the older one" in got.reason
    added = Inbox()
    added.take(WRIST, json.dumps(told | {"added": [1], "state": "dreaming", "source": "guess"}).encode(), 100.0)
    assert reading(added).usable and reading(added).state == "dreaming"


@settings(max_examples=300)
@given(
    st.one_of(
        st.binary(max_size=400),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
            lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
        ).map(lambda tree: json.dumps(tree).encode()),
        st.tuples(st.integers(0, 2000), st.binary(max_size=3)).map(
            lambda cut: payload()[: cut[0]] + cut[1] + payload()[cut[0] + len(cut[1]) :]
        ),
        st.just(b"[" * 100_000),
        st.just(b" " * (2 << 20)),
    )
)
def test_nothing_that_arrives_makes_an_exception(data: bytes):
    inbox = Inbox()
    inbox.take(WRIST, data, 100.0)
    got = reading(inbox)
    if inbox.unreadable:
        assert not got.usable and got.transform is None
    else:  # what a change of a few bytes leaves readable is a pose
        record = msgspec.json.decode(data, type=FrameRecord)
        assert got.transform == (record.cam_T_grip if got.verdict is not Verdict.UNKNOWN else None)


@pytest.mark.parametrize(
    "values", [{"max_age_s": 0.0}, {"max_age_s": math.nan}, {"max_sigma_m": -1.0}, {"max_protection_m": 0.0}]
)
def test_a_policy_that_can_not_be_meant_is_refused(values: dict[str, float]):
    with pytest.raises(ValueError, match=rf"^{next(iter(values))} is .*; give a number above 0$"):
        Policy(**values)  # type: ignore[arg-type]


def test_depth_must_hold_something():
    with pytest.raises(ValueError, match=r"^depth is 0; give 1 or more$"):
        TransformClient("arm", depth=0)
