"""The messages' JSON Schema, draft 2020-12, made from the structs that encode and decode them."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import msgspec

from gripmon.model.records.commands import CommandRequest
from gripmon.model.records.messages import FrameNote, JawReading
from gripmon.model.records.schemas import MESSAGES
from gripmon.model.records.values import OpenEnum

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_FROM_OTHERS = (JawReading, FrameNote, CommandRequest)
_SCHEMA_TEXT = "name and major version of this schema"
_LATER_TEXT = "; later versions may have more names"


def json_schema(names: Sequence[str] = tuple(MESSAGES)) -> dict[str, Any]:
    """The JSON Schema of one message, or of any of several, by their names in :data:`gripmon.model.records.MESSAGES`.

    It holds for this version and for later ones of the same major version: unknown fields and names are accepted.
    KeyError for an unknown message name.
    """
    types = [MESSAGES[name] for name in names]
    references, definitions = msgspec.json.schema_components(types, ref_template="#/$defs/{name}")
    for definition in definitions.values():
        if "description" in definition:
            definition["description"] = _plain(definition["description"])
    for kind in OpenEnum.__subclasses__():
        if kind.__name__ in definitions:
            _open(definitions[kind.__name__], kind)
    for message in types:
        _say_schema(definitions[message.__name__], message)
    head = references[0] if len(references) == 1 else {"anyOf": list(references)}
    return {"$schema": _DIALECT, **head, "$defs": definitions}


def summary(name: str) -> str:
    """What a message is, in one sentence."""
    return _plain(MESSAGES[name].__doc__ or "").split("\n")[0]


def _plain(docstring: str) -> str:
    """A docstring's paragraphs, one line each, without markup."""
    paragraphs = inspect.cleandoc(docstring).replace("``", "").split("\n\n")
    return "\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def _open(definition: dict[str, Any], kind: type[OpenEnum]) -> None:
    """Accept any other name, too."""
    known = {"enum": [member.value for member in kind]}
    definition.pop("enum")
    definition["anyOf"] = [known, {"type": "string"}]
    definition["description"] = definition.get("description", kind.__name__).rstrip(".") + _LATER_TEXT


def _say_schema(definition: dict[str, Any], message: type[msgspec.Struct]) -> None:
    definition["properties"]["schema"]["description"] = _SCHEMA_TEXT
    if message in _FROM_OTHERS:  # hand-written messages may omit it
        definition["required"] = [field for field in definition.get("required", ()) if field != "schema"]
