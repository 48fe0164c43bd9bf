"""The wire as it is written down: kept payloads byte for byte, and the page for readers in other languages."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import zenoh
from support.loopback import (
    alert_record,
    frame_record,
    free_endpoint,
    plain_session,
    reference_record,
    state_record,
    wait_until,
)
from support.published import Published
from support.sample_messages import FOLDER, SAMPLES, kept, payload

from gripmon.io.wire import PublishSettings
from gripmon.model.records import MESSAGES, from_json, schema_name

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "reference" / "wire.md").read_text(encoding="utf-8")


@pytest.fixture
def tables(tools_importable: None) -> ModuleType:
    """What fills the marks of the page with tables when the site is built."""
    from pages import messages

    return messages


@pytest.mark.parametrize("name", SAMPLES)
def test_the_code_still_writes_these_bytes(name: str):
    assert payload(name) == kept(name), "the wire has changed; if meant: python -m support.sample_messages, in tests/"


def test_the_folder_holds_these_samples_and_nothing_else():
    assert {path.name for path in FOLDER.iterdir()} == {f"{name}.json" for name in SAMPLES}


@pytest.mark.parametrize("name", SAMPLES)
def test_the_code_still_reads_them(name: str):
    assert from_json(kept(name), type(SAMPLES[name])) == SAMPLES[name]


def test_there_is_a_sample_of_every_message():
    assert {type(message) for message in SAMPLES.values()} == set(MESSAGES.values())
    for name, message in MESSAGES.items():
        assert isinstance(SAMPLES[name], message)


def test_a_plain_reader_gets_what_was_meant():
    """By the standard library alone, without a word of the package's."""
    read = {name: json.loads(kept(name)) for name in SAMPLES}
    transform = read["transform"]
    assert transform["schema"] == "gripmon.transform/2" and transform["verdict"] == "valid"
    assert transform["stamp_ns"] == 1767225600123456789, "all digits"
    assert transform["cam_T_grip"] == {
        "translation_m": [0.0116, -0.0021, 0.1327],
        "rotation_xyzw": [0.5, -0.5, 0.5, 0.5],
    }
    sigmas_m = [transform["covariance"][7 * i] ** 0.5 for i in range(3)]
    assert sigmas_m == pytest.approx([2e-5, 2e-5, 8e-5])
    assert transform["covariance"][6 * 1 + 3] == transform["covariance"][6 * 3 + 1] == 1e-9
    assert [corner["uv_px"] for corner in transform["corners"]] == [[401.25, 310.5], None]
    assert transform["protection"]["position_m"] == 3.5e-4 and transform["protection"]["risk"] == 1e-5
    assert (read["transform_held"]["source"], read["transform_held"]["rms_px"]) == ("held", None)
    nothing = read["transform_null"]
    assert nothing["verdict"] == "unknown"
    assert [nothing[field] for field in ("cam_T_grip", "covariance", "smoothed", "drift", "protection")] == [None] * 5
    assert read["reply_snapshot"]["snapshot"]["record"] == transform
    assert read["reply_state"]["monitor"]["references"][1] == read["reference"]
    assert {key: read["alert"][key] for key in transform["alerts"][0]} == transform["alerts"][0]


# --- the page ---


def test_the_page_names_every_field_and_every_word(tables: ModuleType):
    """Read as a person reads it: the rows of each table, the words of each enumeration."""
    page = tables.put_into(PAGE)
    fields, words = tables.fields_in(page), tables.words_in(page)
    for name, node in tables.definitions().items():
        if "properties" in node:
            assert fields[name] == list(node["properties"]), name
        else:
            enum = node.get("enum") or node["anyOf"][0]["enum"]
            assert words[name] == enum, name


def test_the_page_says_which_enumerations_are_open(tables: ModuleType):
    said = {name: how for how, name in re.findall(r"\((open|closed)\)[^\n]*\n\n<!-- table: (\w+) -->", PAGE)}
    for name, node in tables.definitions().items():
        if "properties" not in node and name != "CommandName":
            assert said[name] == ("open" if "anyOf" in node else "closed"), name


def test_every_sample_is_mentioned_and_every_mentioned_one_exists():
    assert set(re.findall(r"`(\w+)\.json`", PAGE)) == set(SAMPLES)


def test_every_fault_of_a_command_is_explained(tables: ModuleType):
    table = PAGE[PAGE.index("| fault | means |") :]
    faults = tables.definitions()["CommandFault"]["anyOf"][0]["enum"]
    assert sorted(re.findall(r"`(\w+)`", "\n".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)))) == sorted(
        faults
    )


def test_every_command_is_explained(tables: ModuleType):
    table = PAGE[PAGE.index("| name | argument | does |") : PAGE.index("A key with a wildcard")]
    named = re.findall(r"`(\w+)`", "\n".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)))
    assert sorted(named) == sorted(tables.definitions()["CommandName"]["enum"])


PRIORITIES = {"real time": 1, "interactive high": 2, "data high": 4}


@pytest.fixture(scope="module")
def heard() -> Iterator[dict[str, zenoh.Sample]]:
    endpoint = free_endpoint()
    publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    records = {
        "transform": frame_record(),
        "state": state_record(),
        "reference": reference_record(),
        "alert": alert_record(),
    }
    try:
        with plain_session(connect=endpoint) as session:
            samples: dict[str, zenoh.Sample] = {}
            subscriber = session.declare_subscriber("gripmon/arm/wrist/*")

            def all_there() -> bool:
                for leaf, record in records.items():
                    (publisher.transform if leaf == "transform" else publisher.event)(record)
                while (sample := subscriber.try_recv()) is not None:
                    samples[str(sample.key_expr).rpartition("/")[2]] = sample
                return samples.keys() == records.keys()

            wait_until(all_there, "one of each")
            yield samples
    finally:
        publisher.close()


@pytest.mark.parametrize("leaf", ["transform", "state", "reference", "alert"])
def test_the_page_says_how_each_key_is_sent(heard: dict[str, zenoh.Sample], leaf: str):
    """Priority, congestion control, express and encoding, as a sample from a real session has them."""
    (row,) = re.findall(rf"^\| `…/{leaf}` \|.*$", PAGE, re.MULTILINE)
    _, message, _, priority, congestion, express, _ = (cell.strip() for cell in row.strip("|").split("|"))
    name, number = re.fullmatch(r"(.*) \((\d)\)", priority).groups()  # type: ignore[union-attr]
    sample = heard[leaf]
    assert message == f"[{leaf}](#{leaf})" and f"\n### {leaf}\n" in PAGE
    assert PRIORITIES[name] == int(number)
    assert str(sample.priority).rpartition(".")[2] == name.upper().replace(" ", "_")
    assert (congestion, sample.congestion_control) == ("drop", zenoh.CongestionControl.DROP)
    assert {"yes": True, "no": False}[express] is sample.express
    assert str(sample.encoding) == "application/json"
    attached = None if sample.attachment is None else json.loads(sample.attachment.to_bytes())
    assert (None if attached is None else attached["schema"]) == ("gripmon.clock/1" if leaf == "transform" else None)
    assert json.loads(sample.payload.to_bytes())["schema"] == schema_name(MESSAGES[leaf])


def test_the_sizes_on_the_page_are_those_of_the_code():
    from gripmon.model.records import (
        ClockReading,
        CommandReply,
        CommandRequest,
        FrameNote,
        FrameRecord,
        JawReading,
        largest_bytes,
    )

    assert "larger than 1 MiB, a `clock`, `jaw`, `frame` or `command` 4 KiB, a `reply` 64 MiB" in PAGE
    assert largest_bytes(FrameRecord) == 1 << 20 and largest_bytes(CommandReply) == 64 << 20
    assert {
        largest_bytes(message) for message in (ClockReading, JawReading, FrameNote, CommandRequest)
    } == {4 << 10}
