"""The records passed between rooms, and the messages that go over the wire.

Everything here is a value: frozen, with no behaviour beyond packing.  The structs are encoded by ``msgspec``; the field
names of :class:`FrameRecord` are the contract of one JSON line a frame (``gripmon replay``) and of the ``transform``
key.

Conventions: ``a_T_b`` maps coordinates in frame b to frame a; quaternions are ``x, y, z, w``; SI units; ``*_ns`` are
Unix nanoseconds for capture time.  A covariance is 6x6, row by row: first the error of the TCP's position in camera
axes (m²), then the rotation error vector in camera axes (rad²), that is ``t_true = t + rho`` and ``R_true = exp(omega)
R``.
"""

from __future__ import annotations

from gripmon.model.records.alerts import Alert, AlertEvent, AlertKind, Cause, CauseWeight, OpenAlert, Severity
from gripmon.model.records.commands import (
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    Mount,
    Outlines,
    Snapshot,
    SnapshotImage,
    accepting,
)
from gripmon.model.records.evidence import EdgeEvidence, EdgeSums
from gripmon.model.records.frames import (
    Beside,
    CornerFault,
    CornerRecord,
    Frame,
    FrameRecord,
    MeasurementTrace,
    Origin,
    Refusal,
    State,
    Verdict,
    unmeasured_record,
    withheld,
)
from gripmon.model.records.json_schema import json_schema, summary
from gripmon.model.records.messages import AlertRecord, ClockReading, FrameNote, JawReading, StandingAlert, StateRecord
from gripmon.model.records.motion import Creep, Explanation, Motion, Vibration
from gripmon.model.records.notes import Limits, MonitorNotes
from gripmon.model.records.recorded import Meta, RecordedCommand, RecordedConfiguration, RecordedFile
from gripmon.model.records.references import (
    AtReferenceRecord,
    MonitorState,
    ReferenceInputs,
    ReferenceRecord,
    StripsRecord,
)
from gripmon.model.records.schemas import MESSAGES, OLDER, MessageRefused, from_json, largest_bytes, schema_name
from gripmon.model.records.values import (
    NOTHING_WRONG,
    Absolute,
    Array,
    Drift,
    Image,
    Protection,
    Since,
    SinceReference,
    Smoothed,
    Transform,
    ValidBy,
    to_json,
)

__all__ = [
    "MESSAGES",
    "NOTHING_WRONG",
    "OLDER",
    "Absolute",
    "Alert",
    "AlertEvent",
    "AlertKind",
    "AlertRecord",
    "Array",
    "AtReferenceRecord",
    "Beside",
    "Cause",
    "CauseWeight",
    "ClockReading",
    "Command",
    "CommandError",
    "CommandFault",
    "CommandName",
    "CommandReply",
    "CommandRequest",
    "CornerFault",
    "CornerRecord",
    "Creep",
    "Drift",
    "EdgeEvidence",
    "EdgeSums",
    "Explanation",
    "Frame",
    "FrameNote",
    "FrameRecord",
    "Image",
    "JawReading",
    "Limits",
    "MeasurementTrace",
    "MessageRefused",
    "Meta",
    "MonitorNotes",
    "MonitorState",
    "Motion",
    "Mount",
    "OpenAlert",
    "Origin",
    "Outlines",
    "Protection",
    "RecordedCommand",
    "RecordedConfiguration",
    "RecordedFile",
    "ReferenceInputs",
    "ReferenceRecord",
    "Refusal",
    "Severity",
    "Since",
    "SinceReference",
    "Smoothed",
    "Snapshot",
    "SnapshotImage",
    "StandingAlert",
    "State",
    "StateRecord",
    "StripsRecord",
    "Transform",
    "ValidBy",
    "Verdict",
    "Vibration",
    "accepting",
    "from_json",
    "json_schema",
    "largest_bytes",
    "schema_name",
    "summary",
    "to_json",
    "unmeasured_record",
    "withheld",
]
