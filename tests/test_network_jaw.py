"""The jaw opening from the network: a message, a number; and what is no opening."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh
from support.loopback import free_endpoint, plain_session, wait_until

from gripmon.io.jaw import MOST_REPORTS, ReportedOpening, StampedOpenings
from gripmon.io.publish.inputs import ZenohJaw
from gripmon.io.wire import Link, PublishSettings, malformed
from gripmon.io.wire.malformed import Malformed

KEY = "gripmon/arm/wrist/jaw"
TRAVEL_M = (0.0, 0.06)


class Robot:
    """A session that reports, and the jaw that hears it."""

    def __init__(self, session: zenoh.Session, jaw: ZenohJaw) -> None:
        self.jaw = jaw
        # The default drops what is too large for a queue on a busy machine.
        self._publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: self._publisher.matching_status.matching, "the jaw to listen")

    def says(self, payload: str | bytes, expected_m: float | None) -> None:
        self._publisher.put(payload)
        wait_until(lambda: self.jaw.opening_m() == expected_m, f"an opening of {expected_m} m from {payload!r}")

    def errs(self, payload: str | bytes) -> None:
        before = self.jaw.malformed
        self._publisher.put(payload)
        wait_until(lambda: self.jaw.malformed == before + 1, f"{payload!r} to be refused")


@contextmanager
def robot(max_age_s: float = 60.0) -> Iterator[Robot]:
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,), jaw_max_age_s=max_age_s))
    try:
        with plain_session(connect=endpoint) as session:
            yield Robot(session, ZenohJaw(link, KEY, travel_m=TRAVEL_M))
    finally:
        link.close()


def test_a_message_or_a_number_of_metres():
    with robot() as arm:
        arm.says("0.034", 0.034)
        arm.says(json.dumps({"stamp_ns": 1, "opening_m": 0.02}), 0.02)
        arm.says(" 3.5e-2\n", 0.035)
        arm.says("0", 0.0)
        arm.says(b'\n {"schema": "gripmon.jaw/1", "opening_m": 0.01, "stamp_ns": 0, "more": [1]}', 0.01)
        assert arm.jaw.malformed == 0 and arm.jaw.fault() == ""


def test_no_opening_of_this_gripper_is_refused_and_the_last_one_stays():
    with robot() as arm:
        arm.says("-0.0009", -0.0009)  # as far off as a frame may say, too
        arm.says("0.034", 0.034)
        wrong = ["34", "-0.002", "0.0611", "1e308", "NaN", "Infinity", "1e999", "nan", "", "[0.03]", '"0.03"', "null"]
        wrong += ["true", '{"opening_m": 0.03}', '{"stamp_ns": 1, "opening_m": 34}', "0.03 0.03", "9" * 5000]
        wrong += ['{"stamp_ns": 1, "opening_m": 0.02, "schema": "gripmon.jaw/2"}', "[" * 3000]
        for payload in wrong:
            arm.errs(payload)
        assert arm.jaw.opening_m() == 0.034
        assert arm.jaw.fault() == (
            f"over 10 malformed jaw messages on {KEY}: opening 34 m; 0 to 0.06 m as the gripper file says"
        )


def test_rubbish_keeps_no_opening_young():
    with robot(max_age_s=0.2) as arm:
        arm.says("0.034", 0.034)

        def is_old() -> bool:
            arm.errs("34")
            return arm.jaw.opening_m() is None

        wait_until(is_old, "the opening to grow old")
        assert arm.jaw.fault().startswith("no jaw opening for 0.2 s or longer, ")


def stamped(stamp_ns: int, opening_m: float) -> str:
    return json.dumps({"stamp_ns": stamp_ns, "opening_m": opening_m})


def test_the_opening_is_that_of_the_images_time():
    """100 mm/s, a report every 10 ms, images between them that come late: the newest would be up to 3 mm off."""
    base_ns = 1_700_000_000_000_000_000
    with robot() as arm:
        for k in range(5):
            arm.says(stamped(base_ns + 10_000_000 * k, 0.02 + 0.001 * k), 0.02 + 0.001 * k)
        for late_ms in (0.0, 3.0, 10.0, 24.0, 40.0):
            at_ns = base_ns + 40_000_000 - round(1e6 * late_ms)
            assert arm.jaw.opening_m(at_ns) == pytest.approx(0.024 - 1e-4 * late_ms, abs=1e-9)
        # Nothing is made up before the first report and after the last one.
        assert arm.jaw.opening_m(base_ns - 20_000_000) == 0.02
        assert arm.jaw.opening_m(base_ns + 60_000_000) == 0.024
        assert arm.jaw.fault() == ""
        # Without stamps it is the newest, as ever.
        arm.says("0.05", 0.05)
        assert arm.jaw.opening_m(base_ns) == 0.05


def test_stamps_of_another_clock_are_said_and_the_newest_is_taken():
    image_ns = 1_700_000_000_000_000_000
    with robot(max_age_s=5.0) as arm:
        arm.says(stamped(image_ns - 3_600_000_000_000, 0.02), 0.02)
        arm.says(stamped(image_ns - 3_600_000_000_000 + 10_000_000, 0.03), 0.03)
        assert arm.jaw.opening_m(image_ns) == 0.03
        said = "jaw openings have stamps 3.6e+03 s earlier than the images: the newest is taken"
        assert arm.jaw.fault() == said
        # The robot's clock is set: what was kept of the other one is forgotten.
        arm.says(stamped(image_ns, 0.04), 0.04)
        assert arm.jaw.opening_m(image_ns - 5_000_000) == pytest.approx(0.03 + 0.01 * 0.95) and arm.jaw.fault() == ""
        arm.says(stamped(image_ns - 7_200_000_000_000, 0.01), 0.01)
        assert arm.jaw.opening_m(image_ns) == 0.01 and "7.2e+03 s earlier" in arm.jaw.fault()


def test_between_rare_reports_the_jaw_moves_at_the_end():
    """A robot that reports changes says nothing while the jaws stand."""
    openings = StampedOpenings()
    openings.add(ReportedOpening(1_000_000_000, 0.02), 0.0, 1.0)
    openings.add(ReportedOpening(1_900_000_000, 0.03), 0.9, 1.0)
    assert openings.at(1_000_000_000) == openings.at(1_500_000_000) == openings.at(1_800_000_000) == 0.02
    assert openings.at(1_850_000_000) == pytest.approx(0.025)
    # Those of another order, and too many.
    openings.add(ReportedOpening(1_860_000_000, 0.026), 0.91, 1.0)
    assert openings.at(1_860_000_000) == 0.026 and openings.at(1_880_000_000) == pytest.approx(0.028)
    for k in range(2 * MOST_REPORTS):
        openings.add(ReportedOpening(2_000_000_000 + k, 0.03), 1.0, 1.0)
    assert len(openings) == MOST_REPORTS
    openings.add(ReportedOpening(3_000_000_000, 0.04), 2.5, 1.0)
    assert len(openings) == 1


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now_s = [1000.0]
    monkeypatch.setattr(malformed.time, "monotonic", lambda: now_s[0])
    return now_s


def test_what_is_malformed_is_said_once_an_occasion(clock: list[float], caplog: pytest.LogCaptureFixture):
    seen = Malformed("frame", "a/b")
    assert seen.fault() == ""
    said = []
    for count in range(1, 2001):
        clock[0] += 0.01
        seen.add(f"reason {count}")
        if not said or said[-1] != seen.fault():
            said.append(seen.fault())
    assert said == [
        "1 malformed frame on a/b: reason 1",
        "some malformed frames on a/b: reason 1",
        "over 10 malformed frames on a/b: reason 1",
        "over 100 malformed frames on a/b: reason 1",
        "over 1,000 malformed frames on a/b: reason 1",
    ]
    assert [r.message for r in caplog.records] == ["malformed frame on a/b: reason 1 (logged once)"]
    clock[0] += malformed.REMEMBERED_S + 1.0
    assert seen.fault() == ""
    seen.add("another reason")
    assert seen.fault() == "1 malformed frame on a/b: another reason"
    assert seen.count == 2001 and len(caplog.records) == 2


def test_good_ones_for_some_seconds_end_the_words_but_not_the_count(
    clock: list[float], caplog: pytest.LogCaptureFixture
):
    seen = Malformed("frame", "a/b")
    seen.good()
    assert seen.fault() == ""
    for _ in range(20):
        seen.add("too short")
    for said in (True, True, False):
        clock[0] += 0.4 * malformed.CALM_S
        seen.good()
        assert bool(seen.fault()) == said, "a few good ones aren't enough"
    clock[0] += malformed.CALM_S
    assert seen.fault() == "" and seen.count == 20
    seen.add("too short")
    assert seen.fault() == "1 malformed frame on a/b: too short", "counted again after the calm"
    clock[0] += 2.0 * malformed.CALM_S
    assert seen.fault(), "silence is no good sign"
    assert len(caplog.records) == 1, "one occasion, said once"


def test_a_good_opening_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(malformed, "CALM_S", 0.0)
    with robot() as arm:
        arm.errs("34")
        assert arm.jaw.fault().startswith("no jaw opening received, 1 malformed jaw message on ")
        arm.says("0.03", 0.03)
        assert arm.jaw.fault() == "" and arm.jaw.malformed == 1


def test_a_stranger_writes_no_lines_of_his_own(caplog: pytest.LogCaptureFixture):
    seen = Malformed("frame", "a/b")
    seen.add("bad\n2026-01-01 INFO all is well\x1b[2J\u202e" + "x" * 10_000)
    text = seen.fault()
    assert len(text) < 300 and text.isprintable() and "\x1b" not in caplog.records[0].message
    assert "bad 2026-01-01 INFO all is well?[2J?xxx" in text


def test_what_is_said_is_the_fault_that_there_is(clock: list[float], caplog: pytest.LogCaptureFixture):
    """One broken image, 20 s of good ones, then hundreds of another size; and the other way round without a calm."""
    seen = Malformed("frame", "a/b")
    with caplog.at_level("WARNING", logger="gripmon"):
        seen.add("damaged JPEG file")
        for _ in range(20):
            clock[0] += 1.0
            seen.good()
        for _ in range(4):
            clock[0] += 1.0
            seen.add("640x480 pixels; 1280x720 as configured")
    assert seen.fault() == "some malformed frames on a/b: 640x480 pixels; 1280x720 as configured"
    assert [record.getMessage() for record in caplog.records] == [
        "malformed frame on a/b: damaged JPEG file (logged once)",
        "malformed frame on a/b: 640x480 pixels; 1280x720 as configured (logged once)",
    ]
    for _ in range(120):
        seen.add("damaged JPEG file")
    assert seen.fault() == "over 100 malformed frames on a/b: damaged JPEG file"


def test_reasons_that_a_stranger_makes_up_fill_neither_log_nor_memory(caplog: pytest.LogCaptureFixture):
    seen = Malformed("frame", "a/b")
    with caplog.at_level("WARNING", logger="gripmon"):
        for i in range(5000):
            seen.add("x" * (i % 190) + f" {i}")
    assert len(caplog.records) < 20 and seen.count == 5000
    assert seen.fault().startswith("over 1,000 malformed frames on a/b: x")
