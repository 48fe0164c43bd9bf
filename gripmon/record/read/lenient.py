"""Records of other versions, read as far as they are understood."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from gripmon.model.records import FrameRecord, Meta, Origin, State, Verdict, schema_name

_T = TypeVar("_T", bound=msgspec.Struct)

DECODING_ERRORS = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)

# For a field that another version doesn't write: nothing is known.
_UNKNOWN: dict[type[msgspec.Struct], dict[str, Any]] = {
    FrameRecord: {
        "verdict": Verdict.UNKNOWN, "state": State.LOST, "source": Origin.HELD, "cam_T_grip": None, "covariance": None,
        "smoothed": None, "drift": None, "reference_id": "", "revision": -1, "rms_px": None, "jaw_opening_m": None,
        "corners": (), "alerts": (),
    },
    Meta: {
        "name": "", "recording_id": "", "robot": "unknown", "camera": "unknown", "gripper": "unknown",
        "version": "unknown", "file_number": 0, "started_ns": 0, "image_policy": "unknown", "has_truth": False,
    },
}  # fmt: skip


def read(text: str | bytes, kind: type[_T]) -> tuple[_T, str]:
    """A record, and in a few words what had to be passed over (empty where all is as this version writes it).

    Raises ValueError, in one line, for what isn't one whatever the version.
    """
    try:
        return msgspec.json.decode(text, type=kind), ""
    except DECODING_ERRORS as error:
        return _with_unknowns(text, kind, str(error))


def _with_unknowns(text: str | bytes, kind: type[_T], reason: str) -> tuple[_T, str]:
    schema = schema_name(kind)
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
    except DECODING_ERRORS as error:
        raise ValueError(f"is no {schema}: {error}") from None
    written = fields.get("schema", schema)
    if not isinstance(written, str) or written.partition("/")[0] != schema.partition("/")[0]:
        raise ValueError(f"is no {schema} but {written!r:.80}")
    fields["schema"] = schema
    if kind is FrameRecord and fields.get("verdict") not in set(Verdict):
        fields["verdict"] = Verdict.UNKNOWN
    for name, value in _UNKNOWN.get(kind, {}).items():
        fields.setdefault(name, value)
    try:
        record = msgspec.convert(fields, type=kind)
    except DECODING_ERRORS as error:
        raise ValueError(f"is no {schema} that can be understood: {error}") from None
    return record, f"is {written}, this version reads {schema}" if written != schema else reason
