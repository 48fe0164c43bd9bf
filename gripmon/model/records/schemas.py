"""The messages by name, and reading a message from an untrusted sender.

A message names its schema and its major version, ``"schema": "gripmon.transform/2"``.  Within a major version fields
and names (:class:`gripmon.model.records.values.OpenEnum`) may be added; a reader ignores what it doesn't know.
"""

from __future__ import annotations

import contextlib
from typing import TypeVar, cast

import msgspec

from gripmon.model.decoding import decoder_of
from gripmon.model.records.commands import CommandError, CommandReply, CommandReply1, CommandRequest
from gripmon.model.records.frames import FrameRecord, FrameRecord1
from gripmon.model.records.messages import AlertRecord, ClockReading, FrameNote, JawReading, StateRecord
from gripmon.model.records.references import ReferenceRecord

_T = TypeVar("_T", bound=msgspec.Struct)

MESSAGES: dict[str, type[msgspec.Struct]] = {
    "transform": FrameRecord,
    "state": StateRecord,
    "alert": AlertRecord,
    "reference": ReferenceRecord,
    "clock": ClockReading,
    "jaw": JawReading,
    "frame": FrameNote,
    "command": CommandRequest,
    "reply": CommandReply,
    "error": CommandError,
}
"""All messages that go over the wire."""

OLDER: dict[type[msgspec.Struct], type[FrameRecord1] | type[CommandReply1]] = {
    FrameRecord: FrameRecord1,
    CommandReply: CommandReply1,
}
"""The messages of an earlier version that are read as well: transforms of schema 1, by themselves and in a reply."""

LARGEST_BYTES: dict[type[msgspec.Struct], int] = {
    ClockReading: 4096,
    JawReading: 4096,
    FrameNote: 4096,
    CommandRequest: 4096,
    CommandReply: 64 << 20,
}
_LARGEST_BYTES = 1 << 20  # of any other message


class MessageRefused(ValueError):
    """A payload is not the expected message; the text gives the reason in one line."""


class _Tag(msgspec.Struct, frozen=True):
    schema: str = ""


decoder_of(_Tag)
for _message in MESSAGES.values():
    decoder_of(_message)  # before threads of Zenoh's decode their first messages, however they do it


def from_json(payload: bytes, message: type[_T]) -> _T:
    """Decode a payload from the network as the type that is expected there.

    Raises :class:`MessageRefused` for anything else, in particular for an unknown major version.  Without ``schema``
    the payload counts as the version that is known here.
    """
    if len(payload) > largest_bytes(message):
        raise MessageRefused(f"{len(payload)} bytes; at most {largest_bytes(message)}")
    try:
        return decoder_of(message).decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        if (older := OLDER.get(message)) is not None and _schema_of(payload) == schema_name(older):
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                return cast(_T, decoder_of(older).decode(payload).upgraded())
        raise MessageRefused(_what_is_wrong(payload, message, error)) from None


def largest_bytes(message: type[msgspec.Struct]) -> int:
    """Size limit for messages of this type, in bytes of JSON."""
    return LARGEST_BYTES.get(message, _LARGEST_BYTES)


def schema_name(message: type[msgspec.Struct]) -> str:
    """Its name on the wire with its major version, e.g. ``gripmon.transform/2``."""
    return str(message.__struct_config__.tag)


def _what_is_wrong(payload: bytes, message: type[msgspec.Struct], error: Exception) -> str:
    schema = _schema_of(payload)
    if schema and schema != (known := schema_name(message)):
        return f"its schema is {schema[:80]!r}, and this version of gripmon reads {known!r}; update the older one"
    return f"no message {schema_name(message)}: {str(error) or type(error).__name__}"


def _schema_of(payload: bytes) -> str:
    """The schema that a payload names; empty where it names none."""
    try:
        return decoder_of(_Tag).decode(payload).schema
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return ""
