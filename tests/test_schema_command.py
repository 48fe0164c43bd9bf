"""``gripmon schema`` against what is sent, judged by another implementation of JSON Schema."""

from __future__ import annotations

import copy
import json

import jsonschema
import msgspec
import pytest
from support.sample_messages import SAMPLES, kept
from test_schemas import ONE_OF_EACH

from gripmon.cli import main
from gripmon.cli.network import _MESSAGES as _NAMES
from gripmon.model.records import (
    MESSAGES,
    json_schema,
    schema_name,
    to_json,
)


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["schema", *arguments]) == 0
    return capsys.readouterr().out


def validator(schema: dict) -> jsonschema.Draft202012Validator:
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("sample", SAMPLES)
def test_what_is_sent_validates_against_its_own_schema_and_no_other(
    sample: str, capsys: pytest.CaptureFixture[str]
):
    """As printed; what is really published has these bytes (test_wire_samples.py, test_publish.py)."""
    message = json.loads(kept(sample))
    (name,) = (name for name in MESSAGES if type(SAMPLES[sample]) is MESSAGES[name])
    assert [other for other in MESSAGES if validator(json.loads(printed(capsys, other))).is_valid(message)] == [name]
    validator(json.loads(printed(capsys))).validate(message)


FROM_OTHERS = dict.fromkeys(("jaw", "command", "frame"), ("schema",))


@pytest.mark.parametrize("name", FROM_OTHERS)
def test_others_may_leave_the_schema_out(name: str):
    message = json.loads(to_json(ONE_OF_EACH[name]))
    del message["schema"]
    assert validator(json_schema((name,))).is_valid(message)


def test_a_monitor_always_says_the_schema():
    message = json.loads(to_json(ONE_OF_EACH["transform"]))
    del message["schema"]
    assert not validator(json_schema(("transform",))).is_valid(message)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("schema",), "gripmon.transform/3"),
        (("verdict",), "splendid"),
        (("seq",), "7"),
        (("seq",), 7.5),
        (("cam_T_grip", "translation_m"), [0.1, 0.2]),
        (("cam_T_grip", "rotation_xyzw"), None),
        (("covariance",), [0.0] * 35),
        (("corners", 0, "used"), 1),
        (("corners", 0, "uv_px"), [1.0, 2.0, 3.0]),
        (("alerts", 0, "severity"), "awful"),
        (("reference_id",), None),
    ],
)
def test_an_altered_transform_does_not_validate(place: tuple[str | int, ...], value: object):
    check = validator(json_schema(("transform",)))
    message = json.loads(to_json(ONE_OF_EACH["transform"]))
    assert check.is_valid(message)
    altered = inner = copy.deepcopy(message)
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    assert not check.is_valid(altered)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_missing_field_does_not_validate(name: str):
    check = validator(json_schema((name,)))
    message = json.loads(to_json(ONE_OF_EACH[name]))
    needed = {field for field in message if not check.is_valid({k: v for k, v in message.items() if k != field})}
    without_default = {field.encode_name for field in msgspec.structs.fields(MESSAGES[name]) if field.required}
    assert needed == without_default | ({"schema"} - set(FROM_OTHERS.get(name, ())))


def test_later_fields_and_names_validate():
    check = validator(json_schema(("transform",)))
    message = json.loads(to_json(ONE_OF_EACH["transform"]))
    message["more"], message["state"], message["corners"][0]["reason"] = {"a": 1}, "resting", "painted"
    check.validate(message)


def test_every_field_says_what_it_is():
    """By a description of its own or of its type."""

    def described(node: dict, definitions: dict) -> bool:
        if "description" in node:
            return True
        parts = [*node.get("anyOf", ()), *([definitions[node["$ref"].rpartition("/")[2]]] if "$ref" in node else [])]
        return any(described(part, definitions) for part in parts)

    definitions = json_schema()["$defs"]
    silent = [
        f"{title}.{field}"
        for title, definition in definitions.items()
        for field, node in definition.get("properties", {}).items()
        if not described(node, definitions)
    ]
    assert silent == []
    assert [title for title, definition in definitions.items() if "description" not in definition] == []


def test_the_list_names_every_message(capsys: pytest.CaptureFixture[str]):
    lines = printed(capsys, "--list").splitlines()
    assert [line.split()[:2] for line in lines] == [[name, schema_name(MESSAGES[name])] for name in MESSAGES]
    assert all(len(line.split()) > 5 and "`" not in line for line in lines)
    assert tuple(MESSAGES) == _NAMES


@pytest.mark.parametrize("arguments", [["nonsense"], ["--list", "transform"]])
def test_wrong_usage_is_said(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    try:
        code = main(["schema", *arguments])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    assert arguments[-1] in capsys.readouterr().err
