"""Schema versions: what a reader takes, what it refuses, and in which words."""

from __future__ import annotations

import json

import msgspec
import pytest
from support.loopback import frame_record, reference_record
from support.sample_messages import SAMPLES

from gripmon.model.records import (
    MESSAGES,
    AlertKind,
    CommandName,
    CommandReply,
    CommandRequest,
    FrameRecord,
    MessageRefused,
    MonitorState,
    Origin,
    State,
    Verdict,
    from_json,
    largest_bytes,
    to_json,
)

ONE_OF_EACH = {name: SAMPLES[name] for name in MESSAGES}


VERSIONS = {"transform": 2, "reply": 2}
"""Major versions of messages; of the others 1."""
PLAIN = to_json(frame_record())


@pytest.mark.parametrize("name", MESSAGES)
def test_another_major_version_is_refused_whatever_it_looks_like(name: str):
    for content in ({}, json.loads(to_json(ONE_OF_EACH[name])), {"all": "different"}):
        known = VERSIONS.get(name, 1)
        payload = json.dumps({**content, "schema": f"gripmon.{name}/{known + 1}"}).encode()
        with pytest.raises(MessageRefused) as caught:
            from_json(payload, MESSAGES[name])
        assert str(caught.value) == (
            f"its schema is 'gripmon.{name}/{known + 1}', and this version of gripmon reads 'gripmon.{name}/{known}'; "
            "update the older one"
        )


@pytest.mark.parametrize("name", MESSAGES)
def test_without_a_schema_it_is_the_first_version(name: str):
    content = json.loads(to_json(ONE_OF_EACH[name]))
    del content["schema"]
    assert from_json(json.dumps(content).encode(), MESSAGES[name]) == ONE_OF_EACH[name]


@pytest.mark.parametrize("name", sorted(MESSAGES.keys() - {"command"}))
def test_a_field_of_a_later_minor_version_is_passed_over_at_every_depth(name: str):
    def grown(content: object) -> object:
        if isinstance(content, dict):
            return {"new": [1, {"deep": None}], **{key: grown(value) for key, value in content.items()}}
        return [grown(value) for value in content] if isinstance(content, list) else content

    payload = json.dumps(grown(json.loads(to_json(ONE_OF_EACH[name])))).encode()
    assert from_json(payload, MESSAGES[name]) == ONE_OF_EACH[name]


def test_a_monitor_refuses_a_command_with_a_field_that_it_does_not_know():
    with pytest.raises(MessageRefused, match="unknown field `dry_run`"):
        from_json(b'{"argument": "plate-2", "dry_run": true}', CommandRequest)


def test_a_name_of_a_later_minor_version_is_kept_as_it_came():
    content = json.loads(to_json(ONE_OF_EACH["transform"]))
    content["state"], content["source"], content["alerts"][0]["kind"] = "resting", "guess", "fire"
    record = from_json(json.dumps(content).encode(), FrameRecord)
    assert (record.state, record.source, record.alerts[0].kind) == ("resting", "guess", "fire")
    assert isinstance(record.state, State) and record.state not in list(State)
    assert isinstance(record.source, Origin) and isinstance(record.alerts[0].kind, AlertKind)
    assert json.loads(to_json(record)) == content


@pytest.mark.parametrize("value", ["good", "", 1, None])
def test_a_verdict_that_is_not_known_is_never_taken_for_one_that_is(value: object):
    content = json.loads(to_json(ONE_OF_EACH["transform"]))
    assert content["verdict"] in list(Verdict)
    with pytest.raises(MessageRefused, match="verdict"):
        from_json(json.dumps({**content, "verdict": value}).encode(), FrameRecord)


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"", "no message gripmon.transform/2: Input data was truncated"),
        (b"\xff\xfe", "no message gripmon.transform/2: JSON is malformed"),
        (b"[1, 2]", "Expected `object`, got `array`"),
        (b'{"schema": "gripmon.state/1", "seq": 3}', "its schema is 'gripmon.state/1'"),
        (b'{"schema": 1}', "Expected `str` - at `$.schema`"),
        (b'{"schema": "\xff"}', "'utf-8' codec can't decode"),
        (b'{"new": ' + b"[" * 500_000, "maximum recursion depth exceeded"),
        (PLAIN[:-1], "Input data was truncated"),
        (PLAIN.replace(b"0.0625", b"NaN"), "JSON is malformed"),
        (PLAIN.replace(b"0.0625", b"1e999"), "Number out of range"),
        (json.dumps(msgspec.to_builtins(frame_record(covariance=(0.0,) * 35))).encode(), "length >= 36"),
        (b" " * (2 << 20), "2097152 bytes; at most 1048576"),
    ],
)
def test_what_is_no_message_is_refused_in_one_line(payload: bytes, said: str):
    with pytest.raises(MessageRefused) as caught:
        from_json(payload, FrameRecord)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_the_largest_messages_fit():
    """A thousand references, each with an id of some length, are what an operator may ask for."""
    state = MonitorState((reference_record(),) * 1000)
    reply = CommandReply(CommandName.STATE, True, "", "plate-2", 3, state)
    assert len(to_json(reply)) < largest_bytes(CommandReply)
    assert from_json(to_json(reply), CommandReply) == reply
